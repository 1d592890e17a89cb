"""A model from the live system: any holdfast system is diagnosable from day one.

The runtime knows who lives, who is supervised by whom, who subscribes to what, and who is bound to whom. Who publishes
what is heard, for a while, on every topic that has subscribers. The actors do not notice.
"""

from __future__ import annotations

import asyncio
import functools
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, Final, Protocol, TypeVar

import msgspec

from ..actors.kernel.actor import Actor, Start, on
from ..actors.kernel.cell import Cell
from ..actors.kernel.node import Node, cell_kind
from ..actors.kernel.ref import ActorRef
from ..supervision.spec import ChildSpec
from ..supervision.supervisor import Supervisor
from .assembly import observer
from .literals import (
    caught_up,
    crashes,
    keeps_up,
    led,
    made_atom,
    progress,
    replies,
    room,
    waits_for,
    whole,
    word_for,
)
from .messages import DIAGNOSIS, EXPLANATION, GRACE, MODEL, OBSERVATIONS, REPAIR, ROS_DIAGNOSTICS, STARTS
from .model import Component, Declaration, Expectation, Kind, ModelError
from .observers.flow import (
    MOST_ARRIVALS,
    Arrival,
    Baselines,
    FlowObserver,
    FlowSource,
    hear_lines,
    lines_topic,
    told_lines,
)
from .observers.hearing import Heard, listen
from .observers.node_observer import NodeObserver
from .observers.observer import Manner, Observer
from .observers.replicas import ReplicaObserver
from .observers.runtime import RuntimeObserver
from .observers.verdicts import Agreement

T = TypeVar("T")

OURS = frozenset({DIAGNOSIS, EXPLANATION, GRACE, MODEL, OBSERVATIONS, REPAIR, ROS_DIAGNOSTICS, STARTS})
"""Topics of diagnosis itself."""


PACKAGE = (__package__ or "").rpartition(".")[0]
BASE = tuple(f"{PACKAGE}.{room}." for room in ("diagnosis", "checkpoint", "ftm"))
"""Packages whose actors look after the system and are no part of it; how replicas do is a component of its own."""


class WatchedSystem(Protocol):
    """The system that is watched: an `ActorSystem`."""

    @property
    def _node(self) -> Node:
        """The node of the process in which diagnosis itself lives."""
        ...

    async def start(self, spec: ChildSpec) -> ActorRef[Any]:
        """Start a child of its root supervisor."""
        ...


class Wired(msgspec.Struct, frozen=True, kw_only=True):
    """One actor as it is connected; other actors by their component names."""

    path: str
    kind: str
    supervisor: str | None = None
    """The address of who restarts it; None: nobody does."""
    publishes: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    bound: dict[str, str] = {}
    """Port to component."""
    asks: tuple[str, ...] = ()
    """Whom it was seen to ask."""
    is_protected: bool = False
    """Whether replicas live its life."""


class Generated(msgspec.Struct, frozen=True):
    """A declaration of a model to begin with, made from a running system, and how it came about.

    Attributes:
        declaration: each actor is a component; its name is its address below the root as a word (`component_for`). A
            topic depends on the publisher's subscriptions and, through replies (`replies(NAME)`), on those it is bound
            to or was seen to ask.
        addresses: component to address.
        wiring: component to how it is connected.
        left_out: dependencies that would close a circle; a fault goes round in it, so one has to be cut.
        arrivals: the topic and the loop time of each message that was heard, in order.
    """

    declaration: Declaration
    addresses: dict[str, str]
    wiring: dict[str, Wired]
    left_out: tuple[str, ...] = ()
    arrivals: tuple[Arrival, ...] = ()


async def generate(
    system: WatchedSystem, *, seconds: float = 3.0, topics: Iterable[str] = (), leave_out: Collection[str] = ()
) -> Generated:
    """Look at a running system for a while and write down what it is made of.

    Args:
        system: an `ActorSystem`.
        seconds: how long to listen for publishers; one that publishes more rarely is not found.
        topics: to listen to besides those that have subscribers.
        leave_out: addresses; they and all below them are no part of the model. Diagnosis itself never is.
    """
    node = system._node
    heard: dict[str, set[str]] = {}
    wanted = [topic for topic in dict.fromkeys((*node.topics.names(), *topics)) if topic not in OURS]
    arrivals: list[Arrival] = []
    cell = node.spawn(Start(TopicListener, (tuple(wanted), heard, arrivals)))
    try:
        await asyncio.sleep(seconds)
    finally:
        out = [*leave_out, cell.path]
        cell.request_stop()
        await cell.ended()
    found = declared(_wiring(node, heard, out, {}))
    return msgspec.structs.replace(found, arrivals=tuple(arrivals))


class LiveWiring:
    """Holds how a running system is connected, as observers see it and go by it; it outlives their lives.

    Attributes:
        found: what observers go by at the moment.
        addresses: component to address.
        protected: component to address, of those whose lives replicas live.
        made: topic to how it comes about.
        heard: address to the topics on which it was heard.
        asked: component to those that it was seen to ask.
        arrivals: what was heard before anybody observed; whoever learns from it takes it out.
    """

    def __init__(self, found: Generated, leave_out: Collection[str] = ()) -> None:
        self.addresses: dict[str, str] = {}
        self.protected: dict[str, str] = {}
        self.made: dict[str, FlowSource] = {}
        self.heard = {wired.path: set(wired.publishes) for wired in found.wiring.values()}
        self.asked: dict[str, set[str]] = {}
        self.arrivals = [*found.arrivals]
        self._out = leave_out
        self.use(found)

    def use(self, found: Generated) -> None:
        """Have observers go by this from their next look on."""
        self.found = found
        replace(self.addresses, found.addresses)
        replace(self.protected, {name: wired.path for name, wired in found.wiring.items() if wired.is_protected})
        replace(self.made, _made(found.wiring, set().union(*self.heard.values())))

    def look_again(self, node: Node) -> Generated | None:
        """What the system is like now; None if it is as before."""
        wiring = _wiring(node, self.heard, self._out, self.asked)
        for name, wired in self.found.wiring.items():
            if name not in wiring and _is_missed(node, wired):
                wiring[name] = wired  # It has failed for good: that is no change of what the system should be.
        return None if wiring == self.found.wiring else declared(wiring)


def _is_missed(node: Node, wired: Wired) -> bool:
    """Whether an actor that is not there should be: nobody has taken it away from its supervisor."""
    above = None if wired.supervisor is None else node.find(wired.supervisor)
    if above is None or above.is_dead:
        return True  # Its supervisor has given up.
    name, keeper = wired.path.rpartition("/")[2], above.actor
    is_kept = isinstance(keeper, Supervisor) and name in keeper._children  # It was stopped, and may be started again.
    return is_kept or name in (above.children or {})


def replace(old: dict[str, T], new: Mapping[str, T]) -> None:
    """Have a dict that others hold say what another one says."""
    old.clear()
    old.update(new)


def _made(wiring: Mapping[str, Wired], known: Collection[str]) -> dict[str, FlowSource]:
    """How each topic comes about; what was ever heard is an input also while nobody publishes it any more."""
    published = {topic for wired in wiring.values() for topic in wired.publishes}
    made: dict[str, FlowSource] = {}
    for topic in sorted(published):
        makers = [wired for wired in wiring.values() if topic in wired.publishes]
        inputs = {one for wired in makers for one in wired.subscribes if one in known and one != topic}
        is_lines = any(topic == lines_topic(wired.path) for wired in makers)
        made[topic] = FlowSource(tuple(wired.path for wired in makers), tuple(sorted(inputs)), is_lines)
    return made


class TopicListener(Actor):
    """Notes who publishes on which topics, and when."""

    deterministic = False

    def __init__(self, topics: tuple[str, ...], heard: dict[str, set[str]], arrivals: list[Arrival]) -> None:
        self._listens_to, self._publishers, self._arrivals = topics, heard, arrivals

    def on_start(self, restored: bool) -> None:
        """Subscribe to the topics that are to be listened to."""
        for topic in self._listens_to:
            listen(self, topic)
        self.ctx.create_task(hear_lines(self.ctx._cell.node, self._heard_line))

    def _heard_line(self, program: str) -> None:
        self._note(lines_topic(program), program)

    @on(Heard)
    def _heard(self, message: Heard) -> None:
        self._note(message.topic, message.sender)

    def _note(self, topic: str, sender: str | None) -> None:
        if sender is not None:
            self._publishers.setdefault(sender, set()).add(topic)
        if len(self._arrivals) < MOST_ARRIVALS:
            self._arrivals.append((topic, self.ctx._cell.node.loop.time()))


def _wiring(
    node: Node, heard: dict[str, set[str]], out: Collection[str], asked: Mapping[str, set[str]]
) -> dict[str, Wired]:
    root = node.root
    if root is None:
        return {}
    cells = [cell for cell in _below(root, out) if not _is_ours(cell)]
    names = {cell.path: component_for(cell.path[len(root.path) + 1 :]) for cell in cells}
    lines: dict[str, set[str]] = {}
    for cell in cells:
        if (to := told_lines(cell)) is not None:
            lines.setdefault(to, set()).add(lines_topic(cell.path))
    return {names[cell.path]: _wired(cell, names, heard, asked, lines.get(cell.path, set())) for cell in cells}


def _below(cell: Cell, out: Collection[str]) -> Iterator[Cell]:
    """Actors that somebody restarts. Supervisors are no components: what they supervise is."""
    for child in (cell.children or {}).values():
        if child.path in out or child.is_dead:
            continue
        spec = child.spec
        if isinstance(spec, ChildSpec):
            is_component = not spec.is_supervisor and spec.restart != "temporary"
        else:  # The spec of a recorded actor may be in its supervisor's process; no supervisor is recorded.
            is_component = spec is not None
        if is_component:
            yield child
        yield from _below(child, out)


def _is_ours(cell: Cell) -> bool:
    """Whether an actor belongs to diagnosis, recovery or a mechanism; the power board belongs to the system."""
    kind = cell_kind(cell)
    if kind is None or issubclass(kind, Observer):
        return True
    module = f"{kind.__module__}."
    return module.startswith(BASE) and not module.startswith(f"{__package__}.board.")


def _wired(
    cell: Cell, names: dict[str, str], heard: dict[str, set[str]], asked: Mapping[str, set[str]], lines: set[str]
) -> Wired:
    more, kind = cell.more, cell_kind(cell)
    bound = more.bindings if more is not None else {}
    return Wired(
        path=cell.path,
        kind="" if kind is None else f"{kind.__module__}.{kind.__qualname__}",
        supervisor=None if cell.parent is None else cell.parent.path,
        publishes=tuple(sorted(heard.get(cell.path, ()))),
        subscribes=tuple(sorted(lines | (set(more.belongings.topics) - OURS if more is not None else set[str]()))),
        bound={port: names[target.path] for port, target in sorted(bound.items()) if target.path in names},
        asks=tuple(sorted(asked.get(names[cell.path], set()) & set(names.values()))),
        is_protected=has_replicas(cell),
    )


def declared(wiring: dict[str, Wired]) -> Generated:
    """The declaration that follows from the wiring."""
    inputs: dict[str, list[str]] = {}  # what an actor publishes or replies is made from these
    published = {topic for wired in wiring.values() for topic in wired.publishes}
    for name, wired in wiring.items():
        heard = [word_for(topic) for topic in wired.subscribes if topic in published and topic not in wired.publishes]
        needed = dict.fromkeys((*wired.bound.values(), *wired.asks))
        inputs[name] = [*heard, *(str(replies(other)) for other in needed if other != name and other in wiring)]
    outputs = {name: [*map(word_for, wired.publishes), str(replies(name))] for name, wired in wiring.items()}
    left_out = _cut_circles(inputs, outputs)
    makers = Counter(out for outs in outputs.values() for out in outs)
    components = tuple(
        Component(
            name=name,
            kind=Kind.NODE,
            out={out: tuple(inputs[name]) for out in outputs[name] if makers[out] == 1},
            where=wired.path,
        )
        for name, wired in wiring.items()
    )
    # What several publish is as it should be while all of them work, not while any of them does.
    shared = tuple(_shared(out, inputs, outputs) for out, count in makers.items() if count > 1)
    addresses = {name: wired.path for name, wired in wiring.items()}
    waits = [(name, other) for name, wired in wiring.items() for other in (*wired.bound.values(), *wired.asks)]
    protected = [name for name, wired in wiring.items() if wired.is_protected]
    made = evident(Declaration(components=components, expectations=shared), wiring, waits, protected)
    return Generated(made, addresses, wiring, left_out)


def has_replicas(cell: Cell | None) -> bool:
    """Whether replicas live the life at an address."""
    return cell is not None and cell.host.place.replica_states() is not None


def component_for(path: str) -> str:
    """Name an actor as a component, by its address below the root: no two are alike, nor like replicas of another one.

    >>> component_for("lab/left arm"), component_for("lab/arm.replicas")
    ('lab/left%20arm', 'lab/arm%2Ereplicas')
    """
    word = word_for(path)
    return f"{word.removesuffix(_REPLICAS)}%2E{_REPLICAS[1:]}" if word.endswith(_REPLICAS) else word


_REPLICAS: Final = ".replicas"


def replicas_of(component: str) -> str:
    """The component that stands for the replicas of another one.

    It is one of its own: that a replica is missing is no fault of the actor, whose others work on.
    """
    return f"{component}{_REPLICAS}"


def evident(
    declaration: Declaration,
    components: Iterable[str],
    waits: Iterable[tuple[str, str]] = (),
    protected: Iterable[str] = (),
) -> Declaration:
    """Return the declaration with what the runtime itself sees of these components, if they are actors.

    Args:
        declaration: the model.
        components: those with an address; others of the model are left as they are.
        waits: who may wait for whom.
        protected: those whose lives replicas live; their replicas are a component each.

    Raises:
        ModelError: the model has a component already that is called like the replicas of another one.
    """
    known = {component.name for component in declaration.components}
    actors = [name for name in components if name in known]
    outs = {out for component in declaration.components for out in component.out}
    made = functools.partial(Expectation, is_quiet=True)
    expected = [made(str(atom(name)), (name,)) for name in actors for atom in (progress, room, keeps_up)]
    expected += [made(str(replies(name)), (name,)) for name in actors if str(replies(name)) not in outs]
    groups = [name for name in protected if name in known]
    if taken := tuple(replicas_of(name) for name in groups if replicas_of(name) in known):
        why = "this name stands for the replicas of a protected actor; call the component of the model otherwise"
        raise ModelError(tuple(f"{name}: {why}" for name in taken))
    expected += [made(str(led(name)), (name,)) for name in groups]
    expected += [made(str(atom(name)), (replicas_of(name),)) for name in groups for atom in (whole, caught_up)]
    seen = [str(crashes(name)) for name in actors]
    seen += [str(waits_for(one, other)) for one, other in dict.fromkeys(waits) if one in known and other in known]
    return msgspec.structs.replace(
        declaration,
        components=(*declaration.components, *(Component(name=replicas_of(name)) for name in groups)),
        expectations=(*declaration.expectations, *expected),
        propositions=(*declaration.propositions, *seen),
    )


def _shared(topic: str, inputs: dict[str, list[str]], outputs: dict[str, list[str]]) -> Expectation:
    publishers = tuple(name for name, outs in outputs.items() if topic in outs)
    given = dict.fromkeys(str(made_atom(wanted)) for name in publishers for wanted in inputs[name])
    return Expectation(str(made_atom(topic)), publishers, tuple(given), is_quiet=True)


def _cut_circles(inputs: dict[str, list[str]], outputs: dict[str, list[str]]) -> tuple[str, ...]:
    """Take out the inputs that lead back to where one came from; returns them in words."""
    makers: dict[str, list[str]] = {}
    for name, outs in outputs.items():
        for out in outs:
            makers.setdefault(out, []).append(name)
    left_out: list[str] = []
    done: set[str] = set()

    def sources(name: str) -> Iterator[tuple[str, str]]:
        return iter([(wanted, maker) for wanted in inputs[name] for maker in makers.get(wanted, ())])

    for start in inputs:
        path = {} if start in done else {start: sources(start)}  # without recursion: chains may be long
        while path:
            name = next(reversed(path))
            wanted, maker = next(path[name], (None, name))
            if wanted is None:
                del path[name]
                done.add(name)
            elif maker not in path:
                path |= {} if maker in done else {maker: sources(maker)}
            elif wanted in inputs[name]:
                inputs[name].remove(wanted)
                left_out.append(f"{name} depends on {wanted}")
    return tuple(left_out)


def observers_for(
    generated: Generated,
    *,
    window: float = 2.0,
    hung_after: float | None = None,
    manner: Manner | None = None,
    wiring: LiveWiring | None = None,
    baselines: Baselines | None = None,
) -> tuple[ChildSpec, ...]:
    """Describe observers of whether the actors live, of what the runtime knows of them, of replicas, and of topics.

    Args:
        generated: what was found.
        window: seconds of silence of a topic that are never too long.
        hung_after: see `NodeObserver`.
        manner: of the first and the last; by default two of three looks must agree, so that a restart is no fault yet,
            and topics are looked at five times as often as actors: silence is seen by looking.
        wiring: what they go by; it follows the system if a `ModelFollower` has it, too.
        baselines: what is usual of each topic, if that is to outlive the program.
    """
    at_topics = manner or Manner(every=0.2, agreement=Agreement(2, 3))
    manner = manner or Manner(agreement=Agreement(2, 3))
    wiring = wiring or LiveWiring(generated)
    nodes = {"hung_after": hung_after, "manner": manner}
    usual = {"baselines": baselines or Baselines(), "arrivals": wiring.arrivals}
    flow = {"heard": wiring.heard, "leave_out": OURS, "patience": window, **usual}
    return (
        observer("nodes", Start(NodeObserver, (wiring.addresses,), nodes)),
        observer("runtime", Start(RuntimeObserver, (wiring.addresses,), {"asked": wiring.asked})),
        observer("replicas", Start(ReplicaObserver, (wiring.protected,))),
        observer("topics", Start(FlowObserver, (wiring.made,), {**flow, "manner": at_topics})),
    )
