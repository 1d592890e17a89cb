"""Control of a live actor, told again from OTP's sys_SUITE and gen_server_SUITE (otp.md 1.11, 1.12; W8).

Each test runs for a task, a process, an actor of a subtree in a process, and recorded actors of both kinds.
"""

from __future__ import annotations

import asyncio
import functools
import os
import resource
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.control.conftest import Starter
from tests.control.players import (
    Account,
    Add,
    Cents,
    Holder,
    Opened,
    Stasher,
    Stops,
    Strict,
    StrictWhole,
    Total,
    Wait,
    Whole,
    in_debt,
    large,
    no_state,
    plus,
    reverse,
    spoil,
    until_there,
)

# -- suspend and resume -----------------------------------------------------------------------------------------------


async def test_a_suspended_actor_handles_what_came_meanwhile_in_order(
    system: hf.ActorSystem, start_one: Starter
) -> None:
    one = await start_one(hf.start(Account))
    await system.suspend(one)
    for n in range(5):
        one.tell(Add(n))
    last = one.ask(Add(5))
    assert (await system.get_state(one)) == {"total": 0, "seen": []}
    assert not last.done()
    await system.resume(one)
    assert await last == 15
    assert (await system.get_state(one))["seen"] == [0, 1, 2, 3, 4, 5]


async def test_an_address_does_as_well_as_a_ref(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.suspend(one.path)
    assert await system.get_state(one.path) == await system.get_state(one)
    assert await system.outline(one.path) == await system.outline(one)
    await system.replace_code(one.path, hf.start(Account))
    await system.resume(one.path)
    assert (await system.replace_state(one.path, functools.partial(plus, 5)))["total"] == 5
    assert (await system.get_status(one.path)).life == 1
    assert not (await system.protection(one.path)).stack
    assert await system.statistics(one.path) is None
    (await system.trace(one.path)).close()
    assert system.pid_of(one.path) == system.pid_of(one)
    system.register("till", one.path)
    assert system.whereis("till").path == one.path
    assert await system.terminate(one.path) == hf.SHUTDOWN
    assert await one.ask(Total(), timeout=30.0) in (0, 5)  # Of its next life, which remembers if it is recorded.
    await system.stop(one.path)
    for call in (system.suspend, system.get_state, system.protection, system.stop):
        with pytest.raises(hf.errors.NoSuchActor, match=one.path):
            await call(one.path)
    with pytest.raises(hf.SpecError, match="neither a ref nor an address"):
        await system.resume(1)  # type: ignore[arg-type]


async def test_an_end_that_was_asked_for_stands(system: hf.ActorSystem, tmp_path: Path) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))
    waiting = one.ask(Wait(str(tmp_path / "gate")), timeout=30.0)
    await until_there(tmp_path / "gate.begun")
    with pytest.raises(hf.errors.StillEnding, match="it ends when its turn is over, or is killed"):
        await system.terminate(one, timeout=0.1)
    ended = one._cell.ended()
    (tmp_path / "gate").touch()
    assert await ended == hf.SHUTDOWN
    assert await waiting == "waited"
    assert await one.ask(Total(), timeout=30.0) == 0


async def test_a_state_in_outline_is_told_whatever_its_size(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    for n in range(12):
        await one.ask(Add(n))
    told = await system.outline(one)
    assert told["total"] == "66"
    assert told["seen"].startswith("list of 12 entries, about 0.0 MB: [0, 1, 2")


async def test_messages_that_were_queued_before_the_suspension_wait_too(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    one, gate = await start_one(hf.start(Account)), tmp_path / "gate"
    waiting = one.ask(Wait(str(gate)))
    await until_there(tmp_path / "gate.begun")
    one.tell(Add(1))
    suspended = asyncio.create_task(system.suspend(one))
    await asyncio.sleep(0)
    one.tell(Add(2))
    await system.get_status(one)  # Answered in the turn: where the actor lives, what was sent before has come.
    gate.touch()
    assert await waiting == "waited"
    await suspended
    assert await system.get_state(one) == {"total": 0, "seen": []}
    await system.resume(one)
    assert await one.ask(Add(3)) == 6
    assert (await system.get_state(one))["seen"] == [1, 2, 3]


async def test_a_caller_may_time_out_at_a_suspended_actor(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.suspend(one)
    with pytest.raises(hf.AskTimeout):
        await one.ask(Add(1), timeout=0.05)
    await system.resume(one)
    assert await one.ask(Total()) == 0  # expired before its turn, so it was not run


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_what_an_asker_was_told_is_over_is_not_run_a_moment_later(
    system: hf.ActorSystem, start_one: Starter
) -> None:
    """The two processes may have loops of different kinds, one of which reads its clock seldom."""
    one = await start_one(hf.start(Account))
    for _ in range(30):
        await system.suspend(one)
        with pytest.raises(hf.AskTimeout):
            await one.ask(Add(1), timeout=0.003)
        await system.resume(one)
    assert await one.ask(Total()) == 0


async def test_suspending_and_resuming_twice_is_no_error(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.resume(one)
    await system.suspend(one)
    await system.suspend(one)
    await system.resume(one)
    assert await one.ask(Add(1)) == 1
    await system.resume(one)
    assert await one.ask(Add(1)) == 2


async def test_a_suspended_actor_obeys_its_supervisor(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    told = tmp_path / "told"
    one = await start_one(hf.start(Stops, str(told)), shutdown=8.0)
    await system.suspend(one)
    waiting = one.ask(Add(1))
    await system.stop(one)
    assert told.read_text() == "shutdown"
    with pytest.raises(hf.ActorStopped):
        await waiting


async def test_a_suspension_ends_with_the_life(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.suspend(one)
    added = one.ask(Add(1), timeout=30.0)
    one.kill()
    assert await added == 1
    assert (await system.get_status(one)).state == "running"


async def test_control_comes_behind_on_start(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Opened))
    assert await system.get_state(one) == {"total": 5, "seen": []}


# -- the state --------------------------------------------------------------------------------------------------------


async def test_the_state_that_is_shown_is_a_copy(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    (await system.get_state(one))["seen"].append(99)
    assert await system.get_state(one) == {"total": 0, "seen": []}


@pytest.mark.parametrize("suspended", [False, True])
async def test_a_state_is_replaced_where_the_actor_lives(
    system: hf.ActorSystem, start_one: Starter, suspended: bool
) -> None:
    one = await start_one(hf.start(Account))
    assert await one.ask(Add(1)) == 1
    if suspended:
        await system.suspend(one)
    assert await system.replace_state(one, functools.partial(plus, 10)) == {"total": 11, "seen": [1]}
    await system.resume(one)
    assert await one.ask(Add(1)) == 12


async def test_a_change_that_raises_leaves_the_state_alone(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    assert await one.ask(Add(1)) == 1
    with pytest.raises(hf.errors.ControlFailed, match=r"replace_state of .*/one failed: KeyError: 'no such account'"):
        await system.replace_state(one, spoil)
    with pytest.raises(hf.errors.ControlFailed, match="the state must be a dict of variables"):
        await system.replace_state(one, no_state)
    assert await system.get_state(one) == {"total": 1, "seen": [1]}
    assert await one.ask(Add(1)) == 2


class Declares(hf.Actor):
    """Does without `rate` until it is set, and knows a `label` that none of its lives begins with."""

    rate = 0.5
    label: str

    def __init__(self) -> None:
        self.total = 0
        self.rate = 0.7


def other_variables(state: dict[str, Any]) -> dict[str, Any]:
    return {"sum": state["total"], "read": 1}


def without_rate(state: dict[str, Any]) -> dict[str, Any]:
    return {"total": 1, "label": "new"}


def in_place(state: dict[str, Any]) -> dict[str, Any]:
    del state["total"]
    return state


async def test_a_state_with_other_variables_is_refused_in_words(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    with pytest.raises(hf.errors.ControlFailed) as failed:
        await system.replace_state(one, other_variables)
    said = "lacks total, seen and has sum, read, which tests.control.players.Account has not"
    assert failed.value.problem == f"the new state {said}: return all of its variables (total, seen)"
    with pytest.raises(hf.errors.ControlFailed, match="the new state lacks total:"):
        await system.replace_state(one, in_place)
    with pytest.raises(hf.TransactionFailed, match="the new state lacks total:"):
        async with system.transaction() as change:
            change.replace_state(one, in_place)
    assert await system.get_state(one) == {"total": 0, "seen": []}


async def test_a_class_says_which_variables_may_go_and_come(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Declares))
    assert await system.replace_state(one, without_rate) == {"total": 1, "label": "new"}
    with pytest.raises(hf.errors.ControlFailed, match="the new state lacks total"):
        await system.replace_state(one, in_place)


async def test_hooks_give_and_take_the_state_as_one_value(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Whole))
    assert await system.get_state(one) == [1, 2]
    assert await system.replace_state(one, reverse) == [1, 2, 7]  # `set_state` has sorted it


async def test_another_process_must_be_able_to_import_the_change(
    system: hf.ActorSystem, start_one: Starter, way: str
) -> None:
    one = await start_one(hf.start(Account))
    if "task" in way:
        assert (await system.replace_state(one, lambda state: {**state, "total": 5}))["total"] == 5
        return
    with pytest.raises(hf.SpecError, match="replace_state needs a function of a module"):
        await system.replace_state(one, lambda state: state)
    assert await one.ask(Add(1)) == 1


@pytest.mark.parametrize("way", ["recorded task", "recorded process"])
async def test_a_replaced_state_survives_a_kill_together_with_what_follows(
    system: hf.ActorSystem, start_one: Starter
) -> None:
    one = await start_one(hf.start(Account))
    assert await one.ask(Add(1)) == 1
    await system.replace_state(one, functools.partial(plus, 10))
    assert await one.ask(Add(2)) == 13
    for _ in range(2):
        with system.events() as stream:
            _strike(system, one)
            await _recovered(stream)
        assert await system.get_state(one) == {"total": 13, "seen": [1, 2]}
    await system.replace_state(one, functools.partial(plus, 10))  # with no turn since: the last snapshot is not it
    await system.replace_state(one, functools.partial(plus, 10))
    with system.events() as stream:
        _strike(system, one)
        await _recovered(stream)
    assert await one.ask(Total()) == 33


async def test_a_state_that_the_class_refuses_half_way_is_put_back(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Strict))
    with pytest.raises(hf.errors.ControlFailed, match="ValueError: in debt"):
        await system.replace_state(one, in_debt)
    assert await system.get_state(one) == {"total": 0, "seen": [], "level": 1}
    hooked = await system.start(hf.child("hooked", hf.start(StrictWhole)))
    with pytest.raises(hf.errors.ControlFailed, match="ValueError: too many"):
        await system.replace_state(hooked, reverse)
    assert await system.get_state(hooked) == [1, 2]


@pytest.mark.parametrize("way", ["recorded task", "recorded process"])
async def test_control_waits_until_an_actor_is_recovered(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    one, gate = await start_one(hf.start(Account)), tmp_path / "gate"
    gate.touch()
    assert await one.ask(Add(1)) == 1
    assert await one.ask(Wait(str(gate))) == "waited"
    assert await one.ask(Add(2)) == 3
    gate.unlink()
    (tmp_path / "gate.begun").unlink()
    gone = one._cell.ended()
    one.kill()
    await gone
    await until_there(tmp_path / "gate.begun")  # the replay has come as far as that
    assert (await system.get_status(one)).state == "restarting"
    replaced = asyncio.create_task(system.replace_state(one, functools.partial(plus, 10), timeout=30.0))
    done, _ = await asyncio.wait([replaced], timeout=0.1)
    assert not done
    gate.touch()
    assert await replaced == {"total": 13, "seen": [1, 2]}
    assert await one.ask(Add(1)) == 14


async def test_what_a_suspended_actor_unstashes_waits_too(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Stasher))
    one.tell(Add(1))
    await one.ask(Total())
    await system.suspend(one)
    cell = one._cell
    assert cell.ctx is not None
    cell.ctx.unstash()  # as a background task of the actor may
    await system._node.settled()
    assert await system.get_state(one) == {"seen": []}
    await system.resume(one)
    assert await one.ask(Total()) == 1


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_replaced_state_that_cannot_be_saved_is_undone(tmp_path: Path, isolation: Any) -> None:
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}") as system:
        recipe = hf.start(Account)
        one = await system.start(hf.child("one", recipe, isolation=isolation, recovery=hf.hybrid(interval=3600.0)))
        assert await one.ask(Add(1)) == 1
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limits[1]))  # large states are files
        try:
            with pytest.raises(hf.errors.ControlFailed, match="the new state could not be saved"):
                await system.replace_state(one, large)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert await one.ask(Add(1), timeout=30.0) == 2
        assert await system.get_state(one) == {"total": 2, "seen": [1, 1]}


def _strike(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    pid = system.pid_of(ref)
    if pid == os.getpid():
        ref.kill()
    else:
        os.kill(pid, signal.SIGKILL)


async def _recovered(stream: hf.events.EventStream) -> None:
    async with asyncio.timeout(30.0):
        async for event in stream:
            if isinstance(event, hf.events.Recovered):
                return


# -- terminate, and who is not there ----------------------------------------------------------------------------------


async def test_terminate_ends_a_suspended_actor_with_the_reason(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    told = tmp_path / "told"
    one = await start_one(hf.start(Stops, str(told)), restart="temporary", shutdown=8.0)
    await system.suspend(one)
    reason = hf.Shutdown("by hand")
    assert await system.terminate(one, reason) == reason
    assert told.read_text() == str(reason)


@pytest.mark.parametrize(
    "call",
    [
        lambda system, ref: system.suspend(ref),
        lambda system, ref: system.resume(ref),
        lambda system, ref: system.get_state(ref),
        lambda system, ref: system.replace_state(ref, reverse),
        lambda system, ref: system.replace_code(ref, Cents),
        lambda system, ref: system.get_status(ref),
        lambda system, ref: system.statistics(ref, True),
        lambda system, ref: system.trace(ref),
        lambda system, ref: system.terminate(ref),
    ],
)
async def test_control_of_an_absent_actor_says_so(system: hf.ActorSystem, call: Any) -> None:
    one = system.spawn(hf.start(Account))
    await system.stop(one)
    with pytest.raises(hf.ActorStopped):
        await call(system, one)


async def test_control_never_hangs_on_a_busy_actor(system: hf.ActorSystem, start_one: Starter, tmp_path: Path) -> None:
    one, gate = await start_one(hf.start(Account)), tmp_path / "gate"
    waiting = one.ask(Wait(str(gate)))
    await until_there(tmp_path / "gate.begun")
    for call in (
        system.suspend(one, timeout=0.05),
        system.get_state(one, timeout=0.05),
    ):
        with pytest.raises(hf.AskTimeout):
            await call
    assert await system.statistics(one, timeout=5.0) is None
    (await system.trace(one, timeout=5.0)).close()
    gate.touch()
    assert await waiting == "waited"
    assert await one.ask(Add(1)) == 1  # what was given up is not carried out: it is not suspended


async def test_control_of_an_actor_whose_life_ends_is_told(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    one, gate = await start_one(hf.start(Account), restart="temporary"), tmp_path / "gate"
    waiting = one.ask(Wait(str(gate)))
    await until_there(tmp_path / "gate.begun")
    asked = asyncio.create_task(system.get_state(one, timeout=20.0))
    await asyncio.sleep(0)
    one.kill()
    with pytest.raises((hf.ActorStopped, hf.AskFailed)):
        await asked
    with pytest.raises((hf.ActorStopped, hf.AskFailed)):
        await waiting


async def test_control_while_a_process_starts_waits_for_it(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account), isolation="process"))
    gone = one._cell.ended()
    one.kill()
    await gone
    assert await system.get_state(one, timeout=30.0) == {"total": 0, "seen": []}


async def test_what_cannot_leave_the_process_is_shown_as_text(system: hf.ActorSystem) -> None:
    for isolation in ("task", "process"):
        one = await system.start(hf.child(isolation, hf.start(Holder), isolation=isolation))
        shown = (await system.get_state(one))["file"]
        assert isinstance(shown, hf.system.Opaque)
        assert "/dev/null" in shown.text
        await system.replace_state(one, functools.partial(plus, 4))  # what cannot be copied stays as it is
        assert await one.ask(Total()) == 4
