"""How external programs end, with all they made: by themselves, by what stops them, with those above them."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import psutil
import pytest

import holdfast as hf
from tests.actors.process.waiting import next_event, until
from tests.supervision.programs import FAMILY, STUBBORN, Ends, family, hang, info, keeper_of, python, sh
from tests.warm import own_children

# -- ends and restarts ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("exit 0", hf.NORMAL),
        ("exit 3", hf.Exited(3)),
        ("kill -9 $$", hf.Signal(9)),
        ("kill -TERM $$", hf.Signal(15)),
    ],
)
@pytest.mark.parametrize("restart", ["permanent", "transient", "temporary"])
async def test_its_end_is_an_exit_reason_and_restarts_by_type(
    system: hf.ActorSystem, script: str, reason: hf.ExitReason, restart: Any, tmp_path: Path
) -> None:
    """The first run ends as said, the second one lives."""
    script = f"if mkdir {tmp_path}/first 2>&-; then {script}; fi; exec sleep 99"
    with system.events() as events:
        await system.start(sh(script, restart=restart))
        assert (await next_event(events, hf.events.ProcessDied)).reason == reason
        again = restart == "permanent" or (restart == "transient" and not reason.is_clean)
        if again:
            assert (await next_event(events, hf.events.ChildRestarted)).reason == reason
            pid = (await next_event(events, hf.events.ProcessStarted)).pid
            assert (await info(system)).pid == pid
        else:
            await until(lambda: "/app/it" not in system.tree())
            assert not [event for event in events.take() if isinstance(event, hf.events.ProcessStarted)]


async def test_rules_decide_by_the_way_it_ends(system: hf.ActorSystem) -> None:
    rules = [hf.rule(hf.Exited(3), "stop")]
    for code, stays in ((3, False), (4, True)):
        name = f"code-{code}"
        with system.events() as events:
            spec = sh(f"sleep 0.05; exit {code}", id=name, rules=rules, backoff=hf.Backoff(0.05, 0.05))
            await system.start(spec)
            assert (await next_event(events, hf.events.ProcessDied)).reason == hf.Exited(code)
            if stays:
                await next_event(events, hf.events.ProcessStarted)
            else:
                await until(lambda: f"/app/{name}" not in system.tree())  # noqa: B023


async def test_a_kill_from_outside_is_seen_at_once(system: hf.ActorSystem) -> None:
    await system.start(sh("exec sleep 99"))
    for _ in range(5):
        with system.events() as events:
            before = (await info(system)).pid
            os.kill(before, signal.SIGKILL)
            assert (await next_event(events, hf.events.ProcessDied)).reason == hf.Signal(9)
            assert (await next_event(events, hf.events.ProcessStarted)).pid == (await info(system)).pid != before


async def test_a_supervisor_gives_up_on_one_that_ends_again_and_again(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(hf.supervisor("top", intensity=2, restart="temporary", children=[sh("exit 1")]))
        gave_up = await next_event(events, hf.events.SupervisorGaveUp)
    assert (gave_up.address, gave_up.reason) == ("/app/top", hf.Exited(1))


async def test_limits_are_those_of_the_program(system: hf.ActorSystem) -> None:
    hungry = "import time\nkept = bytearray(200_000_000)\ntime.sleep(99)"
    with system.events() as events:
        limits = hf.Limits(memory_bytes=100_000_000, watch_interval=0.05, open_files=32)
        await system.start(python(hungry, limits=limits, restart="temporary"))
        assert isinstance((await next_event(events, hf.events.ProcessDied)).reason, hf.OutOfMemory)
        await system.start(sh("ulimit -n; exec sleep 99", id="files", limits=limits))
        assert (await next_event(events, hf.events.LogLine)).text == "32"


# -- stopping ------------------------------------------------------------------------------------------------------


async def said_at_its_end(system: hf.ActorSystem, **options: Any) -> str:
    """What a program hears when it is stopped."""
    script = """
    import os, signal, time
    def hear(number, frame):
        os.write(1, signal.Signals(number).name.encode() + b'\\n')
        os._exit(0)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1): signal.signal(number, hear)
    os.write(1, b'up\\n')
    time.sleep(99)
    """
    ref = await system.start(python(textwrap.dedent(script), ready="up", **options))
    with system.events() as events:
        await system.stop(ref)
        return " ".join(event.text for event in events.take() if isinstance(event, hf.events.LogLine))


async def interrupt(pid: int) -> None:
    await asyncio.sleep(0)
    os.kill(pid, signal.SIGUSR1)


def broken(pid: int) -> None:
    raise OSError(f"cannot reach {pid - pid}")


async def cancelled(pid: int) -> None:
    """As if it had awaited something that somebody else has cancelled."""
    raise asyncio.CancelledError


async def test_it_is_asked_to_end_as_it_wants_to_be(system: hf.ActorSystem) -> None:
    assert await said_at_its_end(system) == "SIGTERM"
    assert await said_at_its_end(system, stop=signal.SIGINT) == "SIGINT"
    assert await said_at_its_end(system, stop=lambda pid: os.kill(pid, signal.SIGUSR1)) == "SIGUSR1"
    assert await said_at_its_end(system, stop=interrupt) == "SIGUSR1"
    assert await said_at_its_end(system, stop=["sh", "-c", "echo stopping; kill -INT $MAINPID"]) == ("stopping SIGINT")
    assert await said_at_its_end(system, shutdown="brutal_kill") == ""


@pytest.mark.parametrize("stop", [broken, cancelled, ["no-such-command"], ["false"]])
async def test_if_that_does_not_work_it_gets_sigterm(system: hf.ActorSystem, stop: Any) -> None:
    """At once: its time, after which it would be killed, is not waited for."""
    assert await said_at_its_end(system, stop=stop, shutdown=60.0) == "SIGTERM"


@pytest.mark.parametrize("stop", [["sleep", "99"], signal.SIGURG])
async def test_if_that_does_not_end_it_in_half_its_time_it_gets_sigterm(system: hf.ActorSystem, stop: Any) -> None:
    """It has the other half to hear that, which has to be enough for a process on a machine that is busy."""
    assert await said_at_its_end(system, stop=stop, shutdown=5.0) == "SIGTERM"


async def test_one_that_ignores_sigterm_is_killed_when_its_time_is_over(system: hf.ActorSystem, ends: Ends) -> None:
    ref = await system.start(python(STUBBORN, ready="up", shutdown=0.3))
    ends.add((await info(system)).pid)
    began = asyncio.get_running_loop().time()
    with system.events() as events:
        await system.stop(ref)
        took = asyncio.get_running_loop().time() - began
        reasons = [event.reason for event in events.take() if isinstance(event, hf.events.ProcessDied)]
    assert reasons == [hf.Signal(9)]
    assert 0.3 <= took < 60
    await ends.all()


@pytest.mark.parametrize("shutdown", [0.2, "brutal_kill", 0])
async def test_nothing_of_it_is_left_when_the_stop_returns(system: hf.ActorSystem, shutdown: Any) -> None:
    pid, descendants = await family(system, python(FAMILY, shutdown=shutdown))
    keeper = keeper_of(pid)
    await system.stop(system.ref("/app/it", hf.supervision.Program))
    assert not [one for one in (pid, keeper.pid, *descendants) if psutil.pid_exists(one)]


async def test_its_descendants_end_with_it_before_it_is_started_anew(system: hf.ActorSystem) -> None:
    pid, descendants = await family(system, python(FAMILY))
    with system.events() as events:
        os.kill(pid, signal.SIGKILL)
        await next_event(events, hf.events.ProcessDied)
        assert not [one for one in (pid, *descendants) if psutil.pid_exists(one)]
        await next_event(events, hf.events.ProcessStarted)


@pytest.mark.parametrize("script", [STUBBORN, FAMILY])
async def test_the_next_one_begins_when_the_last_one_of_a_killed_actor_is_gone(
    system: hf.ActorSystem, script: str
) -> None:
    ref = await system.start(python(script))
    for _ in range(3):
        before = psutil.Process((await info(system)).pid)
        below = before.children(recursive=True)
        with system.events() as events:
            ref.kill()
            after = (await next_event(events, hf.events.ProcessStarted)).pid
        assert after != before.pid
        assert not [one for one in (before, *below) if one.is_running()]


async def test_however_long_that_takes(system: hf.ActorSystem) -> None:
    """Here that is two seconds: its keeper hangs, and is killed."""
    ref = await system.start(sh("exec sleep 99"))
    before = (await info(system)).pid
    keeper = keeper_of(before)
    hang(keeper.pid)
    with system.events() as events:
        ref.kill()
        await next_event(events, hf.events.ActorStarted)
        for _ in range(10):
            await asyncio.sleep(0)
        assert own_children() == [keeper], "nothing else is started"
        assert (await next_event(events, hf.events.ProcessDied)).pid == before
        assert (await next_event(events, hf.events.ProcessStarted)).pid == (await info(system)).pid


async def test_a_stop_while_it_starts_ends_it(system: hf.ActorSystem, ends: Ends) -> None:
    with system.events() as events:
        starting = asyncio.ensure_future(system.start(sh("exec sleep 99", ready="never", shutdown="brutal_kill")))
        pid = (await next_event(events, hf.events.ProcessStarted)).pid
        ends.add(pid)
        system.ref("/app/it", hf.supervision.Program).kill()
        with pytest.raises(hf.StartFailed):
            await starting
    await ends.all()


async def test_a_keeper_that_is_killed_takes_its_program_with_it(system: hf.ActorSystem, ends: Ends) -> None:
    script = "sleep 98 & echo $!; exec sleep 99"
    with system.events() as events:
        await system.start(sh(script))
        below = int((await next_event(events, hf.events.LogLine)).text)
        pid = (await info(system)).pid
        ends.add(pid, below)
        keeper_of(pid).kill()
        assert (await next_event(events, hf.events.ProcessDied)).reason == hf.Signal(9)
        await ends.all()
        assert (await next_event(events, hf.events.ProcessStarted)).pid == (await info(system)).pid


OTHER_USER = """
import asyncio, sys
import holdfast as hf

BECOME = "import os, time; os.setuid(65534); print('up', flush=True); time.sleep(99)"

async def main():
    async with hf.ActorSystem("app", log=False, intensity=1) as system:
        ended = asyncio.Event()

        def tell(event):
            if type(event).__name__ in ("HookFailed", "ChildStartFailed", "ProcessDied"):
                print(event.reason, flush=True)
            if isinstance(event, hf.events.ProcessDied):
                ended.set()

        system._node.events.add_sink(tell)
        spec = hf.supervision.program([sys.executable, "-c", BECOME], id="it", ready="up", shutdown=1.0)
        ref = await system.start(spec)
        print((await ref.ask(hf.supervision.ProgramInfo())).pid, flush=True)
        if {kills}:
            ref.kill()  # The next life does not begin, and so ends the tree.
        else:
            await system.stop(ref)
        await ended.wait()

if __name__ == "__main__":
    hf.run(main())
"""


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None, reason="needs root, and setpriv")
@pytest.mark.parametrize("kills", [False, True])
async def test_one_that_has_become_another_user_is_still_watched_and_told_of(
    tmp_path: Path, ends: Ends, kills: bool
) -> None:
    """Root without the right to kill stands for a user whose program is root's. No second one is started beside it."""
    script = tmp_path / "root.py"
    script.write_text(OTHER_USER.format(kills=kills))
    command = ["setpriv", "--bounding-set=-kill", "--inh-caps=-kill", sys.executable, str(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as root:
        assert root.stdout is not None
        async with asyncio.timeout(60):
            pid = int(await asyncio.to_thread(root.stdout.readline))
            ends.add(pid)
            denied = await asyncio.to_thread(root.stdout.readline)
            assert f"it cannot be ended from here, and runs on until somebody else ends it (process {pid}" in denied
            if kills:
                refused = await asyncio.to_thread(root.stdout.readline)
                assert "that of an earlier life still runs" in refused
            os.kill(pid, signal.SIGKILL)
            rest = await asyncio.to_thread(root.stdout.read)
            assert ("TreeFailed" if kills else "SIGKILL") in rest
    await ends.all()


ROOT_PROGRAM = """
import asyncio, sys
import holdfast as hf

async def main():
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.supervision.program([sys.executable, "-I", "-S", "-c", {family!r}], id="it")
        if {apart}:
            spec = hf.supervisor("top", children=[spec], isolation="process")
        with system.events() as events:
            ref = await system.start(spec)
            async for event in events:
                if isinstance(event, hf.events.LogLine):
                    print(event.text, flush=True)
                elif isinstance(event, hf.events.ProcessStarted):
                    print(event.pid, flush=True)

if __name__ == "__main__":
    hf.run(main())
"""


def helpers_of(root: int) -> list[psutil.Process]:
    """Its fork server, and the keepers."""
    found = psutil.Process(root).children(recursive=True)
    return [one for one in found if "reaper.py" in " ".join(one.cmdline()) or (one.ppid() == root and one.children())]


@pytest.mark.parametrize(("apart", "stopped"), [(False, False), (True, False), (True, True)])
async def test_all_of_it_ends_with_a_root_that_is_killed(
    tmp_path: Path, ends: Ends, apart: bool, stopped: bool
) -> None:
    script = tmp_path / "root.py"
    script.write_text(ROOT_PROGRAM.format(family=FAMILY, apart=apart))
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE) as root:
        assert root.stdout is not None
        count = 4 if apart else 3  # its process, the two below it, and the supervisor's
        async with asyncio.timeout(30):
            lines = [await asyncio.to_thread(root.stdout.readline) for _ in range(count)]
        ends.add(*map(int, lines))
        helpers = helpers_of(root.pid)
        assert len(helpers) == 1 + apart
        for helper in helpers if stopped else ():
            ends.add(helper.pid)
            helper.suspend()
        root.kill()
    await ends.all()


async def test_no_descriptor_task_or_zombie_is_left_by_many_lives(system: hf.ActorSystem) -> None:
    await system.start(python(FAMILY, shutdown=0.05, id="other"))
    ref = await system.start(sh("sleep 99 & exec sleep 99"))
    files, tasks = len(os.listdir("/proc/self/fd")), len(asyncio.all_tasks())
    for number in range(20):
        with system.events() as events:
            if number % 2:
                os.kill((await info(system)).pid, signal.SIGKILL)
            else:
                ref.kill()
            await next_event(events, hf.events.ProcessStarted)
    await info(system)
    assert len(os.listdir("/proc/self/fd")) == files
    assert len(asyncio.all_tasks()) <= tasks + 1
    assert len(own_children()) == 2, "two keepers"


# -- below another process -----------------------------------------------------------------------------------------


def is_there() -> bool:
    return os.path.exists(os.environ["HOLDFAST_TEST_SIGN"])


async def test_the_same_below_a_supervisor_with_a_process_of_its_own(
    system: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOLDFAST_TEST_SIGN", str(tmp_path / "sign"))
    variables = "echo ${OMP_NUM_THREADS-none} ${MALLOC_TOP_PAD_-none} ${HOLDFAST_PROCESS-none}"
    script = f"{variables}; sleep 0.1; touch {tmp_path}/sign; cat; exit 5"
    spec = sh(script, ready=is_there, stop=interrupt, stdin=True, env={"MORE": "x"}, limits=hf.Limits(niceness=1))
    with system.events() as events:
        await system.start(hf.supervisor("top", children=[spec], isolation="process"))
        path = "/app/top/it"
        status = await info(system, path)
        assert status.lines == ["none none none"], "it is given the environment of a program that knows nothing of us"
        assert keeper_of(status.pid).ppid() == system.pid_of(system.ref("/app/top", hf.Supervisor))
        await system.ref(path, hf.supervision.Program).ask(hf.supervision.ProgramInput("and this\n", end=True))
        assert (await next_event(events, hf.events.LogLine, lambda line: line.text == "and this")).address == path
        died = await next_event(events, hf.events.ProcessDied)
        assert (died.address, died.reason) == (path, hf.Exited(5))
        assert (await next_event(events, hf.events.ProcessStarted)).pid == (await info(system, path)).pid


async def test_it_ends_with_the_process_of_its_supervisor(system: hf.ActorSystem, ends: Ends) -> None:
    top = await system.start(hf.supervisor("top", children=[python(FAMILY)], isolation="process"))
    path = "/app/top/it"
    async with asyncio.timeout(30):
        while len((status := await info(system, path)).lines) < 2:
            await asyncio.sleep(0.002)
    ends.add(status.pid, *map(int, status.lines))
    os.kill(system.pid_of(top), signal.SIGKILL)
    await ends.all()
    with system.events() as events:
        started = await next_event(events, hf.events.ProcessStarted, lambda event: event.address == path)
    assert started.pid == (await info(system, path)).pid != status.pid


async def test_what_cannot_be_sent_to_another_process_is_refused_by_name() -> None:
    with pytest.raises(hf.SpecError, match=r"stop: a value of type function"):
        hf.supervisor("top", children=[sh("true", stop=lambda pid: None)], isolation="process")
