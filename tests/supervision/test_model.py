"""Trees of random shape under random ends, starts that fail or ignore, and admin calls, against OTP's rules as a model.

The model knows the specs, who runs, and how often each was started; it is a page long and has no mailboxes. After each
step the living system must look as the model says: which children there are, their states, and their births.
"""

import asyncio
import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Literal

import hypothesis.strategies as st
from hypothesis import given, settings

import holdfast as hf
from holdfast.supervision.spec import AutoShutdown, Restart, Strategy
from holdfast.testing.clock import virtual

STRATEGIES: tuple[Strategy, ...] = ("one_for_one", "one_for_all", "rest_for_one")
RESTARTS: tuple[Restart, ...] = ("permanent", "transient", "temporary")
AUTO: tuple[AutoShutdown, ...] = ("never", "any_significant", "all_significant")
Action = Literal[
    "crash", "kill", "leave", "terminate", "restart", "delete", "start", "wait", "fail", "ignore", "change", "flags"
]
ACTIONS: tuple[Action, ...] = Action.__args__  # type: ignore[attr-defined]
PERIOD = 5.0


class Boom(hf.Message): ...


class Leave(hf.Message): ...


class Born(hf.Message[int]): ...


class Failed(Exception):
    """The model's StartFailed."""


class Ignored(Exception):
    """The model's Ignore."""


@dataclasses.dataclass
class Fate:
    """What comes of starts, by address. The system has one, the model another: they must agree in the end."""

    births: dict[str, int] = dataclasses.field(default_factory=dict)
    failing: dict[str, int] = dataclasses.field(default_factory=dict)
    ignoring: set[str] = dataclasses.field(default_factory=set)

    def born(self, path: str) -> int:
        if self.failing.get(path, 0):
            self.failing[path] -= 1
            raise Failed(path)
        if path in self.ignoring:
            self.ignoring.discard(path)
            raise Ignored(path)
        self.births[path] = self.births.get(path, 0) + 1
        return self.births[path]


class Kid(hf.Actor):
    """Knows how many actors were started at its address before it."""

    def __init__(self, fate: Fate) -> None:
        try:
            self.number = fate.born(self.ctx.path)
        except Ignored as no:
            raise hf.Ignore from no

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop()

    @hf.on(Born)
    def born(self, message: Born) -> int:
        return self.number


@dataclasses.dataclass(frozen=True)
class Shape:
    """A child as it is drawn: a leaf, or a supervisor with `below`."""

    restart: Restart
    wants_significant: bool = False
    strategy: Strategy = "one_for_one"
    intensity: int = 1
    auto: AutoShutdown = "never"
    below: "tuple[Shape, ...]" = ()

    def is_significant(self, auto: AutoShutdown) -> bool:
        return self.wants_significant and auto != "never" and self.restart != "permanent"

    def spec(self, id: str, fate: Fate, auto: AutoShutdown) -> hf.ChildSpec:
        significant = self.is_significant(auto)
        if not self.below:
            return hf.child(id, hf.start(Kid, fate), restart=self.restart, significant=significant)
        return hf.supervisor(
            id,
            strategy=self.strategy,
            intensity=self.intensity,
            period=PERIOD,
            auto_shutdown=self.auto,
            children=[shape.spec(f"c{i}", fate, self.auto) for i, shape in enumerate(self.below)],
            restart=self.restart,
            significant=significant,
        )


@dataclasses.dataclass(eq=False)
class One:
    """A child of the model."""

    id: str
    shape: Shape
    significant: bool
    below: "Group | None" = None
    is_up: bool = False


class Group:
    """A supervisor of the model."""

    def __init__(self, shape: Shape, path: str, fate: Fate) -> None:
        """Start it: all its children, left to right. Raises Failed."""
        self.path, self.fate = path, fate
        self.strategy, self.intensity, self.auto = shape.strategy, shape.intensity, shape.auto
        self.restarts: list[float] = []
        self.children = [One(f"c{i}", below, below.is_significant(shape.auto)) for i, below in enumerate(shape.below)]
        for one in list(self.children):
            self.start(one)

    def start(self, one: One) -> None:
        """Raises Failed. One that ignores stays without a life, or goes if it is temporary."""
        path = f"{self.path}/{one.id}"
        one.is_up = False
        try:
            if one.shape.below:
                one.below = Group(one.shape, path, self.fate)
            else:
                self.fate.born(path)
        except Ignored:
            self.drop(one)
        else:
            one.is_up = True

    def drop(self, one: One) -> None:
        one.is_up = False
        if one.shape.restart == "temporary" and one in self.children:
            self.children.remove(one)

    def ended(self, one: One, *, clean: bool, now: float) -> bool:
        """A child has ended by itself. False: that is our end too."""
        one.is_up = False
        restart = one.shape.restart
        if restart == "temporary" or (restart == "transient" and clean):
            self.drop(one)
            if not one.significant or self.auto == "never":
                return True
            return self.auto == "all_significant" and any(other.significant and other.is_up for other in self.children)
        while True:
            self.restarts = [then for then in self.restarts if now - then <= PERIOD] + [now]
            if len(self.restarts) > self.intensity:
                return False
            failed = self.attempt(one)
            if failed is None:
                return True
            one = failed

    def attempt(self, one: One) -> One | None:
        """One restart by the strategy; returns who did not start."""
        at = self.children.index(one)
        group = {"one_for_one": [one], "one_for_all": self.children, "rest_for_one": self.children[at:]}[self.strategy]
        for other in list(group):
            if other is not one:
                self.drop(other)
        for other in [other for other in group if other in self.children]:
            try:
                self.start(other)
            except Failed:
                return other
        return None

    def everywhere(self, above: "list[Group]") -> "Iterator[tuple[list[Group], One]]":
        """Every child with the supervisors above it, outermost first."""
        owners = [*above, self]
        for one in self.children:
            yield owners, one
            if one.below is not None and one.is_up:
                yield from one.below.everywhere(owners)


leaves = st.builds(Shape, st.sampled_from(RESTARTS), st.booleans())


def trees(below: st.SearchStrategy[Shape]) -> st.SearchStrategy[Shape]:
    return st.builds(
        Shape,
        st.sampled_from(RESTARTS),
        st.booleans(),
        st.sampled_from(STRATEGIES),
        st.integers(0, 3),
        st.sampled_from(AUTO),
        st.lists(below, min_size=1, max_size=4).map(tuple),
    )


shapes = trees(leaves | trees(leaves | trees(leaves)))
steps = st.lists(st.tuples(st.sampled_from(ACTIONS), st.integers(0, 30), st.integers(0, 7)), max_size=15)


@given(shape=shapes, steps=steps)
@settings(max_examples=150)
def test_a_tree_behaves_as_the_model_says(shape: Shape, steps: list[tuple[Action, int, int]]) -> None:
    with asyncio.Runner(loop_factory=virtual) as runner:
        runner.run(live(dataclasses.replace(shape, restart="temporary", wants_significant=False), steps))


async def live(shape: Shape, steps: list[tuple[Action, int, int]]) -> None:
    fate = Fate()
    async with hf.ActorSystem("app", log=False) as system:
        top = Group(shape, "/app/top", Fate())
        await system.start(shape.spec("top", fate, "never"))
        for action, which, number in steps:
            places = list(top.everywhere([]))
            owners, one = places[which % len(places)] if places else ([top], None)
            alive = await Step(system, fate, owners, one, number).do(action)
            await rest(system)
            assert fate == top.fate
            if not alive:
                assert system.tree() == ["/app"]
                return
            await compare(system, top)


class Step:
    """One thing that is done to the system and to the model. False: it is the end of the whole tree."""

    def __init__(self, system: hf.ActorSystem, fate: Fate, owners: list[Group], one: One | None, number: int) -> None:
        self.system, self.fate, self.owners, self.one, self.number = system, fate, owners, one, number
        self.owner = owners[-1]
        self.supervisor = system.ref(self.owner.path, hf.Supervisor)

    async def do(self, action: Action) -> bool:
        one, owner = self.one, self.owner
        if action == "wait":
            await asyncio.sleep(self.number)
        elif action == "start":
            await self.start()
        elif action == "flags":
            await self.flags()
        elif one is None:
            return True
        elif action == "fail":
            for fate in (self.fate, owner.fate):
                fate.failing[f"{owner.path}/{one.id}"] = 1 + self.number % 3
        elif action == "ignore":
            for fate in (self.fate, owner.fate):
                fate.ignoring.add(f"{owner.path}/{one.id}")
        elif action == "terminate":
            await self.supervisor.ask(hf.TerminateChild(one.id))
            owner.drop(one)
        elif action == "restart" and not one.is_up:
            await self.restart(one)
        elif action == "delete" and not one.is_up:
            await self.supervisor.ask(hf.DeleteChild(one.id))
            owner.children.remove(one)
        elif action == "change":
            await self.change(one)
        elif action in ("crash", "kill", "leave") and one.is_up:
            return self.end(one, action)
        return True

    async def start(self) -> None:
        name, shape = f"d{self.number}", Shape(RESTARTS[self.number % 3])
        if name in [other.id for other in self.owner.children]:
            return
        one = One(name, shape, False)
        self.owner.children.append(one)
        call = self.supervisor.ask(hf.StartChild(shape.spec(name, self.fate, "never")))
        try:
            self.owner.start(one)
        except Failed:
            self.owner.children.remove(one)
        with contextlib.suppress(hf.StartFailed):
            await call

    async def restart(self, one: One) -> None:
        with contextlib.suppress(Failed):
            self.owner.start(one)
        with contextlib.suppress(hf.StartFailed):
            await self.supervisor.ask(hf.RestartChild(one.id))

    async def flags(self) -> None:
        """New flags, until the supervisor is itself restarted; those that do not fit its children are refused."""
        owner = self.owner
        strategy, auto = STRATEGIES[self.number % 3], AUTO[self.number % 2]
        flags = hf.supervision.Flags(strategy, self.number % 4, PERIOD, auto)
        if auto == "never" and any(one.significant for one in owner.children):
            with contextlib.suppress(hf.SpecError):
                await self.supervisor.ask(hf.supervision.ChangeSupervisor(flags))
                raise AssertionError("it was taken")
        else:
            await self.supervisor.ask(hf.supervision.ChangeSupervisor(flags))
            owner.strategy, owner.intensity, owner.auto = strategy, self.number % 4, auto

    async def change(self, one: One) -> None:
        """One child's restart type is changed, and it is put in front of the others."""
        owner = self.owner
        restart: Restart = RESTARTS[self.number % 3]
        if one.significant and restart == "permanent":
            return
        one.shape = dataclasses.replace(one.shape, restart=restart)
        spec = await self.supervisor.ask(hf.supervision.GetChildSpec(one.id))
        await self.supervisor.ask(
            hf.supervision.ChangeSupervisor(children=[dataclasses.replace(spec, restart=restart)])
        )
        owner.children.remove(one)
        owner.children.insert(0, one)

    def end(self, one: One, action: Action) -> bool:
        """It ends by itself. A supervisor that gives up ends clean, which the one above it judges."""
        ref = self.system.ref(f"{self.owner.path}/{one.id}", hf.Actor)
        clean = action == "leave"
        if action == "kill" or (one.below is not None and not clean):
            ref.kill()
        elif one.below is not None:
            ref.stop()
        else:
            ref.tell(Leave() if clean else Boom())
        now = asyncio.get_running_loop().time()
        for depth in range(len(self.owners) - 1, -1, -1):
            if self.owners[depth].ended(one, clean=clean, now=now):
                return True
            if depth:
                one = next(other for other in self.owners[depth - 1].children if other.below is self.owners[depth])
                clean = True
        return False


async def rest(system: hf.ActorSystem) -> None:
    """Until nothing happens any more; a start that has ended may yet be told of in the next tick."""
    for _ in range(30):
        await system._node.settled()


async def compare(system: hf.ActorSystem, group: Group) -> None:
    supervisor = system.ref(group.path, hf.Supervisor)
    infos = await supervisor.ask(hf.WhichChildren())
    assert [(info.id, info.state) for info in infos] == [
        (one.id, "running" if one.is_up else "stopped") for one in group.children
    ]
    active = sum(one.is_up for one in group.children)
    nested = sum(one.below is not None or bool(one.shape.below) for one in group.children)
    total = len(group.children)
    assert await supervisor.ask(hf.supervision.CountChildren()) == hf.supervision.ChildCounts(
        total, active, nested, total - nested
    )
    for one in group.children:
        path = f"{group.path}/{one.id}"
        assert (path in system.tree()) == one.is_up
        if one.is_up and one.below is not None:
            await compare(system, one.below)
        elif one.is_up:
            assert await system.ref(path, Kid).ask(Born()) == group.fate.births[path]
