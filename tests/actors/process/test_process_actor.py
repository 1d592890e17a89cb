"""An actor in an OS process of its own is the same actor (DESIGN 3), and its death is an exit reason like others."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.actors.events import ActorStarted, ProcessDied
from tests.actors.process.arrays import Array, Multiplier
from tests.actors.process.players import (
    Account,
    Add,
    Answer,
    Block,
    Compute,
    Fail,
    FailLater,
    Introduce,
    Later,
    Note,
    Notebook,
    Notes,
    Overdrawn,
    Pass,
    Patient,
    Picky,
    PutAside,
    Resume,
    Run,
    Spend,
    Ticks,
    Total,
    Where,
    WhoSent,
    Withdraw,
    Worker,
)
from tests.actors.process.waiting import end_of, in_turn, next_event, stop_read, until


async def start(system: hf.ActorSystem, what: hf.Start[Any], isolation: str = "process", **options: Any) -> Any:
    name = options.pop("name", what.kind.__name__.lower())
    return await system.start(hf.child(name, what, isolation=isolation, **options))  # type: ignore[arg-type]


# -- the same class as task and process --------------------------------------------------------------------------------


async def test_ask_and_refusal_are_the_same(system: hf.ActorSystem, isolation: str) -> None:
    account = await start(system, hf.start(Account, 10), isolation)
    assert await account.ask(Add(5)) == 15
    with pytest.raises(Overdrawn) as no:
        await account.ask(Withdraw(20))
    assert (no.value.missing, no.value.where) == (5, "/app/account")
    assert await account.ask(Total()) == 15
    assert (await account.ask(Where()) == os.getpid()) is (isolation == "task")
    assert system.pid_of(account) == await account.ask(Where())


@pytest.mark.parametrize("message", [Fail("no way"), FailLater("no way")])
async def test_crash_comes_as_remote_crash_with_its_traceback(
    system: hf.ActorSystem, isolation: str, message: hf.Message[int]
) -> None:
    account = await start(system, hf.start(Account), isolation)
    await account.ask(Add(1))
    with pytest.raises(hf.RemoteCrash) as crash:
        await account.ask(message)
    assert (crash.value.type_name, crash.value.text) == ("ValueError", "no way")
    assert "raise ValueError(message.text)" in crash.value.traceback
    assert await account.ask(Total()) == 0, "a fresh life"


async def test_crash_tells_the_supervisor_why(system: hf.ActorSystem, isolation: str) -> None:
    account = await start(system, hf.start(Account), isolation, restart="temporary")
    gone = account._cell.ended()
    with pytest.raises(hf.RemoteCrash):
        await account.ask(Fail("broken"))
    reason = await gone
    assert isinstance(reason, hf.Crash)
    assert str(reason) == "ValueError: broken"
    assert "raise ValueError" in reason.traceback


async def test_arrays_and_refs_travel_in_messages(system: hf.ActorSystem, isolation: str) -> None:
    one = await start(system, hf.start(Notebook), isolation, name="one")
    two = await start(system, hf.start(Notebook), isolation, name="two")
    values = np.arange(100_000, dtype=np.float32).reshape(100, 1000)
    multiplier = await start(system, hf.start(Multiplier), isolation, name="multiplier")
    doubled = await multiplier.ask(Array(values, 2.0))
    assert doubled.dtype == np.float32
    assert (doubled == values * 2).all()
    where = "here" if isolation == "task" else "elsewhere"
    assert await one.ask(Introduce(two)) == f"/app/one knows /app/two {where}"


async def test_an_actor_may_be_told_of_itself(system: hf.ActorSystem) -> None:
    """A ref to the very process it is sent to is a ref to the actor there, not a detour over the root."""
    one = await start(system, hf.start(Notebook), name="one")
    one.tell(Pass(one, "to myself"))
    assert await one.ask(Notes()) in ([], ["to myself"])
    assert await one.ask(Notes()) == ["to myself"]
    assert await one.ask(WhoSent()) == ["/app/one"]


async def test_child_tells_child_and_is_known_as_the_sender(system: hf.ActorSystem, isolation: str) -> None:
    one = await start(system, hf.start(Notebook), isolation, name="one")
    two = await start(system, hf.start(Notebook), isolation, name="two")
    three = await start(system, hf.start(Notebook), "task", name="three")
    for number in range(3):
        one.tell(Pass(two, f"a{number}"))
        one.tell(Pass(three, f"b{number}"))
        three.tell(Pass(two, f"c{number}"))
    await asyncio.gather(one.ask(Notes()), three.ask(Notes()))  # both have passed on what they were told
    # What they passed on crosses the root behind their replies: look until it is there.
    while len(found := await two.ask(Notes())) < 6 or len(await three.ask(Notes())) < 3:
        await system._node.settled()
    assert [note for note in found if note[0] == "a"] == ["a0", "a1", "a2"]
    assert [note for note in found if note[0] == "c"] == ["c0", "c1", "c2"]
    assert await three.ask(Notes()) == ["b0", "b1", "b2"]
    senders = dict(zip(found, await two.ask(WhoSent()), strict=True))
    assert {senders["a0"], senders["a2"]} == {"/app/one"}
    assert {senders["c0"], senders["c2"]} == {"/app/three"}


async def test_delayed_reply_timers_and_pipes(system: hf.ActorSystem, isolation: str) -> None:
    book = await start(system, hf.start(Notebook), isolation)
    reply = book.ask(Later())
    book.tell(Answer("at last"))
    assert await reply == "at last"
    assert await book.ask(Ticks(1)) == 1
    assert await book.ask(Ticks(5)) == 5
    assert await book.ask(Compute(12)) == 144


async def test_messages_keep_their_order(system: hf.ActorSystem) -> None:
    book = await start(system, hf.start(Notebook))
    for number in range(2000):
        book.tell(Note(str(number)))
    assert await book.ask(Notes()) == [str(number) for number in range(2000)]


async def test_each_life_is_announced_once(system: hf.ActorSystem, isolation: str) -> None:
    with system.events() as events:
        account = await start(system, hf.start(Account), isolation)
        account.kill()
        await account.ask(Total())
        started = [event.life for event in events.take() if isinstance(event, ActorStarted)]
    assert started == [1, 2]


async def test_hooks_run_with_their_reasons(system: hf.ActorSystem, isolation: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    worker = await start(system, hf.start(Worker, str(log)), isolation)
    with pytest.raises(hf.RemoteCrash):
        await worker.ask(Fail("first"))
    await worker.ask(Total())
    worker.kill()
    await worker.ask(Total())
    await system.stop(worker)
    assert log.read_text().splitlines() == [
        "start 1",
        "stop ValueError: first",
        "start 2",
        "start 3",
        "stop shutdown",
    ]


# -- how a process ends ------------------------------------------------------------------------------------------------


async def test_kill_9_in_mid_turn_fails_that_ask_and_keeps_the_queue(system: hf.ActorSystem, tmp_path: Path) -> None:
    """T14, T20: the ask in its turn fails, saying why; what was queued behind it is answered by the next life."""
    gate = tmp_path / "gate"
    worker = await start(system, hf.start(Worker))
    running = worker.ask(Block(str(gate)))
    queued = [worker.ask(Add(1)) for _ in range(100)]
    await in_turn(system, worker, 1)
    os.kill(system.pid_of(worker), signal.SIGKILL)
    with pytest.raises(hf.AskFailed, match="SIGKILL"):
        await running
    assert await asyncio.gather(*queued) == list(range(1, 101))


async def test_tells_behind_the_turn_survive_in_order(system: hf.ActorSystem, tmp_path: Path) -> None:
    worker = await start(system, hf.start(Worker))
    worker.tell(Block(str(tmp_path / "never")))
    for _ in range(50):
        worker.tell(Add(2))
    await in_turn(system, worker, 1)
    worker.kill()
    assert await worker.ask(Total()) == 100, "the turn that was cut off is not run again"


async def test_what_was_handled_after_a_stash_is_not_handled_again(system: hf.ActorSystem, tmp_path: Path) -> None:
    """A stashed message comes late; that must not look as if all behind it were still to be done."""
    log = tmp_path / "log"
    patient = await start(system, hf.start(Patient, str(log)))
    for message in (PutAside("aside"), Note("a"), Note("b"), Resume()):
        patient.tell(message)
    await until(lambda: log.exists() and log.read_text().split() == ["a", "b", "resume", "aside"])
    patient.kill()
    assert await patient.ask(Notes()) == []
    assert log.read_text().split() == ["a", "b", "resume", "aside"]


async def test_messages_to_an_actor_that_restarts_wait_for_it(system: hf.ActorSystem) -> None:
    worker = await start(system, hf.start(Worker))
    with system.events() as events:
        os.kill(system.pid_of(worker), signal.SIGKILL)
        await next_event(events, ProcessDied)
        worker.tell(Add(1))
        assert await worker.ask(Add(1)) == 2


@pytest.mark.parametrize(
    ("what", "with_", "reason"),
    [
        ("kill_self", signal.SIGKILL, hf.Signal(signal.SIGKILL)),
        ("kill_self", signal.SIGSEGV, hf.Signal(signal.SIGSEGV)),
        ("kill_self", signal.SIGTERM, hf.Signal(signal.SIGTERM)),
        ("segfault", None, hf.Signal(signal.SIGSEGV)),
        ("kill_group", None, hf.Signal(signal.SIGKILL)),
        ("leave", 3, hf.Exited(3)),
        ("leave", 0, hf.Exited(0)),
    ],
)
async def test_a_process_that_ends_itself(system: hf.ActorSystem, what: str, with_: Any, reason: hf.ExitReason) -> None:
    worker = await start(system, hf.start(Worker))
    with system.events() as events:
        broken = worker.ask(Run(what, with_))
        behind = worker.ask(Add(1))
        with pytest.raises(hf.AskFailed) as failure:
            await broken
        assert str(reason) in str(failure.value)
        assert (await next_event(events, ProcessDied)).reason == reason
    assert await behind == 1


async def test_sys_exit_is_a_crash_like_any_exception(system: hf.ActorSystem, isolation: str) -> None:
    worker = await start(system, hf.start(Worker), isolation)
    with pytest.raises(hf.RemoteCrash, match="SystemExit: 4"):
        await worker.ask(Run("exit", 4))
    assert await worker.ask(Add(1)) == 1


async def test_the_programs_it_started_end_with_it(system: hf.ActorSystem) -> None:
    worker = await start(system, hf.start(Worker))
    program = os.pidfd_open(await worker.ask(Run("start_program")))
    try:
        worker.kill()
        await worker.ask(Total())
        await end_of(program)
    finally:
        os.close(program)


# -- limits and the watch ----------------------------------------------------------------------------------------------


async def test_a_handler_that_blocks_for_ever_is_hung(system: hf.ActorSystem, tmp_path: Path) -> None:
    """T33, T35: a blocked loop sends no beat."""
    worker = await start(system, hf.start(Worker), limits=hf.Limits(hung_after=0.3))
    broken = worker.ask(Run("loop", str(tmp_path / "begun")), timeout=20)
    with pytest.raises(hf.AskFailed, match="hung for"):
        await broken
    assert await worker.ask(Add(1)) == 1


async def test_a_turn_that_waits_is_not_hung(system: hf.ActorSystem, tmp_path: Path) -> None:
    worker = await start(system, hf.start(Worker), limits=hf.Limits(hung_after=0.2))
    waiting = worker.ask(Block(str(tmp_path / "gate")), timeout=20)
    await asyncio.sleep(0.6)  # real time: three times the limit, spent waiting
    (tmp_path / "gate").touch()
    assert await waiting == 1


async def test_a_process_is_not_hung_because_the_root_was_late(system: hf.ActorSystem) -> None:
    """T3: what the observer was late itself is no silence of others."""
    worker = await start(system, hf.start(Worker), limits=hf.Limits(hung_after=0.4))
    pause = (
        "for i in 1 2 3; do kill -STOP $0; sleep 1; kill -CONT $0; sleep 0.1; done"  # The fault: nothing of us runs.
    )
    faults = await asyncio.create_subprocess_exec("sh", "-c", pause, str(os.getpid()))
    assert await faults.wait() == 0
    assert await worker.ask(Add(1)) == 1
    assert worker._cell.life == 1


async def test_a_process_that_gets_no_processor_is_not_hung(system: hf.ActorSystem) -> None:
    """T3: it computes for less than the limit, and shares its processor with others."""
    worker = await start(system, hf.start(Worker), limits=hf.Limits(hung_after=1.6))
    pid = system.pid_of(worker)
    assert pid is not None
    processor = min(os.sched_getaffinity(pid))
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    try:
        for one in (pid, *(each.pid for each in busy)):
            os.sched_setaffinity(one, {processor})
        await worker.ask(Spend(1.1), timeout=60)
    finally:
        for each in busy:
            each.kill()
            each.wait()
    assert worker._cell.life == 1


async def test_a_process_that_was_killed_meanwhile_is_not_called_hung(system: hf.ActorSystem) -> None:
    worker = await start(system, hf.start(Worker), limits=hf.Limits(hung_after=0.4))
    with system.events() as events:
        os.kill(system.pid_of(worker), signal.SIGKILL)
        time.sleep(1.0)  # The fault: nothing of the root runs.
        died = await next_event(events, ProcessDied)
    assert died.reason == hf.Signal(signal.SIGKILL)


async def test_a_late_look_does_not_make_a_process_take_more(system: hf.ActorSystem) -> None:
    limits = hf.Limits(cpu_share=3.0, watch_interval=0.05)
    worker = await start(system, hf.start(Worker), limits=limits)
    busy = worker.ask(Run("compute", 1.0), timeout=60)
    for _ in range(2):
        await asyncio.sleep(0)
        time.sleep(0.5)  # The fault again: the look that was due comes late.
    await busy
    assert worker._cell.life == 1


async def test_the_address_space_limit_is_out_of_memory(system: hf.ActorSystem) -> None:
    limit = 3 * 2**30
    worker = await start(system, hf.start(Worker), limits=hf.Limits(address_space_bytes=limit), restart="temporary")
    assert (await worker.ask(Run("limits")))[0] == limit
    gone = worker._cell.ended()
    with pytest.raises(hf.RemoteCrash, match="MemoryError"):
        await worker.ask(Run("allocate", 4 * 2**30))
    assert isinstance(await gone, hf.OutOfMemory)


async def test_resident_memory_above_the_watch_is_out_of_memory(system: hf.ActorSystem) -> None:
    limits = hf.Limits(memory_bytes=400 * 2**20, watch_interval=0.05)
    worker = await start(system, hf.start(Worker), limits=limits)
    with system.events() as events:
        assert await worker.ask(Run("allocate", 2**20)) == 2**20
        worker.tell(Run("allocate", 500 * 2**20))
        died = await next_event(events, ProcessDied)
    assert isinstance(died.reason, hf.OutOfMemory)
    assert "the limit is 419430400" in str(died.reason)


async def test_a_share_of_cpu_above_the_watch_ends_it(system: hf.ActorSystem) -> None:
    worker = await start(system, hf.start(Worker), limits=hf.Limits(cpu_share=0.05, watch_interval=0.2))
    with system.events() as events:
        await worker.ask(Run("burn"))
        assert (await next_event(events, ProcessDied)).reason == hf.Signal(signal.SIGXCPU)


async def test_open_files_and_niceness(system: hf.ActorSystem) -> None:
    worker = await start(system, hf.start(Worker), limits=hf.Limits(open_files=40, niceness=7))
    assert 0 < await worker.ask(Run("open_files", 100)) < 40
    assert await worker.ask(Run("niceness")) == min(os.nice(0) + 7, 19)
    free = await start(system, hf.start(Worker), name="free")
    assert await free.ask(Run("open_files", 100)) == 100
    assert await free.ask(Run("niceness")) == os.nice(0)


async def test_limits_that_cannot_be_set_refuse_the_start(system: hf.ActorSystem) -> None:
    too_many = 2**40
    with pytest.raises(hf.StartFailed, match=r"ValueError|PermissionError"):
        await start(system, hf.start(Worker), limits=hf.Limits(open_files=too_many))


# -- stopping ----------------------------------------------------------------------------------------------------------


async def test_stop_runs_the_hook_and_the_process_is_gone(system: hf.ActorSystem, tmp_path: Path) -> None:
    log = tmp_path / "log"
    worker = await start(system, hf.start(Worker, str(log)))
    pidfd = os.pidfd_open(system.pid_of(worker))
    try:
        worker.tell(Add(1))
        await system.stop(worker)
        assert log.read_text().splitlines() == ["start 1", "stop shutdown"]
        await end_of(pidfd)
    finally:
        os.close(pidfd)
    with pytest.raises(hf.ActorStopped):
        await worker.ask(Total())


async def test_a_handler_that_never_returns_is_killed_after_its_shutdown_seconds(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    worker = await start(system, hf.start(Worker), shutdown=0.2)
    begun = tmp_path / "begun"
    broken = worker.ask(Run("loop", str(begun)), timeout=20)
    behind = worker.ask(Total(), timeout=20)
    await until(begun.exists)
    with system.events() as events:
        begin = system._node.loop.time()
        await system.stop(worker)
        seconds = system._node.loop.time() - begin
        assert (await next_event(events, ProcessDied)).reason == hf.KILLED
    assert seconds >= 0.2
    with pytest.raises(hf.AskFailed, match="killed"):
        await broken
    with pytest.raises(hf.ActorStopped):
        await behind


async def test_brutal_kill_runs_no_hook(system: hf.ActorSystem, tmp_path: Path) -> None:
    log = tmp_path / "log"
    worker = await start(system, hf.start(Worker, str(log)), shutdown="brutal_kill")
    await system.stop(worker)
    assert log.read_text().splitlines() == ["start 1"]


async def test_stopped_for_good_the_queue_is_refused(system: hf.ActorSystem, tmp_path: Path) -> None:
    """The fates of DESIGN 4: queued asks fail with ActorStopped, the rest are dead letters."""
    worker = await start(system, hf.start(Worker))
    running = worker.ask(Block(str(tmp_path / "gate")))
    queued = [worker.ask(Add(1)) for _ in range(5)]
    worker.tell(Add(1))
    await in_turn(system, worker, 1)
    before = system.dead_letters
    stopping = asyncio.ensure_future(system.stop(worker))
    await stop_read(system, worker)
    (tmp_path / "gate").touch()
    await stopping
    assert await running == 1
    for ask in queued:
        with pytest.raises(hf.ActorStopped):
            await ask
    assert system.dead_letters == before + 1


async def test_start_that_fails_says_why(system: hf.ActorSystem, isolation: str) -> None:
    with pytest.raises(hf.StartFailed, match=r"/app/picky could not be started: RuntimeError: not like this"):
        await start(system, hf.start(Picky), isolation, name="picky")
    with pytest.raises(hf.errors.NoSuchActor):
        system.ref("/app/picky", Picky)


async def test_a_kill_while_it_starts_leaves_no_process(system: hf.ActorSystem) -> None:
    worker = await start(system, hf.start(Worker))
    for _ in range(5):
        os.kill(system.pid_of(worker), signal.SIGKILL)
        with system.events() as events:
            await next_event(events, ProcessDied)
        worker.kill()  # while the supervisor starts it again
        assert await worker.ask(Add(1)) == 1
    await system.stop(worker)
    assert system._workers.processes() == {}


async def test_who_gives_up_waiting_for_the_end_of_a_process_ends_nobody_elses_wait(system: hf.ActorSystem) -> None:
    await start(system, hf.start(Multiplier))
    [worker] = system._workers.by_cell.values()
    first, second = worker.gone(), worker.gone()
    first.cancel()
    async with asyncio.timeout(30.0):
        await second
    assert not second.cancelled()
