"""Safe state: entered with a crash, left when all is over (R29-R31, T18, T26, T27)."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.guards import (
    Faint,
    Halt,
    Planner,
    Resume,
    Wheels,
    over,
    part,
    phases,
    planner,
    running,
    wheels,
    words,
)
from tests.checkpoint.players import Do, Doer, Note, Seen, start, until
from tests.checkpoint.strikes import event, strike, struck


async def test_a_receiver_is_safe_from_the_crash_to_the_release(store: str | None, isolation: str) -> None:
    """The hook before the release sees it safe already; the one after it, free."""
    seen: list[tuple[str, list[str]]] = []

    async def look(step: hf.checkpoint.RecoveryStep) -> None:
        seen.append((f"{step.when} {step.phase}", await words(ref)))

    hooks = hf.checkpoint.recovery_hooks(
        before={"restart": look, "release": look}, after={"release": look}, timeout=30.0
    )
    async with running(store, recovery_hooks=hooks) as system:
        ref = await wheels(system)
        robot = await planner(system, isolation)
        await robot.ask(Note("one"))
        await struck(system, robot)
        await over(system)
        assert await words(ref) == ["safe", "free"]
        assert seen == [("before restart", ["safe"]), ("before release", ["safe"]), ("after release", ["safe", "free"])]
        assert await robot.ask(Seen()) == ["one"]


async def test_named_addresses_are_told_with_messages(isolation: str) -> None:
    state = hf.checkpoint.safe_state("/app/wheels", "/app/arm", enter=Halt(0.5), leave=Resume())
    async with running() as system:
        both = [await wheels(system), await wheels(system, "arm", isolation="process")]
        robot = await planner(system, isolation, safe_state=state)
        await struck(system, robot)
        await over(system)
        for ref in both:
            assert await words(ref) == ["halt 0.5", "resume"]


async def test_a_binding_is_followed_to_where_it_leads_now(isolation: str) -> None:
    async with running() as system:
        first, second = await wheels(system), await wheels(system, "second")
        spec: dict[str, Any] = {"recovery": hf.hybrid(safe_state="wheels"), "bindings": {"wheels": "/app/wheels"}}
        robot = await start(system, isolation, "planner", hf.start(Planner), **spec)
        await struck(system, robot)
        await over(system)
        system.bind(robot, "wheels", second)
        await struck(system, robot)
        await over(system)
        assert (await words(first), await words(second)) == (["safe", "free"], ["safe", "free"])


async def test_a_recorded_receiver_has_it_in_its_journal(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        recovery = hf.hybrid(interval=3600.0)
        kind: Any = "process" if isolation == "process" else "task"
        ref = await wheels(system, recovery=recovery, isolation=kind)
        robot = await planner(system, isolation)
        for _ in range(2):
            await struck(system, robot)
            await over(system)
        await struck(system, ref)
        assert await words(ref) == ["safe", "free", "safe", "free"]


async def test_a_receiver_that_is_restarted_meanwhile_is_told_again() -> None:
    """Its new life knows nothing; it hears of it before what had waited."""
    go_on = asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        await go_on.wait()

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"release": wait}, timeout=30.0)) as system:
        ref = await wheels(system)
        robot = await planner(system, "task")
        robot.kill()
        await until(lambda: bool(system._homes.recoveries.safety.holds(robot.path)))
        await words(ref)
        ref.tell(Faint())
        ref.tell(Resume())
        await until(lambda: ref._cell.life == 2)
        assert await words(ref) == ["safe", "resume"]
        go_on.set()
        await over(system)
        assert await words(ref) == ["safe", "resume", "free"]


async def test_a_receiver_without_room_is_told_when_it_has_some() -> None:
    go_on = asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        await go_on.wait()

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"release": wait}, timeout=30.0)) as system:
        ref = await wheels(system, mailbox=hf.bounded(1))
        robot = await planner(system, "task")
        await system.suspend(ref)
        ref.tell(Resume())
        robot.kill()
        await until(lambda: bool(system._homes.recoveries.safety.holds(robot.path)))
        await system.resume(ref)
        await until(lambda: ref._cell.actor.words == ["resume", "safe"])  # type: ignore[union-attr]
        go_on.set()
        await over(system)
        assert await words(ref) == ["resume", "safe", "free"]


async def test_of_two_recoveries_at_a_time_the_last_one_ends_it(isolation: str) -> None:
    gates = {"/one": asyncio.Event(), "/two": asyncio.Event()}

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        await gates[step.address[step.address.rindex("/") :]].wait()

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"release": wait}, timeout=30.0)) as system:
        ref = await wheels(system)
        one, two = await planner(system, isolation, "one"), await planner(system, isolation, "two")
        with system.events() as stream:
            strike(system, one)
            strike(system, two)
            await until(lambda: len(system._homes.recoveries.safety.holds(two.path)) == 1)
            gates["/one"].set()
            assert (await event(stream, hf.events.Recovered)).address == one.path
            await until(lambda: system._homes.recoveries.of(one.path) is None)
            assert await words(ref) == ["safe"]
            gates["/two"].set()
            await over(system)
        assert await words(ref) == ["safe", "free"]


async def test_it_stays_when_the_recovery_fails_and_ends_when_the_actor_is_back(isolation: str, tmp_path: Any) -> None:
    """T17: the handler fails under replay, until the supervisor gives up; started by hand without it, all is well."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await wheels(system)
        kind: Any = "process" if isolation != "task" else "task"
        child = hf.child(
            "planner",
            hf.start(Planner),
            recovery=hf.hybrid(interval=3600.0, safe_state="/app/wheels"),
            isolation="process" if isolation == "process" else "task",
        )
        top_kind: Any = kind if isolation == "subtree" else "task"
        top = hf.supervisor("top", children=[child], intensity=2, period=60.0, restart="temporary", isolation=top_kind)
        await system.start(top)
        robot = system.ref("/app/top/planner", hf.Actor)
        await robot.ask(Do([f"replayed {tmp_path / 'marker'}"]), timeout=30.0)
        with system.events() as stream:
            strike(system, robot)
            kept = await event(stream, hf.events.SafeStateKept)
        assert (kept.address, kept.receivers) == ("/app/top/planner", ("/app/wheels",))
        assert await words(ref) == ["safe"]
        (tmp_path / "marker").unlink()
        await system.start(top)
        await until(lambda: not system._homes.recoveries.all())
        assert await words(ref) == ["safe", "free"]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_receiver_that_hears_of_no_end_raises_the_alarm_and_stays_safe(isolation: str) -> None:
    """T18: by itself, in its own process; nobody has to live for it."""
    go_on = asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        await go_on.wait()

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"release": wait}, timeout=30.0)) as system:
        ref = await wheels(system, isolation=isolation)
        robot = await planner(system, "task", safe_state_timeout=0.2)
        with system.events() as stream:
            begin = time.monotonic()
            robot.kill()
            alarm = await event(stream, hf.events.SafeStateOverdue)
            assert time.monotonic() - begin >= 0.15  # A loop rounds its timers, uvloop to whole milliseconds.
        assert (alarm.address, alarm.because, alarm.seconds) == (ref.path, robot.path, 0.2)
        assert await words(ref) == ["safe"]
        go_on.set()
        await over(system)
        assert await words(ref) == ["safe", "free"]


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("enter", [None, Halt(0.0)])
@pytest.mark.parametrize("late", [False, True])
async def test_the_alarm_is_raised_once_and_only_when_it_is_late(enter: Any, late: bool) -> None:
    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        await asyncio.sleep(11.0 if late else 9.0)

    async with running(recovery_hooks=hf.checkpoint.recovery_hooks(before={"release": wait}, timeout=60.0)) as system:
        await wheels(system)
        state = hf.checkpoint.safe_state("/app/wheels", enter=enter)
        robot = await planner(system, "task", safe_state=state, safe_state_timeout=10.0)
        with system.events() as stream:
            robot.kill()
            await event_on(stream, hf.events.SafeStateLeft)
            await asyncio.sleep(100.0)
            alarms = [one for one in stream.take() if isinstance(one, hf.events.SafeStateOverdue)]
        assert len(alarms) + TOLD.pop() == late


TOLD: list[int] = []


async def event_on(stream: hf.events.EventStream, kind: type[hf.events.Event]) -> None:
    """Wait for an event, and count the alarms before it."""
    alarms = 0
    async for one in stream:
        alarms += isinstance(one, hf.events.SafeStateOverdue)
        if isinstance(one, kind):
            TOLD.append(alarms)
            return


@pytest.mark.parametrize("hooked", [False, True])
async def test_what_is_restarted_in_good_order_makes_nobody_safe(isolation: str, hooked: bool) -> None:
    """Neither on its quick way nor on the one past the points at which the hooks of a recovery are called."""
    called: list[str] = []
    hooks = (
        hf.checkpoint.recovery_hooks(after={"safe_state": lambda step: called.append(step.phase)}) if hooked else None
    )
    async with running(recovery_hooks=hooks) as system:
        ref = await wheels(system)
        robot = await planner(system, isolation)
        with system.events() as stream:
            await robot.ask(Do(["add one", "leave"]))
            await event(stream, hf.events.Recovered)
        await over(system)
        assert await words(ref) == []
        assert await robot.ask(Seen()) == ["one"]
        assert bool(called) == hooked


async def test_nobody_to_tell_holds_nothing_up(isolation: str) -> None:
    async with running() as system:
        robot = await planner(system, isolation, safe_state="/app/nowhere")
        await robot.ask(Note("one"))
        with system.events() as stream:
            await struck(system, robot)
            await over(system)
            told = stream.take()
        (missed,) = [one for one in told if isinstance(one, hf.events.SafeStateMissed)]
        assert (missed.address, missed.because, missed.reason) == ("/app/nowhere", robot.path, "nobody lives there")
        assert not [one for one in told if isinstance(one, hf.events.SafeStateEntered | hf.events.SafeStateLeft)]
        assert await robot.ask(Seen()) == ["one"]


@pytest.mark.parametrize(
    ("state", "problem"),
    [
        ("wheels", ("wheels", "this binding leads nowhere")),
        ("/app/doer", ("/app/doer", "Doer has no on_safe_state")),
        (
            hf.checkpoint.safe_state("/app/doer", enter=Halt(0.5)),
            ("/app/doer", "Doer has no handler for tests.checkpoint.gu"),
        ),
    ],
)
async def test_who_cannot_be_made_safe_is_told_of(isolation: str, state: Any, problem: tuple[str, str]) -> None:
    async with running() as system:
        await start(system, "task", "doer", hf.start(Doer))
        robot = await start(system, isolation, "robot", hf.start(Planner), recovery=hf.hybrid(safe_state=state))
        with system.events() as stream:
            await struck(system, robot)
            await over(system)
            (missed,) = [one for one in stream.take() if isinstance(one, hf.events.SafeStateMissed)]
        assert (missed.address, missed.because) == (problem[0], robot.path)
        assert problem[1] in missed.reason


async def test_the_phases_of_a_recovery_with_safe_state(isolation: str) -> None:
    async with running() as system:
        await wheels(system)
        robot = await planner(system, isolation)
        with system.events() as stream:
            strike(system, robot)
            await event(stream, hf.events.SafeStateEntered)
            await until(lambda: robot._cell.host.home.switch.life.is_released)  # type: ignore[attr-defined]
            await over(system)
            told = phases(stream.take(), robot.path)
        assert told == [(1, phase) for phase in ("safe_state", "isolate", "restart", "restore", "replay", "release")]


@pytest.mark.parametrize(
    ("given", "words_"),
    [
        ({"safe_state": 3}, "an address, a list of them"),
        ({"safe_state": []}, "takes addresses"),
        ({"safe_state_timeout": 0}, "safe_state_timeout must be a finite number of seconds > 0"),
        ({"held": 3}, "held must be"),
        ({"held": {"scan": hf.checkpoint.held(1)}}, "must name topics"),
        ({"held": {"/scan": 1}}, "must be held"),
        ({"hooks": {}}, "hooks must come from recovery_hooks"),
    ],
)
def test_wrong_settings_are_refused(given: dict[str, Any], words_: str) -> None:
    with pytest.raises(hf.SpecError, match=words_):
        hf.hybrid(**given)


def test_a_binding_that_the_class_has_not_is_refused() -> None:
    with pytest.raises(hf.SpecError, match="has no binding 'legs'"):
        hf.child("x", hf.start(Wheels), recovery=hf.hybrid(safe_state="legs"))


def test_messages_of_safe_state_are_checked() -> None:
    with pytest.raises(hf.SpecError, match="leave goes with enter"):
        hf.checkpoint.safe_state("/app/x", leave=Resume())
    with pytest.raises(hf.SpecError, match="must be a message"):
        hf.checkpoint.safe_state("/app/x", enter="halt")  # type: ignore[arg-type]


async def test_the_controller_is_found_by_name() -> None:
    async with running() as system:
        await planner(system, "task")
        assert "/app/recovery/controller" in system.tree()
        assert part(system, "controller").path == "/app/recovery/controller"
