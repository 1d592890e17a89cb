"""Diagnosis of a running system in one line: `watching = await watch(system)`."""

from __future__ import annotations

import asyncio
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
    evident,
    generate,
    has_replicas,
    observers_for,
)
from .literals import near
from .live_limits import LimitsOf, LiveLimits, expecting, observe_bounds
from .messages import DIAGNOSER, Explained, GetDiagnosis, GetExplanation, GetObserved
from .model import Declaration, Expectation, History, System
from .model_follower import ModelFollower, Reach
from .observations import Observed
from .observers import (
    Baselines,
    Manner,
    NodeObserver,
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
    expect: Iterable[Expectation] = (),
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
            `ok(ledger.growth)` is added to the model. A pattern such as `"desk/*"` stands for all components that it
            fits and that have no limits by name; of a generated model those that come later, too. Limits go with an
            actor that is moved.
        expect: what else holds while components work, such as `Expectation("ok(disk)", ("ledger",))` for an observer
            of your own. A generated model has it whenever it has all of these components.
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
            others ask in vain; time in which the turn rests, as it has said, does not count. None: nothing takes too
            long.
        name: of the supervisor that is started.
        options: those of `tree`.

    Raises:
        ModelError: something is wrong with the model. StartFailed, AlreadyStarted: see `ActorSystem.start`.
        ValueError: there is no such stance of repair, the file of repair is another one, or `limits` or `expect` name a
            component that there is not.
    """
    check_stance(repair)
    generated = await generate(system, seconds=seconds) if model is None else None
    watchers, expected = [*observers], tuple(expect)
    live = None if generated is None else LiveWiring(generated)
    live_limits = LiveLimits(limits or {})
    reach = Reach("" if system._node.root is None else system._node.root.path, addresses or {})
    reach.use({} if generated is None else generated.addresses)
    where = reach.addresses
    if generated is not None and live is not None:
        declaration = generated.declaration
        watchers += observers_for(
            generated, window=window, hung_after=hung_after, manner=manner, wiring=live, baselines=baselines
        )
        completed = functools.partial(_completed, expected=expected, alerts=alerts)
        follower = child("follower", Start(ModelFollower, (live, live_limits, SERVER, completed, reach)))
        options["others"] = (*options.get("others", ()), follower)
    else:
        assert model is not None
        declaration = model.declaration() if isinstance(model, System) else model
    groups = {name: path for name, path in where.items() if has_replicas(system._node.find(path))}
    if generated is None and where:
        watchers.append(observer("nodes", Start(NodeObserver, (where,), {"hung_after": hung_after, "manner": manner})))
        watchers.append(observer("runtime", Start(RuntimeObserver, (where,))))
        watchers.append(observer("replicas", Start(ReplicaObserver, (groups,))))
        declaration = evident(declaration, where, protected=groups)
    heard = where if live is None else live.addresses
    live_limits.check(heard)
    live_limits.use(live_limits.look_again(heard), system._node, heard)
    _check_expected(declaration, expected)
    declaration = _completed(declaration, heard, live_limits.applied, expected=expected, alerts=alerts)
    if limits:
        watchers.append(observe_bounds(live_limits.bounds, heard, manner))
    if alerts:
        watchers.append(observer("alerts", Start(AlertObserver, (heard,))))
    mend = None
    if repair != "off":
        ways = _actions(reach, actions)
        named: dict[str, Any] = {"name": REPAIRER, "addresses": where, "stance": repair, "approve": approve}
        # In a thread: the parser of actions takes some tenths of a second, in which nobody else would have a turn.
        mend = await asyncio.to_thread(repairer, declaration, ways, policy, file=repair_file, **named)
    started = await system.start(tree(History(declaration), watchers, name=name, repairer=mend, **options))
    return Watch(started, system._node, where, generated)


def _check_expected(declaration: Declaration, expected: Iterable[Expectation]) -> None:
    """Refuse a name that no component has. Raises ValueError."""
    known = {one.name for one in declaration.components}
    for one in expected:
        for name in one.of:
            if name not in known:
                raise ValueError(
                    f"{one.atom} is expected of {name!r}, and no component has that name{near(name, known)}"
                )


def _completed(
    declaration: Declaration,
    components: Iterable[str],
    limits: LimitsOf,
    *,
    expected: Iterable[Expectation],
    alerts: bool,
) -> Declaration:
    """What is added to each model: limits of properties, what else is expected, and that nobody outside complains."""
    declaration = expecting(declaration, limits)
    known = {one.name for one in declaration.components}
    more = tuple(one for one in expected if known.issuperset(one.of))
    declaration = msgspec.structs.replace(declaration, expectations=(*declaration.expectations, *more))
    return _with_alerts(declaration, components) if alerts else declaration


def _with_alerts(declaration: Declaration, components: Iterable[str]) -> Declaration:
    """Return the declaration again, in which nobody outside complains about a component that works."""
    more = tuple(Expectation(str(no_alert(name)), (name,), is_quiet=True) for name in components)
    return msgspec.structs.replace(declaration, expectations=(*declaration.expectations, *more))


def _actions(reach: Reach, more: Iterable[RepairAction]) -> list[RepairAction]:
    """What a person gave, and restarts for whoever has a supervisor."""
    given = {action.name: action for action in more}
    stock = (restart_child(reach.addresses), restart_subtree(reach.above), restart_replica(reach.groups))
    ours = {action.name: action for action in stock}
    return list((ours | given).values())
