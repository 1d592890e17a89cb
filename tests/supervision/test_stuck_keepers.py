"""A keeper that a signal has stopped, that hangs or is killed: its program ends and comes back in time all the same."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.actors.process.program import external_program, keeper_watch
from tests.actors.process.waiting import next_event, until
from tests.supervision.programs import FAMILY, STUBBORN, Ends, family, hang, info, keeper_of, python
from tests.warm import own_children

BEATS = """
import os, signal, time
signal.signal(signal.SIGUSR1, lambda *_: os._exit(3))
while True:
    print("up", flush=True)
    time.sleep(0.05)
"""
LATE = """
import os, sys, time
while not os.path.exists(sys.argv[1]):
    time.sleep(0.01)
os.execv(sys.argv[2], sys.argv[2:])
"""
HUNG_SECONDS = 0.3
"""In place of two seconds, so that the tests need not wait for so long."""

Fate = Callable[[int], None]


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper_watch, "END_SECONDS", HUNG_SECONDS)
    monkeypatch.setattr(keeper_watch, "START_SECONDS", 2.0)


def stop(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)


def die(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


def live(pid: int) -> None: ...


@pytest.mark.parametrize("state", [live, stop, die])
@pytest.mark.parametrize("fate", [stop, hang, die])
@pytest.mark.parametrize("way", ["stop", "leave"])
async def test_a_program_is_stopped_in_time(ends: Ends, way: str, fate: Fate, state: Fate) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(python(STUBBORN, ready="up", shutdown=0.1, restart="temporary"))
        pid = (await info(system)).pid
        keeper = keeper_of(pid).pid
        ends.add(pid, keeper)
        fate(keeper)
        state(pid)
        begin = time.monotonic()
        if way == "stop":
            await system.stop(ref)
            assert not own_children()
    assert time.monotonic() - begin < 3.0
    await ends.all()
    assert not own_children()


@pytest.mark.parametrize("fate", [stop, hang])
async def test_it_is_told(fate: Fate, caplog: pytest.LogCaptureFixture) -> None:
    async with hf.ActorSystem("app") as system:
        await system.start(python(BEATS, ready="up"))
        keeper = keeper_of((await info(system)).pid).pid
        fate(keeper)
        with system.events() as events:
            system.ref("/app/it", hf.Actor).kill()
            stuck = await next_event(events, hf.events.HelperStuck)
    assert (stuck.address, stuck.helper, stuck.pid) == ("/app/it", "keeper", keeper)
    told = "was told to go on" if fate is stop else f"it has done nothing for {HUNG_SECONDS:g} s, and was killed"
    assert told in stuck.found
    assert "helper stuck" in caplog.text


@pytest.mark.parametrize("fate", [stop, hang])
async def test_one_that_is_silent_is_replaced(system: hf.ActorSystem, ends: Ends, fate: Fate) -> None:
    await system.start(python(BEATS, ready="up", silent_after=0.3))
    pid = (await info(system)).pid
    keeper = keeper_of(pid).pid
    ends.add(pid, keeper)
    with system.events() as events:
        fate(keeper)
        stop(pid)
        begin = time.monotonic()
        assert isinstance((await next_event(events, hf.events.ProcessDied)).reason, hf.Hung)
        assert (await next_event(events, hf.events.ProcessStarted)).pid != pid
        assert time.monotonic() - begin < 4.0
    await ends.all()


@pytest.mark.parametrize("fate", [stop, hang])
@pytest.mark.parametrize(("number", "reason"), [(signal.SIGUSR1, hf.Exited(3)), (signal.SIGKILL, hf.Signal(9))])
async def test_one_that_has_died_is_replaced(
    system: hf.ActorSystem, ends: Ends, fate: Fate, number: int, reason: hf.ExitReason
) -> None:
    await system.start(python(BEATS, ready="up"))
    pid = (await info(system)).pid
    keeper = keeper_of(pid).pid
    ends.add(keeper)
    with system.events() as events:
        fate(keeper)
        os.kill(pid, number)
        begin = time.monotonic()
        assert (await next_event(events, hf.events.ProcessDied)).reason == reason
        assert (await next_event(events, hf.events.ProcessStarted)).pid != pid
        assert time.monotonic() - begin < 3.0
    await ends.all()


@pytest.mark.parametrize("fate", [stop, hang])
async def test_its_descendants_end_with_it(system: hf.ActorSystem, ends: Ends, fate: Fate) -> None:
    spec = python(FAMILY, shutdown="brutal_kill", restart="temporary")
    pid, below = await family(system, spec)
    ends.add(pid, *below)
    fate(keeper_of(pid).pid)
    await system.stop(system.ref("/app/it", hf.Actor))
    await ends.all()


@pytest.mark.parametrize("fate", [stop, hang])
async def test_one_whose_keeper_is_stuck_while_it_starts_it(
    system: hf.ActorSystem, fate: Fate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    let, command = tmp_path / "let", external_program.keeper_command  # It begins when it is stuck.
    monkeypatch.setattr(
        external_program,
        "keeper_command",
        lambda *fds: [sys.executable, "-I", "-S", "-c", LATE, str(let), *command(*fds)],
    )
    starting = asyncio.create_task(system.start(python(BEATS, ready="up")))
    await until(lambda: len(own_children()) == 1)
    fate(own_children()[0].pid)
    begin = time.monotonic()
    let.touch()
    if fate is stop:
        await starting
    else:
        with pytest.raises(hf.StartFailed, match="its keeper ended with code -9"):
            await starting
    assert time.monotonic() - begin < 8.0


async def test_that_it_has_ended_as_it_was_asked_to_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    async with hf.ActorSystem("app") as system:
        await system.start(python("print('up', flush=True); import time; time.sleep(99)", ready="up"))
        with system.events() as events:
            await system.stop(system.ref("/app/it", hf.Actor))
            died = await next_event(events, hf.events.ProcessDied)
        assert (died.reason, died.asked) == (hf.Signal(signal.SIGTERM), True)
    assert "process died" not in caplog.text
    async with hf.ActorSystem("app") as system:
        await system.start(python(STUBBORN, id="stubborn", ready="up", shutdown=0.1))
    assert "process died" in caplog.text, "it had to be killed"
