"""Diagnosis of a running system in one line: `watching = await watch(system)`."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from ..actors.kernel.actor import Start
from ..actors.kernel.node import Node
from ..actors.kernel.ref import ActorRef
from ..supervision.spec import ChildSpec, child
from .assembly import observer, tree
from .bridges.alerts import AlertObserver, no_alert
from .diagnoser import SERVER, DiagnoserActor
from .engine import Diagnosis
from .generate import (
    Generated,
    LiveWiring,
    WatchedSystem,
    child_name,
    evident,
    generate,
    has_replicas,
    observers_for,
)
from .literals import ok
from .messages import DIAGNOSER, Explained, GetDiagnosis, GetExplanation, GetObserved
from .model import Declaration, Expectation, History, System
from .model_follower import ModelFollower, Reach
from .observations import Observed
from .observers import (
    Baselines,
    Bound,
    Limits,
    Manner,
    NodeObserver,
    Property,
    PropertyObserver,
    ReplicaObserver,
    RuntimeObserver,
)
from .repair import (
    Approver,
    GetRepairStatus,
    GetStories,
    Policy,
    RepairAction,
    Repairer,
    RepairStatus,
    SetStance,
    Stance,
    Story,
    repairer,
    restart_child,
    restart_replica,
    restart_subtree,
)
from .repair.policy import check_stance

REPAIRER: Final = "repairer"
"""The last part of the repairer's address."""
LimitsOf = Mapping[str, Mapping[Property, Limits]]
"""What is good, for each property of some components."""


class Watch:
    """A system under diagnosis.

    Attributes:
        tree: the supervisor of all that watches; stop it to watch no longer.
        addresses: component to address; of a generated model they follow the system.
        generated: what was found at first, if the model was generated.
    """

    def __init__(
        self, tree: ActorRef[Any], node: Node, addresses: Mapping[str, str], generated: Generated | None
    ) -> None:
        self.tree, self.addresses, self.generated = tree, addresses, generated
        self._node = node

    @property
    def repairer(self) -> ActorRef[Repairer]:
        """Return a ref to the actor that repairs, or advises. Raises NoSuchActor if repair is "off"."""
        return self._node.find_ref(f"{self.tree.path}/{REPAIRER}", Repairer)

    @property
    def diagnoser(self) -> ActorRef[DiagnoserActor]:
        """Return a ref to the actor that diagnoses. Raises NoSuchActor if it does not run."""
        return self._node.find_ref(f"{self.tree.path}/{DIAGNOSER}", DiagnoserActor)

    async def diagnosis(self) -> Diagnosis:
        """Ask for the present diagnosis of the system."""
        return await self.diagnoser.ask(GetDiagnosis())

    async def set_repair(self, stance: Stance) -> None:
        """Have repair go as far as this from now on: "off", "advise", "ask" or "on". Raises BadStance, NoSuchActor."""
        await self.repairer.ask(SetStance(stance))

    async def repair_status(self) -> RepairStatus:
        """Ask how repair stands, and how good its advice was. Raises NoSuchActor if repair was never on."""
        return await self.repairer.ask(GetRepairStatus())

    async def stories(self) -> tuple[Story, ...]:
        """Ask for what repair has told of its last cases, the oldest first. Raises NoSuchActor if it was never on."""
        return (await self.repairer.ask(GetStories())).stories

    async def why(self) -> Explained:
        """Ask why the diagnosis is what it is, and what to look at next."""
        return await self.diagnoser.ask(GetExplanation())

    async def observed(self) -> Observed:
        """Ask for all that is observed of the system at the moment."""
        return await self.diagnoser.ask(GetObserved())


async def watch(
    system: WatchedSystem,
    model: Declaration | System | None = None,
    observers: Iterable[ChildSpec] = (),
    *,
    addresses: Mapping[str, str] | None = None,
    limits: LimitsOf | None = None,
    repair: Stance = "advise",
    policy: Policy | None = None,
    actions: Iterable[RepairAction] = (),
    approve: Approver | None = None,
    manner: Manner | None = None,
    seconds: float = 3.0,
    window: float = 2.0,
    hung_after: float | None = None,
    baselines: Baselines | None = None,
    repair_file: str | Path | None = None,
    alerts: bool = False,
    name: str = "diagnosis",
    **options: Any,
) -> Watch:
    """Diagnose a running system from now on, and say how it could be repaired, or repair it.

    Args:
        system: an `ActorSystem`.
        model: what it is made of. None: it is looked at for `seconds` seconds, and a model is generated, with
            observers of all its actors and topics.
        observers: further ones, from `observer(...)`.
        addresses: of components that are actors: whether they run is observed, and repair can restart them. Of a
            generated model they are known.
        limits: what is good of their properties, such as `{"ledger": {Property.GROWTH: Limits(high=1e6)}}`; the atom
            `ok(ledger.growth)` is added to the model.
        repair: "advise" says what it would do, and keeps the score of whether that would have been right. "ask" has a
            person approve each plan: by `approve`, or by `holdfast repair approve CASE`. "on" repairs: by `actions`
            and, for actors that are supervised, by a restart of the actor; what is dangerous, such as a restart of the
            supervisor above it, still waits for a person, unless the policy allows it by its name. "off": neither.
        policy: the rules of repair.
        approve: is asked to approve a plan, besides people; whoever answers first decides.
        actions: what else can be done, such as `repair.run_command(...)`; with the name "restart_child" or
            "restart_subtree" in place of that one.
        manner: of the observers that are made here.
        seconds: see `model`.
        window: of a generated model: seconds of silence of a topic that are never too long.
        baselines: of a generated model: what is usual of its topics, such as `Baselines("usual.json")`, which is kept.
        repair_file: where the scores of advice, and what people have denied to repair, are kept for the next program,
            such as "repair.json"; None: nowhere.
        alerts: whether alerts from outside count (`OutsideAlert` on `/alerts`): while one fires about a component,
            `ok(COMPONENT.alerts)` does not hold.
        hung_after: seconds after which an actor that is still in the same turn counts as not running, such as one that
            others ask in vain. None: nothing takes too long.
        name: of the supervisor that is started.
        options: those of `tree`.

    Raises:
        ModelError: something is wrong with the model. StartFailed, AlreadyStarted: see `ActorSystem.start`.
        ValueError: there is no such stance of repair, or the file of repair is another one.
    """
    check_stance(repair)
    reach = Reach("" if system._node.root is None else system._node.root.path, addresses or {})
    complete = functools.partial(_completed, limits or {}, alerts)
    watchers, generated = [*observers], None
    if model is None:
        generated = await generate(system, seconds=seconds)
        reach.use(generated.addresses)
        declaration, live = generated.declaration, LiveWiring(generated)
        heard = live.addresses
        watchers += observers_for(
            generated, window=window, hung_after=hung_after, manner=manner, wiring=live, baselines=baselines
        )
        follower = child("follower", Start(ModelFollower, (live, SERVER, complete, reach)))
        options["others"] = (*options.get("others", ()), follower)
    else:
        declaration, heard = model.declaration() if isinstance(model, System) else model, reach.addresses
        if heard:
            groups = {name: path for name, path in heard.items() if has_replicas(system._node.find(path))}
            declaration = evident(declaration, heard, protected=groups)
            watchers += _observers_of_lives(heard, groups, hung_after, manner)
    where = reach.addresses
    watchers += property_observers(limits or {}, where, manner)
    if alerts:
        watchers.append(observer("alerts", Start(AlertObserver, (heard,))))
    declaration = _expecting_all(declaration, where, limits or {}, alerts=alerts)
    mend = None
    if repair != "off":
        ways = _actions(reach, actions)
        mend = repairer(
            declaration, ways, policy, name=REPAIRER, addresses=where, stance=repair, approve=approve, file=repair_file
        )
    started = await system.start(tree(History(declaration), watchers, name=name, repairer=mend, **options))
    return Watch(started, system._node, where, generated)


def _observers_of_lives(
    addresses: Mapping[str, str], groups: Mapping[str, str], hung_after: float | None, manner: Manner | None
) -> Iterable[ChildSpec]:
    """Describe who observes whether the components of a given model run; `groups` are those that have replicas."""
    yield observer("nodes", Start(NodeObserver, (addresses,), {"hung_after": hung_after, "manner": manner}))
    yield observer("runtime", Start(RuntimeObserver, (addresses,)))
    yield observer("replicas", Start(ReplicaObserver, (groups,)))


def _completed(limits: LimitsOf, alerts: bool, found: Generated) -> Generated:
    """Return a model that is generated anew, with what is expected of its components besides."""
    declaration = _expecting_all(found.declaration, found.addresses, limits, alerts=alerts)
    return msgspec.structs.replace(found, declaration=declaration)


def _expecting_all(
    declaration: Declaration, addresses: Mapping[str, str], limits: LimitsOf, *, alerts: bool
) -> Declaration:
    """Return the declaration again: components keep their limits, and with `alerts` nobody outside complains of them.

    Limits of components that have no address, as they have gone, are left out.
    """
    declaration = expecting(declaration, {name: some for name, some in limits.items() if name in addresses})
    if not alerts:
        return declaration
    more = tuple(Expectation(str(no_alert(name)), (name,)) for name in addresses)
    return msgspec.structs.replace(declaration, expectations=(*declaration.expectations, *more))


def expecting(declaration: Declaration, limits: LimitsOf) -> Declaration:
    """Return the declaration again, with limits that properties of components are expected to keep."""
    atoms = [(component, str(ok(_property(component, one)))) for component, some in limits.items() for one in some]
    more = tuple(Expectation(atom, (component,)) for component, atom in atoms)
    return msgspec.structs.replace(declaration, expectations=(*declaration.expectations, *more))


def property_observers(
    limits: LimitsOf, addresses: Mapping[str, str], manner: Manner | None = None
) -> Iterable[ChildSpec]:
    """Describe an observer for each component with limits. Raises KeyError: a component without an address."""
    for component, some in limits.items():
        bounds = tuple(Bound(ok(_property(component, one)), one, good) for one, good in some.items())
        start = Start(PropertyObserver, (addresses[component], bounds), {"manner": manner})
        yield observer(child_name("properties of", component), start)


def _property(component: str, one: Property) -> str:
    return f"{component}.{one.value}"


def _actions(reach: Reach, more: Iterable[RepairAction]) -> list[RepairAction]:
    """What a person gave, and restarts for whoever has a supervisor."""
    given = {action.name: action for action in more}
    stock = (restart_child(reach.addresses), restart_subtree(reach.above), restart_replica(reach.groups))
    ours = {action.name: action for action in stock}
    return list((ours | given).values())
