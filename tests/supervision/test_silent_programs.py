"""A program that has fallen silent is ended and restarted, and one that is only kept from being heard is not."""

from __future__ import annotations

import asyncio
import os
import signal
import time

import pytest

import holdfast as hf
from tests.actors.process.waiting import next_event
from tests.supervision.programs import info, python

BEATS = "import time, sys\nwhile True:\n    print('beat', flush=True)\n    time.sleep(0.05)"
HANGS = "import time\nfor n in range(3): print('beat', flush=True)\ntime.sleep(99)"
CLOSES = "import os, time\nprint('beat', flush=True)\nos.close(1)\nos.close(2)\ntime.sleep(99)"
TRICKLES = "import time, sys\nprint('beat')\nwhile True:\n    print('.', end='', flush=True)\n    time.sleep(0.05)"
FLOODS = "print('beat')\nwhile True: print('x' * 100)"


async def ended(events: hf.events.EventStream) -> hf.ExitReason:
    return (await next_event(events, hf.events.ProcessDied)).reason


async def beats(events: hf.events.EventStream, count: int = 1) -> None:
    for _ in range(count):
        await next_event(events, hf.events.LogLine, lambda line: line.text == "beat")


@pytest.mark.parametrize("where", ["here", "in a process"])
async def test_one_that_is_stopped_by_a_signal_is_restarted(system: hf.ActorSystem, where: str) -> None:
    spec = python(BEATS, ready="beat", silent_after=0.5, rules=[hf.rule(hf.Hung, "restart")])
    path = "/app/it"
    if where == "in a process":
        spec, path = hf.supervisor("far", isolation="process", children=[spec]), "/app/far/it"
    with system.events() as events:
        await system.start(spec)
        pid = (await info(system, path)).pid
        os.kill(pid, signal.SIGSTOP)
        reason = await ended(events)
        assert isinstance(reason, hf.Hung)
        assert reason.seconds >= 0.5
        assert str(reason) == f"hung for {reason.seconds:g} s: it has printed nothing"
        await beats(events, 3)
    assert (await info(system, path)).pid != pid


@pytest.mark.parametrize("script", [HANGS, CLOSES], ids=["hangs", "closes"])
async def test_one_that_hangs_is_ended(system: hf.ActorSystem, script: str) -> None:
    with system.events() as events:
        await system.start(python(script, ready="beat", silent_after=0.2, restart="temporary"))
        assert isinstance(await ended(events), hf.Hung)


async def test_whatever_it_prints_is_a_sign_of_life(system: hf.ActorSystem) -> None:
    await system.start(python(TRICKLES, id="dots", ready="beat", silent_after=0.4))
    await system.start(python("print('beat', flush=True); import time; time.sleep(99)", id="mute", ready="beat"))
    before = await info(system, "/app/dots"), await info(system, "/app/mute")
    with system.events() as events:
        await system.start(python(HANGS, ready="beat", silent_after=0.9, restart="temporary"))
        await next_event(events, hf.events.ProcessDied, lambda died: died.address == "/app/it")
    assert (await info(system, "/app/dots")).pid == before[0].pid
    assert (await info(system, "/app/mute")).pid == before[1].pid, "one without the limit is never too silent"


async def test_one_whose_lines_wait_for_their_receiver_is_not_silent(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()

    class Listener(hf.Actor):
        @hf.on(hf.supervision.ProgramLine)
        async def hear(self, line: hf.supervision.ProgramLine) -> None:
            await gate.wait()

    listener = await system.start(hf.child("listener", hf.start(Listener)))
    await system.start(python(FLOODS, id="flood", ready="beat", silent_after=0.3, lines_to=listener))
    before = (await info(system, "/app/flood")).pid
    with system.events() as events:
        await system.start(python(HANGS, ready="beat", silent_after=0.6, restart="temporary"))
        await next_event(events, hf.events.ProcessDied, lambda died: died.address == "/app/it")
    assert (await info(system, "/app/flood")).pid == before
    gate.set()


async def test_its_silence_counts_from_when_it_is_ready_until_it_is_to_end(system: hf.ActorSystem) -> None:
    script = (
        "import time, signal, os\nsignal.signal(15, lambda *_: (time.sleep(0.5), os._exit(7)))\ntime.sleep(0.5)\n"
        + BEATS
    )
    with system.events() as events:
        ref = await system.start(python(script, ready="beat", silent_after=0.2, restart="temporary", shutdown=5.0))
        await system.stop(ref)
        assert await ended(events) == hf.Exited(7)


async def test_while_its_actor_is_suspended_it_may_be_silent(system: hf.ActorSystem) -> None:
    ref = await system.start(python(BEATS, ready="beat", silent_after=0.3))
    pid = (await info(system)).pid
    with system.events() as events:
        await system.suspend(ref)
        os.kill(pid, signal.SIGSTOP)
        await system.start(python(HANGS, id="other", ready="beat", silent_after=0.6, restart="temporary"))
        await next_event(events, hf.events.ProcessDied, lambda died: died.address == "/app/other")
        os.kill(pid, 0)
        await system.resume(ref)
        assert (await next_event(events, hf.events.ProcessDied)).pid == pid


async def test_time_for_which_this_process_was_late_is_no_silence(system: hf.ActorSystem) -> None:
    await system.start(python(BEATS, ready="beat", silent_after=0.5))
    pid = (await info(system)).pid
    with system.events() as events:
        os.kill(pid, signal.SIGSTOP)  # as on a machine that stands still
        time.sleep(0.8)
        os.kill(pid, signal.SIGCONT)
        await beats(events, 3)
    assert (await info(system)).pid == pid
