"""Trees of random shape under random crashes, kills, ends and admin calls, against a model of OTP's rules.

The model knows the specs, who runs, and in which life; it is a page long and has no mailboxes. After each step the
living system must look as the model says: which children there are, their states, and the lives of those that run.
"""

import asyncio
import dataclasses
from typing import Any, Literal

import hypothesis.strategies as st
from hypothesis import given, settings

import holdfast as hf
from holdfast.supervision.spec import Restart, Strategy
from holdfast.supervision.supervisor import DeleteChild, RestartChild, StartChild, TerminateChild, WhichChildren
from holdfast.testing.clock import virtual

STRATEGIES: tuple[Strategy, ...] = ("one_for_one", "one_for_all", "rest_for_one")
RESTARTS: tuple[Restart, ...] = ("permanent", "transient", "temporary")
Action = Literal["crash", "kill", "leave", "terminate", "restart", "delete", "start", "wait"]
ACTIONS: tuple[Action, ...] = ("crash", "kill", "leave", "terminate", "restart", "delete", "start", "wait")
PERIOD = 5.0


class Boom(hf.Message): ...


class Leave(hf.Message): ...


class Born(hf.Message[int]): ...


class Kid(hf.Actor):
    """Knows how many actors were started at its address before it."""

    def __init__(self, births: dict[str, int]) -> None:
        path = self.ctx.path
        self.number = births[path] = births.get(path, 0) + 1

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop()

    @hf.on(Born)
    def born(self, message: Born) -> int:
        return self.number


@dataclasses.dataclass
class One:
    """A child of the model: a leaf, or a supervisor with `below`."""

    id: str
    restart: Restart
    below: "Group | None" = None
    is_up: bool = True


@dataclasses.dataclass
class Group:
    """A supervisor of the model."""

    strategy: Strategy
    intensity: int
    shape: list["Shape"]
    path: str
    births: dict[str, int]
    children: list[One] = dataclasses.field(default_factory=list)
    restarts: list[float] = dataclasses.field(default_factory=list)

    def start_all(self) -> None:
        self.restarts.clear()
        self.children = [One(f"c{i}", shape.restart) for i, shape in enumerate(self.shape)]
        for one, shape in zip(self.children, self.shape, strict=True):
            self.start(one, shape)

    def start(self, one: One, shape: "Shape | None" = None) -> None:
        one.is_up = True
        path = f"{self.path}/{one.id}"
        if shape is not None and shape.below:
            one.below = Group(shape.strategy, shape.intensity, shape.below, path, self.births)
        if one.below is not None:
            one.below.start_all()
        else:
            self.births[path] = self.births.get(path, 0) + 1

    def ended(self, one: One, *, clean: bool, now: float) -> bool:
        """A child has ended by itself. False: we have given up."""
        one.is_up = False
        if one.restart == "temporary":
            self.children.remove(one)
            return True
        if one.restart == "transient" and clean:
            return True
        self.restarts = [then for then in self.restarts if now - then <= PERIOD] + [now]
        if len(self.restarts) > self.intensity:
            return False
        at = self.children.index(one)
        group = {"one_for_one": [one], "one_for_all": self.children, "rest_for_one": self.children[at:]}[self.strategy]
        kept = [other for other in group if other is one or other.restart != "temporary"]
        self.children = [other for other in self.children if other in kept or other not in group]
        for other in kept:
            self.start(other)
        return True


@dataclasses.dataclass(frozen=True)
class Shape:
    restart: Restart
    strategy: Strategy = "one_for_one"
    intensity: int = 1
    below: "list[Shape]" = dataclasses.field(default_factory=list)

    def spec(self, id: str, births: dict[str, int]) -> hf.ChildSpec:
        if not self.below:
            return hf.child(id, hf.start(Kid, births), restart=self.restart)
        children = [shape.spec(f"c{i}", births) for i, shape in enumerate(self.below)]
        return hf.supervisor(
            id,
            strategy=self.strategy,
            intensity=self.intensity,
            period=PERIOD,
            children=children,
            restart=self.restart,
        )


leaves = st.builds(Shape, st.sampled_from(RESTARTS))


def trees(below: st.SearchStrategy[Shape]) -> st.SearchStrategy[Shape]:
    return st.builds(
        Shape,
        st.sampled_from(RESTARTS),
        st.sampled_from(STRATEGIES),
        st.integers(0, 3),
        st.lists(below, min_size=1, max_size=4),
    )


shapes = trees(leaves | trees(leaves))
steps = st.lists(st.tuples(st.sampled_from(ACTIONS), st.integers(0, 30), st.integers(0, 7)), max_size=15)


@given(shape=shapes, steps=steps)
@settings(max_examples=120)
def test_a_tree_behaves_as_the_model_says(shape: Shape, steps: list[tuple[Action, int, int]]) -> None:
    with asyncio.Runner(loop_factory=virtual) as runner:
        runner.run(live(dataclasses.replace(shape, restart="temporary"), steps))


async def live(shape: Shape, steps: list[tuple[Action, int, int]]) -> None:
    births: dict[str, int] = {}
    real_births: dict[str, int] = {}
    async with hf.ActorSystem("app", log=False) as system:
        top = Group(shape.strategy, shape.intensity, shape.below, "/app/top", births)
        top.start_all()
        await system.start(shape.spec("top", real_births))
        for action, which, seconds in steps:
            places = list(everywhere(top, []))
            owners, one = places[which % len(places)] if places else ([top], None)
            if not await step(system, owners, one, action, seconds, real_births):
                await rest(system)
                assert system.tree() == ["/app"]
                return
            await rest(system)
            await compare(system, top, real_births)


def everywhere(group: Group, above: list[Group]) -> Any:
    """Every child with the supervisors above it, outermost first."""
    owners = [*above, group]
    for one in group.children:
        yield owners, one
        if one.below is not None and one.is_up:
            yield from everywhere(one.below, owners)


async def step(
    system: hf.ActorSystem, owners: list[Group], one: One | None, action: Action, seconds: int, births: dict[str, int]
) -> bool:
    """Do it to the system and to the model. False: the whole tree is gone."""
    owner = owners[-1]
    supervisor = system.ref(owner.path, hf.Supervisor)
    now = asyncio.get_running_loop().time()
    if action == "wait":
        await asyncio.sleep(seconds)
        return True
    if action == "start":
        known = [other.id for other in owner.children]
        name = f"d{seconds}"
        if name not in known:
            await supervisor.ask(StartChild(hf.child(name, hf.start(Kid, births), restart=RESTARTS[seconds % 3])))
            owner.children.append(One(name, RESTARTS[seconds % 3]))
            owner.start(owner.children[-1])
        return True
    if one is None:
        return True
    if action == "terminate":
        await supervisor.ask(TerminateChild(one.id))
        one.is_up = False
        if one.restart == "temporary":
            owner.children.remove(one)
    elif action == "restart" and not one.is_up:
        await supervisor.ask(RestartChild(one.id))
        owner.start(one)
    elif action == "delete" and not one.is_up:
        await supervisor.ask(DeleteChild(one.id))
        owner.children.remove(one)
    elif action in ("crash", "kill", "leave") and one.is_up:
        ref = system.ref(f"{owner.path}/{one.id}", hf.Actor)
        if action == "kill" or one.below is not None:
            ref.kill()
        else:
            ref.tell(Boom() if action == "crash" else Leave())
        clean = action == "leave" and one.below is None
        return escalate(owners, one, clean, now)
    return True


def escalate(owners: list[Group], one: One, clean: bool, now: float) -> bool:
    """A supervisor that gives up ends with a clean reason, which its own supervisor judges."""
    for depth in range(len(owners) - 1, -1, -1):
        if owners[depth].ended(one, clean=clean, now=now):
            return True
        if depth:
            one = next(other for other in owners[depth - 1].children if other.below is owners[depth])
            clean = True
    return False


async def rest(system: hf.ActorSystem) -> None:
    """Until nothing happens any more; a start that has ended may yet be told of in the next tick."""
    for _ in range(20):
        await system.node.settled()


async def compare(system: hf.ActorSystem, group: Group, births: dict[str, int]) -> None:
    infos = await system.ref(group.path, hf.Supervisor).ask(WhichChildren())
    assert [(info.id, info.state) for info in infos] == [
        (one.id, "running" if one.is_up else "stopped") for one in group.children
    ]
    for one in group.children:
        path = f"{group.path}/{one.id}"
        assert (path in system.tree()) == one.is_up
        if one.is_up and one.below is not None:
            await compare(system, one.below, births)
        elif one.is_up:
            assert await system.ref(path, Kid).ask(Born()) == births[path] == group.births[path]
