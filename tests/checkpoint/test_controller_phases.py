"""The recovery controller: phases, hooks, and its own death at every point (R12, R44, R46, R69, T17, T18).

The four parts are actors (R16); a crash is noticed by the end of the life (R28), the release is the last phase (R40).
"""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.guards import POINTS, over, part, phases, planner, running, wheels, words
from tests.checkpoint.players import Do, Doer, Note, Notes, Seen, until
from tests.checkpoint.strikes import doer, event, sink, strike, struck

ORDER = ["isolate", "restart", "restore", "replay", "release"]
PARTS = ["", "controller", "switch"]


async def test_each_phase_is_told_of_once_with_its_time(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        robot = await doer(system, isolation)
        await robot.ask(Note("one"))
        with system.events() as stream:
            strike(system, robot)
            await until(lambda: robot._cell.life == 2 and robot._cell.host.home.switch.life.is_released)  # type: ignore[attr-defined]
            await over(system)
            events = stream.take()
    told = [one for one in events if isinstance(one, hf.events.RecoveryPhase)]
    assert phases(events, robot.path) == [(1, phase) for phase in ["detect", *ORDER]]
    assert {one.recovery for one in told} == {1}
    assert all(one.seconds >= 0 for one in told)
    assert [one.since_noticed for one in told] == sorted(one.since_noticed for one in told)
    assert sum(one.seconds for one in told) == pytest.approx(told[-1].since_noticed)


async def test_hooks_are_called_in_order_and_the_recovery_waits_for_them(isolation: str) -> None:
    called: list[tuple[str, str]] = []
    released: list[bool] = []

    def note(step: hf.checkpoint.RecoveryStep) -> None:
        called.append((step.when, step.phase))
        released.append(robot._cell.host.home.switch.life.is_released)  # type: ignore[attr-defined]

    async def note_later(step: hf.checkpoint.RecoveryStep) -> None:
        await asyncio.sleep(0.01)
        note(step)

    sides: dict[str, Any] = {"before": {}, "after": {}}
    for index, (when, phase) in enumerate(POINTS):
        sides[when][phase] = note if index % 2 else note_later
    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(**sides)) as system:
        ref = await wheels(system)
        robot = await planner(system, isolation)
        called.clear()
        released.clear()
        await robot.ask(Note("one"))
        await struck(system, robot)
        await over(system)
        expected = [
            *(("before", "safe_state"), ("after", "safe_state"), ("before", "isolate"), ("after", "isolate")),
            *(("before", "restart"), ("before", "restore"), ("after", "restart"), ("after", "restore")),
            *(("before", "replay"), ("after", "replay"), ("before", "release"), ("after", "release")),
        ]
        assert called == expected
        assert released == [False] * 11 + [True]
        assert await words(ref) == ["safe", "free"]
        assert await robot.ask(Seen()) == ["one"]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_child_has_hooks_of_its_own_besides_those_of_the_system(isolation: str) -> None:
    called: list[str] = []
    hooks = hf.checkpoint.recovery_hooks(before={"restart": lambda step: called.append("the system's")})
    own = hf.checkpoint.recovery_hooks(before={"restart": lambda step: called.append(f"its own, of {step.address}")})
    async with running(recovery_hooks=hooks) as system:
        robot, other = await doer(system, isolation, hooks=own), await doer(system, isolation, "other")
        await struck(system, robot)
        await struck(system, other)
    assert called == ["the system's", "its own, of /app/doer", "the system's"]


async def test_hooks_below_a_process_are_refused_with_what_to_do(isolation: str) -> None:
    own = hf.checkpoint.recovery_hooks(before={"restart": print})
    async with running() as system:
        if isolation == "subtree":
            with pytest.raises(hf.SpecError):
                await doer(system, isolation, hooks=own)
        else:
            await doer(system, isolation, hooks=own)


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("fault", ["raises", "hangs", "swallows"])
async def test_a_hook_that_fails_or_hangs_stops_nothing(point: tuple[str, str], fault: str) -> None:
    async def bad(step: hf.checkpoint.RecoveryStep) -> None:
        if fault == "raises":
            raise OSError("no luck")
        await asyncio.sleep(3600.0)

    def bad_now(step: hf.checkpoint.RecoveryStep) -> None:
        raise OSError("no luck")

    when, phase = point
    hook = bad_now if fault == "swallows" else bad
    sides: Any = {when: {phase: hook}}
    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(**sides, timeout=0.05)) as system:
        ref = await wheels(system)
        robot = await planner(system, "task")
        await robot.ask(Note("one"))
        with system.events() as stream:
            robot.kill()
            failed = await event(stream, hf.events.RecoveryHookFailed)
        await over(system)
        assert (failed.address, failed.hook) == (robot.path, f"{when} {phase}")
        assert ("no luck" in failed.reason) == (fault != "hangs")
        assert await words(ref) == ["safe", "free"]
        assert await robot.ask(Seen()) == ["one"]


# -- who recovers the recoverer ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("victim", PARTS)
@pytest.mark.parametrize("point", POINTS)
async def test_a_part_is_killed_at_every_point(point: tuple[str, str], victim: str) -> None:
    """T18: the recovery ends all the same, and safe state is entered and left once."""
    killed = 0

    async def kill(step: hf.checkpoint.RecoveryStep) -> None:
        nonlocal killed
        if not killed:
            killed += 1
            part(system, victim).kill()
            await asyncio.sleep(0.01)

    sides: Any = {point[0]: {point[1]: kill}}
    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(**sides)) as system:
        ref = await wheels(system)
        robot, notes = await planner(system, "task"), await sink(system)
        await robot.ask(Do(["tell one", "add one"], notes))
        with system.events() as stream:
            strike(system, robot)
            asked = robot.ask(Do(["tell two", "add two"], notes), timeout=30.0)
            assert await asked == "2"
            await until(lambda: not system._homes.recoveries.all())
            await until(
                lambda: part(system, "controller")._cell.life > 0 and bool(part(system, "controller")._cell.actor)
            )
            await over(system)
            told = phases(stream.take(), robot.path)
        assert killed == 1
        assert await words(ref) == ["safe", "free"]
        assert await notes.ask(Notes()) == ["one", "two"]
        assert [phase for _, phase in told] == ["detect", "safe_state", *ORDER], "told once, by whichever life"


@pytest.mark.parametrize("victim", PARTS)
async def test_a_part_that_is_down_for_good_is_not_waited_for(isolation: str, victim: str) -> None:
    called: list[str] = []
    hooks = hf.checkpoint.recovery_hooks(before={"restart": lambda step: called.append("x")}, timeout=3600.0)
    async with running(recovery_hooks=hooks) as system:
        ref = await wheels(system)
        robot = await planner(system, isolation)
        await robot.ask(Note("one"))
        await system.stop(part(system, victim)) if victim else None
        if not victim:
            part(system, "").kill()
        if victim:
            await until(lambda: part(system, victim)._cell.actor is None)
        async with asyncio.timeout(30.0):
            await struck(system, robot)
            await until(lambda: not system._homes.recoveries.all())
        assert await words(ref) == ["safe", "free"]
        assert await robot.ask(Seen()) == ["one"]
        if victim:  # Their supervisor is started again, perhaps in time.
            assert (called == []) == (victim == "controller")


async def test_a_controller_that_ends_for_good_with_a_hook_in_hand(isolation: str) -> None:
    """The recovery waits for that hook, which would take an hour; not for a controller that is no more."""
    reached = asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        reached.set()
        await asyncio.sleep(3600.0)

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"restart": wait}, timeout=7200.0)) as system:
        ref = await wheels(system)
        robot = await planner(system, isolation)
        with system.events() as stream:
            robot.kill()
            await reached.wait()
            await system.stop(part(system, "controller"))
            await event(stream, hf.events.Recovered)
        await until(lambda: not system._homes.recoveries.all())
        assert await words(ref) == ["safe", "free"]


async def test_a_controller_that_does_not_come_to_it_is_not_waited_for(isolation: str) -> None:
    """Suspended, it lives and does nothing."""
    async with running() as system:
        ref = await wheels(system)
        robot = await planner(system, isolation)
        await system.suspend(part(system, "controller"))
        async with asyncio.timeout(30.0):
            await struck(system, robot)
        assert await words(ref) == ["safe"]
        await system.resume(part(system, "controller"))
        await over(system)
        assert await words(ref) == ["safe", "free"]


async def test_the_parts_come_back_however_often_they_end() -> None:
    """Their supervisor gives up; it is no child of the program, which goes on, and is started again."""
    async with running() as system:
        ref = await wheels(system)
        robot = await planner(system, "task")
        first = part(system, "")._cell
        while first.actor is not None:
            part(system, "controller").kill()
            await asyncio.sleep(0)
        await until(lambda: "/app/recovery/controller" in system.tree())
        assert part(system, "")._cell is not first
        await struck(system, robot)
        await over(system)
        assert await words(ref) == ["safe", "free"]


async def test_a_program_may_have_a_child_of_that_name() -> None:
    async with running() as system:
        await wheels(system, "recovery")
        await planner(system, "task", safe_state="/app/recovery")
        assert "/app/$recovery/controller" in system.tree()


async def test_there_are_no_parts_without_recorded_children() -> None:
    async with running() as system:
        await wheels(system)
        assert system.tree() == ["/app", "/app/wheels"]


# -- crashes inside a recovery ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [point for point in POINTS if point != ("after", "release")])
async def test_the_actor_ends_again_in_each_phase(isolation: str, point: tuple[str, str]) -> None:
    """R44, T17: whatever there is of its life is killed; what was done stays done, what was not is done."""
    times = 0

    async def again(step: hf.checkpoint.RecoveryStep) -> None:
        nonlocal times
        times += 1
        if times <= 2:
            cell = robot._cell
            if cell.state == "running":
                life = cell.life
                pid = system.pid_of(robot)
                robot.kill() if pid == os.getpid() else os.kill(pid, 9)
                await until(lambda: cell.life != life or cell.state != "running")

    sides: Any = {point[0]: {point[1]: again}}
    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(**sides)) as system:
        ref = await wheels(system)
        robot, notes = await planner(system, isolation), await sink(system)
        times = -1000
        await robot.ask(Do(["tell one", "add one"], notes), timeout=30.0)
        times = 0
        strike(system, robot)
        assert await robot.ask(Do(["tell two", "add two"], notes), timeout=30.0) == "2"
        await over(system)
        assert await robot.ask(Seen()) == ["one", "two"]
        assert await words(ref) == ["safe", "free"]
        assert await notes.ask(Notes()) == ["one", "two"]


async def test_a_child_that_is_terminated_in_the_middle_stays_away(isolation: str) -> None:
    """Its recovery waits at a hook when the supervisor gives the child up."""
    reached, go_on = asyncio.Event(), asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        reached.set()
        await go_on.wait()

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"restart": wait}, timeout=30.0)) as system:
        await wheels(system)
        robot = await planner(system, isolation)
        with system.events() as stream:
            robot.kill()
            await reached.wait()
            assert robot._cell.state == "down"
            stopping = asyncio.ensure_future(system.stop(robot))
            kept = await event(stream, hf.events.SafeStateKept)
            go_on.set()
            await stopping
        assert kept.address == robot.path
        assert robot.path not in system.tree()


@pytest.mark.parametrize("kind", ["task", "process"])
async def test_a_sibling_has_it_started_anew_in_the_middle(kind: Any) -> None:
    """one_for_all: the start that waits at a hook is given up; there is one new life, not two."""
    reached, go_on = asyncio.Event(), asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        reached.set()
        await go_on.wait()

    recovery = hf.hybrid(3600.0, hooks=hf.checkpoint.recovery_hooks(before={"restart": wait}, timeout=30.0))
    async with running() as system:
        children = [
            hf.child("sibling", hf.start(Doer)),
            hf.child("robot", hf.start(Doer), recovery=recovery, isolation=kind),
        ]
        await system.start(hf.supervisor("top", strategy="one_for_all", intensity=100, children=children))
        robot, sibling = system.ref("/app/top/robot", Doer), system.ref("/app/top/sibling", Doer)
        await robot.ask(Note("one"))
        for _ in range(3):
            reached.clear()
            sibling.kill()
            await reached.wait()
            await asyncio.sleep(0.01)
            assert (robot._cell.state, robot._cell.life) == ("down", 1)
        go_on.set()
        assert await robot.ask(Seen(), timeout=30.0) == ["one"]
        await over(system)
        assert robot._cell.life == 2


async def test_a_system_ends_in_the_middle_of_a_recovery(isolation: str) -> None:
    reached = asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        reached.set()
        await asyncio.sleep(3600.0)

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"restart": wait}, timeout=7200.0)) as system:
        await wheels(system)
        robot = await planner(system, isolation)
        strike(system, robot)
        await reached.wait()


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_recovery_that_is_given_up_is_over_and_the_next_one_counts_anew(isolation: Any) -> None:
    async with running() as system:
        spec = hf.child("robot", hf.start(Doer), isolation=isolation, recovery=hf.hybrid(interval=3600.0))
        await system.start(hf.supervisor("team", children=[spec], intensity=0))
        robot = system.ref("/app/team/robot", Doer)
        await robot.ask(Note("one"))
        with system.events() as stream:
            strike(system, robot)
            await until(lambda: robot._cell.is_dead)
            await over(system)
            told = [one for one in stream.take() if isinstance(one, hf.events.RecoveryPhase)]
    assert [(one.recovery, one.attempt, one.phase) for one in told] == [
        (1, 1, "detect"),
        *((2, 1, one) for one in ORDER),
    ]
