"""Plain objects and callback-style programs as recovered actors, their code unchanged (R9, R17)."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Note, Notes, start, until
from tests.checkpoint.strikes import NEVER, actor_of, home, strike


class Arm:
    def __init__(self) -> None:
        self.angle = 0.0


class Robot:
    """As somebody wrote it who never heard of actors."""

    def __init__(self, x: float = 0.0) -> None:
        self.x, self.log = x, list[str]()
        self._cache = object()

    def move(self, by: float, *, times: int = 1) -> float:
        self.x += by * times
        self.log.append(f"move {by}")
        return self.x

    async def look(self, name: str = "all", parts: list[str] = []) -> list[str]:  # noqa: B006 - as people write it
        await asyncio.sleep(0)
        return [*self.log, name, *parts]

    def turn(self, message: Turn) -> None:
        self.log.append(f"turn {message.degrees}")

    def _hidden(self) -> None: ...


class Turn(hf.Message):
    degrees: int


class Move(hf.Message[float]):
    times: int
    by: float


RobotActor = hf.adapters.wrap(Robot, "RobotActor")
Chosen = hf.adapters.wrap(Robot, "Chosen", methods={Move: "move", Turn: "turn"}, key_variables=["x"])
robot = hf.adapters.calls(Robot)


class Scan(hf.Message):
    n: int


class Goal(hf.Message):
    n: int


class Navigator:
    """A callback-style program: it registers its callbacks, and speaks through what it was given."""

    def __init__(self, subscribe: Callable[..., Any], publish: Callable[..., Any]) -> None:
        self.goal, self.seen, self.ticks = 0, list[int](), 0
        self._publish = publish
        subscribe("/goal", self.on_goal)
        subscribe("/scan", self.on_scan)
        subscribe("/scan", self.on_scan_too)

    def on_goal(self, message: Goal) -> None:
        self.goal = message.n

    def on_scan(self, message: Scan) -> None:
        self.seen.append(message.n * self.goal)
        self._publish("/out", Note(f"{self.goal}:{message.n}"))

    async def on_scan_too(self, message: Scan) -> None:
        await asyncio.sleep(0)
        self.seen.append(-message.n)

    def state(self) -> list[int]:
        return [self.goal, *self.seen]


class State(hf.Message[list[int]]): ...


def navigator(bus: hf.adapters.Bus) -> Navigator:
    """All there is to write: what the program calls subscribing and publishing."""
    return Navigator(bus.subscribe, bus.publish)


NavigatorActor = hf.adapters.wrap(
    navigator, "NavigatorActor", methods={State: "state"}, callbacks={"/goal": Goal, "/scan": Scan}
)
Direct = hf.adapters.wrap(Robot, "Direct", callbacks={"/turn": (Turn, "turn")}, methods={Move: "move"})


class Out(hf.Actor):
    def __init__(self) -> None:
        self.notes: list[str] = []

    @hf.subscribe("/out")
    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.notes.append(message.text)
        return len(self.notes)

    @hf.on(Notes, readonly=True)
    def read(self, message: Notes) -> list[str]:
        return list(self.notes)


async def test_methods_are_called_by_messages_and_the_state_comes_back(isolation: str, store: str | None) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        recipe = hf.start(RobotActor, 1.0)
        ref = await start(system, isolation, "robot", recipe, recovery=hf.hybrid(0.01))
        assert await ref.ask(robot.move(2.0)) == 3.0
        assert await ref.ask(robot.move(2.0, times=2)) == 7.0
        for _ in range(2):
            strike(system, ref)
            assert await ref.ask(robot.look("x", ["y"]), timeout=30.0) == ["move 2.0", "move 2.0", "x", "y"]
        assert await ref.ask(robot.move(0.0)) == 7.0


async def test_chosen_methods_by_fields_or_with_the_whole_message(isolation: str) -> None:
    """Fields are arguments by name, whatever their order."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await start(system, isolation, "robot", hf.start(Chosen), recovery=hf.checkpoint_only(0.005))
        ref.tell(Turn(90))
        assert await ref.ask(Move(3, 2.0)) == 6.0
        switch = home(ref)
        await until(lambda: switch.ledger.state_turn >= 2)
        strike(system, ref)
        assert await ref.ask(Move(0, 0.0), timeout=30.0) == 6.0


async def test_a_callback_style_program_is_fed_from_topics_and_recovered(isolation: str, store: str | None) -> None:
    """What it publishes leaves once, and its callbacks are registered anew with each life."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        out = await system.start(hf.child("out", hf.start(Out)))
        ref = await start(system, isolation, "nav", hf.start(NavigatorActor), recovery=hf.hybrid(NEVER))
        await system.publish("/goal", Goal(10))
        for n in (1, 2, 3):
            await system.publish("/scan", Scan(n))
            with contextlib.suppress(
                ProcessLookupError, hf.errors.NoSuchActor
            ):  # It is still dead from the time before.
                strike(system, ref)
        assert await ref.ask(State(), timeout=30.0) == [10, 10, -1, 20, -2, 30, -3]
        assert await out.ask(Notes()) == ["10:1", "10:2", "10:3"]


async def test_a_topic_can_feed_a_method(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("robot", hf.start(Direct), recovery=hf.hybrid()))
    await system.publish("/turn", Turn(7))
    assert await ref.ask(Move(1, 1.0)) == 1.0
    assert actor_of(ref).program.log == ["turn 7", "move 1.0"]


class Announcer:
    """Publishes from whatever is called: a callback of its own, or a method that a topic or a message calls."""

    def __init__(self, bus: hf.adapters.Bus) -> None:
        self._bus = bus
        bus.subscribe("/goal", self.on_goal)

    def on_goal(self, message: Goal) -> None:
        self._bus.publish("/out", Note(f"goal {message.n}"))

    async def on_turn(self, message: Turn) -> None:
        self._bus.publish("/out", Note("turn"))

    def state(self) -> list[int]:
        self._bus.publish("/out", Note("state"))
        return [1]


AnnouncerActor = hf.adapters.wrap(
    Announcer, "AnnouncerActor", methods={State: "state"}, callbacks={"/goal": Goal, "/turn": (Turn, "on_turn")}
)


async def test_what_any_call_of_a_program_sends_leaves_with_it(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        out = await system.start(hf.child("out", hf.start(Out)))
        ref = await start(system, isolation, "announcer", hf.start(AnnouncerActor), recovery=hf.hybrid())
        assert await ref.ask(State(), timeout=30.0) == [1]
        await system.publish("/turn", Turn(7))
        await system.publish("/goal", Goal(3))
        assert await ref.ask(State(), timeout=30.0) == [1]
        assert await out.ask(Notes()) == ["state", "turn", "goal 3", "state"]


class Clockwork:
    def __init__(self, bus: hf.adapters.Bus) -> None:
        self.ticks = list[float]()
        self._bus = bus
        bus.every(1.0, self.tick)

    def tick(self) -> None:
        self.ticks.append(self._bus.now() + self._bus.random.random())


ClockworkActor = hf.adapters.wrap(Clockwork, "ClockworkActor", callbacks={"/scan": Scan})


@pytest.mark.parametrize("recovery", [None, hf.hybrid(NEVER), hf.hybrid(1.5)])
@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_programs_timers_go_on_over_crashes(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(hf.child("clock", hf.start(ClockworkActor), recovery=recovery))
    await asyncio.sleep(3.5)
    before = list(actor_of(ref).program.ticks)
    assert len(before) == 3
    ref.kill()
    await asyncio.sleep(2.1)
    after = actor_of(ref).program.ticks
    assert len(after) == (2 if recovery is None else 5)
    assert recovery is None or after[:3] == before, "time and random numbers too"


async def test_what_a_program_may_not_do_with_its_bus(system: hf.ActorSystem) -> None:
    def late(bus: hf.adapters.Bus) -> Any:
        class Late:
            def state(self) -> list[int]:
                bus.subscribe("/scan", print)
                return []

        return Late()

    def hasty(bus: hf.adapters.Bus) -> Any:
        bus.publish("/scan", Scan(1))

    def lost(bus: hf.adapters.Bus) -> Any:
        bus.subscribe("/elsewhere", print)

    ref = system.spawn(hf.start(hf.adapters.wrap(late, callbacks={"/scan": Scan}, methods={State: "state"})), "late")
    with pytest.raises(hf.RemoteCrash, match="registered while the program is made"):
        await ref.ask(State())
    with pytest.raises(hf.StartFailed, match="sends from its callbacks"):
        system.spawn(hf.start(hf.adapters.wrap(hasty, callbacks={"/scan": Scan})), "hasty")
    with pytest.raises(hf.StartFailed, match="does not say what comes on '/elsewhere'"):
        system.spawn(hf.start(hf.adapters.wrap(lost, callbacks={"/scan": Scan})), "lost")


async def test_a_class_that_is_not_found_by_its_name_cannot_live_in_a_process(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.HoldfastError, match="Elsewhere"):
        await system.start(hf.child("x", hf.start(hf.adapters.wrap(Robot, "Elsewhere")), isolation="process"))


class Rest:
    def all(self, *parts: int) -> None: ...


def test_what_does_not_fit_is_refused_when_it_is_wrapped() -> None:
    with pytest.raises(TypeError, match=r"Rest.all takes \*parts"):
        hf.adapters.wrap(Rest)
    with pytest.raises(TypeError, match="Robot has no method 'fly'"):
        hf.adapters.wrap(Robot, methods={Move: "fly"})
    with pytest.raises(TypeError, match=r"Robot.move cannot be called with .*Turn: it has no field 'by'"):
        hf.adapters.wrap(Robot, methods={Turn: "move"})
    with pytest.raises(TypeError, match="is no class"):
        hf.adapters.wrap(navigator)
    with pytest.raises(TypeError, match="two handlers"):
        hf.adapters.wrap(navigator, callbacks={"/a": Scan, "/b": Scan})
    with pytest.raises(AttributeError, match="no public method '_hidden'"):
        robot.__getattr__("_hidden")
    assert hf.adapters.calls(Robot) is robot
    assert robot.look() == robot.look("all", [])


def farther(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "x": state["x"] + 10.0}


def wrong(state: dict[str, Any]) -> dict[str, Any]:
    state["log"].append("wrong")
    return {"x": 0.0, "log": state["log"], "arm.angle": 0.0}  # It has no arm.


class Arms:
    def __init__(self) -> None:
        self.left, self.right = Arm(), Arm()

    def lift(self, by: float) -> float:
        self.left.angle += by
        return self.left.angle


ArmsActor = hf.adapters.wrap(Arms, "ArmsActor", key_variables=["left.angle"])


@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
async def test_control_sees_the_programs_variables(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(hf.child("robot", hf.start(RobotActor, 1.0), recovery=recovery))
    assert await system.get_state(ref) == {"x": 1.0, "log": []}
    with pytest.raises(hf.errors.ControlFailed):
        await system.replace_state(ref, wrong)
    assert await system.replace_state(ref, farther) == {"x": 11.0, "log": []}
    await system.set_isolation(ref, "process")
    assert await ref.ask(robot.move(1.0)) == 12.0
    await system.set_isolation(ref, "task")
    assert await system.get_state(ref) == {"x": 12.0, "log": ["move 1.0"]}


async def test_control_sees_variables_inside_others(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("arms", hf.start(ArmsActor)))
    assert await ref.ask(hf.adapters.calls(Arms).lift(2.0)) == 2.0
    assert await system.replace_state(ref, lambda state: {"left.angle": state["left.angle"] + 1}) == {"left.angle": 3.0}
    assert await ref.ask(hf.adapters.calls(Arms).lift(0.0)) == 3.0
