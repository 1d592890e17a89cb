"""External programs as supervised children: real ones, started, watched, asked to end, and ended with all they made."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

import holdfast as hf
from tests.actors.process.waiting import end_of, next_event, until

PYTHON = [sys.executable, "-I", "-S", "-c"]
STUBBORN = (
    "import signal, time\nfor n in (2, 15): signal.signal(n, signal.SIG_IGN)\nprint('up', flush=True)\ntime.sleep(99)"
)
"""Ignores what asks it to end."""
FAMILY = """
import os, signal, time
for away in (False, True):
    if os.fork() == 0:
        if away:
            os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        print(os.getpid(), flush=True)
        time.sleep(99)
time.sleep(99)
"""
"""Has two descendants that ignore SIGTERM; one has left its session."""


def sh(script: str, **options: Any) -> hf.ChildSpec:
    return hf.program(["sh", "-c", script], id=options.pop("id", "it"), **options)


def python(script: str, **options: Any) -> hf.ChildSpec:
    return hf.program([*PYTHON, script], id=options.pop("id", "it"), **options)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


async def info(system: hf.ActorSystem, path: str = "/app/it") -> hf.ProgramStatus:
    return await system.ref(path, hf.Program).ask(hf.ProgramInfo(), 30)


async def refused(system: hf.ActorSystem, spec: hf.ChildSpec) -> str:
    with pytest.raises(hf.StartFailed) as caught:
        await system.start(spec)
    return str(caught.value)


def keeper_of(pid: int) -> psutil.Process:
    found = psutil.Process(pid).parent()
    assert found is not None
    assert "keeper.py" in " ".join(found.cmdline())
    return found


class Ends:
    """Descriptors of processes, so that their end can be awaited, whoever reaps them."""

    def __init__(self) -> None:
        self.fds: list[int] = []

    def add(self, *pids: int) -> None:
        self.fds.extend(os.pidfd_open(pid) for pid in pids)

    async def all(self) -> None:
        for fd in self.fds:
            await end_of(fd)


@pytest.fixture
def ends() -> Iterator[Ends]:
    found = Ends()
    yield found
    for fd in found.fds:
        os.close(fd)


async def family(system: hf.ActorSystem, spec: hf.ChildSpec) -> tuple[int, list[int]]:
    """Start a FAMILY: its pid, and those of its descendants."""
    with system.events() as events:
        await system.start(spec)
        pids = [int((await next_event(events, hf.LogLine)).text) for _ in range(2)]
    return (await info(system)).pid, pids


# -- output and questions ------------------------------------------------------------------------------------------


async def test_its_output_is_logged_under_the_path_of_its_actor(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(sh("echo one; echo 'zwei, ü'; echo no >&2; exec sleep 99"))
        lines = [await next_event(events, hf.LogLine) for _ in range(3)]
    assert {line.address for line in lines} == {"/app/it"}
    assert [line.text for line in lines if line.stream == "stdout"] == ["one", "zwei, ü"]
    assert [line.text for line in lines if line.stream == "stderr"] == ["no"]


async def test_it_can_be_asked_how_it_is(system: hf.ActorSystem) -> None:
    await system.start(sh("i=0; while [ $i -lt 30 ]; do echo $i; i=$((i+1)); done; printf 'end'; exec sleep 99"))
    await until_line(system, "end")
    status = await info(system)
    assert status.lines == [*map(str, range(11, 30)), "end"], "the last twenty, the one without an end too"
    assert psutil.Process(status.pid).name() == "sleep"
    assert 0 < status.uptime < 30


async def until_line(system: hf.ActorSystem, text: str) -> None:
    async with asyncio.timeout(30):
        while text not in (await info(system)).lines:
            await asyncio.sleep(0.002)


async def test_megabytes_of_output_arrive_whole_and_in_order(system: hf.ActorSystem) -> None:
    count = 200_000
    with system.events() as events:
        texts: list[str] = []
        system.node.events.add_sink(lambda event: texts.append(event.text) if isinstance(event, hf.LogLine) else None)
        await system.start(python(f"for n in range({count}): print(n, 'x' * 20)", restart="temporary"))
        await next_event(events, hf.ProcessDied)
    assert texts == [f"{number} {'x' * 20}" for number in range(count)]


async def test_output_that_is_no_text_or_has_no_end(system: hf.ActorSystem) -> None:
    script = r"import os; os.write(1, b'\xff\xfe gr\xc3\xbcn\n\x00' + b'y' * 3_000_000); os.write(2, b'half')"
    texts: dict[str, list[str]] = {"stdout": [], "stderr": []}
    with system.events() as events:
        system.node.events.add_sink(
            lambda event: texts[event.stream].append(event.text) if isinstance(event, hf.LogLine) else None
        )
        await system.start(python(script, restart="temporary"))
        assert (await next_event(events, hf.ProcessDied)).reason == hf.NORMAL
    assert texts["stdout"][0] == "\ufffd\ufffd grün"
    assert "".join(texts["stdout"][1:]) == "\x00" + "y" * 3_000_000
    assert texts["stderr"] == ["half"]


# -- ready ---------------------------------------------------------------------------------------------------------


async def test_start_returns_when_its_output_says_so(system: hf.ActorSystem) -> None:
    await system.start(
        sh("echo loading; sleep 0.1; echo LISTENING on 80; exec sleep 99", ready=re.compile("listen", re.I))
    )
    assert (await info(system)).lines == ["loading", "LISTENING on 80"]


async def test_a_prompt_has_no_end_of_line_and_is_a_sign_too(system: hf.ActorSystem) -> None:
    await system.start(sh("printf 'ready> '; exec sleep 99", ready=r"ready> $"))
    assert (await info(system)).lines == ["ready> "]


async def test_a_file_that_appears_or_changes(system: hf.ActorSystem, tmp_path: Path) -> None:
    (tmp_path / "pid").write_text("of an earlier run")
    await system.start(
        sh("sleep 0.1; echo $$ > pid.new; mv pid.new pid; exec sleep 99", ready=Path("pid"), cwd=tmp_path)
    )
    assert int((tmp_path / "pid").read_text()) == (await info(system)).pid


async def test_a_unix_socket_that_takes_connections(system: hf.ActorSystem, tmp_path: Path) -> None:
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))  # Its file stays, and nobody listens.
    script = f"import os, socket, time; time.sleep(0.1); os.unlink({str(path)!r}); s = socket.socket(socket.AF_UNIX)\n"
    await system.start(python(script + f"s.bind({str(path)!r}); s.listen(); time.sleep(99)", ready=path))
    with socket.socket(socket.AF_UNIX) as found:
        found.connect(str(path))


async def test_a_port_that_takes_connections(system: hf.ActorSystem) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    script = f"import socket, time; time.sleep(0.1); s = socket.create_server(('127.0.0.1', {port})); time.sleep(99)"
    await system.start(python(script, ready=("127.0.0.1", port)))
    with socket.create_connection(("127.0.0.1", port)):
        pass


async def test_a_function_that_is_asked_until_it_says_true(system: hf.ActorSystem) -> None:
    asked: list[str] = []

    def plain() -> bool:
        asked.append("plain")
        return len(asked) == 3

    async def awaited() -> bool:
        await asyncio.sleep(0)
        asked.append("async")
        return len(asked) == 5

    await system.start(sh("exec sleep 99", id="one", ready=plain))
    await system.start(sh("exec sleep 99", id="two", ready=awaited))
    assert asked == ["plain"] * 3 + ["async"] * 2


async def test_seconds_that_it_lives(system: hf.ActorSystem) -> None:
    await system.start(sh("exec sleep 99", ready=0.2))
    assert (await info(system)).uptime >= 0.2
    assert "it ended before it was ready: process exited with code 7" in await refused(
        system, sh("exit 7", id="short", ready=20, restart="temporary")
    )


async def test_one_that_ends_before_it_is_ready_has_not_started(system: hf.ActorSystem) -> None:
    told = await refused(system, sh("echo starting; echo port is taken >&2; exit 3", ready="up"))
    assert "/app/it" in told
    assert "sh: it ended before it was ready: process exited with code 3" in told
    assert set(told.splitlines()[1:]) == {"starting", "port is taken"}
    assert "/app/it" not in system.tree()


async def test_one_that_is_not_ready_in_time_is_ended(system: hf.ActorSystem, ends: Ends) -> None:
    with system.events() as events:
        starting = asyncio.ensure_future(
            refused(system, python(STUBBORN, ready="never", ready_timeout=0.3, shutdown=0.2))
        )
        ends.add((await next_event(events, hf.ProcessStarted)).pid)
        told = await starting
    await ends.all()
    assert "it was not ready after 0.3 s; its last lines:\nup" in told


async def test_a_sign_that_cannot_be_looked_for_is_a_failed_start(system: hf.ActorSystem) -> None:
    def broken() -> bool:
        raise OSError("no such host")

    assert "`ready` raised OSError: no such host" in await refused(system, sh("exec sleep 99", ready=broken))
    none: Any = lambda: None  # noqa: E731
    assert "it must return True or False, not None" in await refused(system, sh("exec sleep 99", ready=none))


async def test_what_cannot_be_run_says_why(system: hf.ActorSystem, tmp_path: Path) -> None:
    asked: list[int] = []
    none = hf.program(["no-such-program", "x"], stop=asked.append)
    assert "no-such-program: No such file or directory: no-such-program" in await refused(system, none)
    assert asked == [], "whoever stops it is not given the pid of a program that never ran"
    (tmp_path / "data").write_text("no program")
    assert "Permission denied" in await refused(system, hf.program([str(tmp_path / "data")]))
    assert f"No such file or directory: {tmp_path}/none" in await refused(system, sh("true", cwd=tmp_path / "none"))


async def test_environment_and_directory(
    system: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GONE", "here")
    monkeypatch.setenv("KEPT", "kept")
    script = "pwd; echo $KEPT ${GONE-gone} $NEW; exec sleep 99"
    await system.start(sh(script, cwd=tmp_path, env={"GONE": None, "NEW": "new"}, ready="kept"))
    assert (await info(system)).lines == [str(tmp_path), "kept gone new"]


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
        assert (await next_event(events, hf.ProcessDied)).reason == reason
        again = restart == "permanent" or (restart == "transient" and not reason.is_clean)
        if again:
            assert (await next_event(events, hf.ChildRestarted)).reason == reason
            pid = (await next_event(events, hf.ProcessStarted)).pid
            assert (await info(system)).pid == pid
        else:
            await until(lambda: "/app/it" not in system.tree())
            assert not [event for event in events.take() if isinstance(event, hf.ProcessStarted)]


async def test_rules_decide_by_the_way_it_ends(system: hf.ActorSystem) -> None:
    rules = [hf.rule(hf.Exited(3), "stop")]
    for code, stays in ((3, False), (4, True)):
        name = f"code-{code}"
        with system.events() as events:
            spec = sh(f"sleep 0.05; exit {code}", id=name, rules=rules, backoff=hf.Backoff(0.05, 0.05))
            await system.start(spec)
            assert (await next_event(events, hf.ProcessDied)).reason == hf.Exited(code)
            if stays:
                await next_event(events, hf.ProcessStarted)
            else:
                await until(lambda: f"/app/{name}" not in system.tree())  # noqa: B023


async def test_a_kill_from_outside_is_seen_at_once(system: hf.ActorSystem) -> None:
    await system.start(sh("exec sleep 99"))
    for _ in range(5):
        with system.events() as events:
            before = (await info(system)).pid
            os.kill(before, signal.SIGKILL)
            assert (await next_event(events, hf.ProcessDied)).reason == hf.Signal(9)
            assert (await next_event(events, hf.ProcessStarted)).pid == (await info(system)).pid != before


async def test_a_supervisor_gives_up_on_one_that_ends_again_and_again(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(hf.supervisor("top", intensity=2, restart="temporary", children=[sh("exit 1")]))
        gave_up = await next_event(events, hf.SupervisorGaveUp)
    assert (gave_up.address, gave_up.reason) == ("/app/top", hf.Exited(1))


async def test_limits_are_those_of_the_program(system: hf.ActorSystem) -> None:
    hungry = "import time\nkept = bytearray(200_000_000)\ntime.sleep(99)"
    with system.events() as events:
        limits = hf.Limits(memory_bytes=100_000_000, watch_interval=0.05, open_files=32)
        await system.start(python(hungry, limits=limits, restart="temporary"))
        assert isinstance((await next_event(events, hf.ProcessDied)).reason, hf.OutOfMemory)
        await system.start(sh("ulimit -n; exec sleep 99", id="files", limits=limits))
        assert (await next_event(events, hf.LogLine)).text == "32"


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
        return " ".join(event.text for event in events.take() if isinstance(event, hf.LogLine))


async def interrupt(pid: int) -> None:
    await asyncio.sleep(0)
    os.kill(pid, signal.SIGUSR1)


def broken(pid: int) -> None:
    raise OSError(f"cannot reach {pid - pid}")


async def test_it_is_asked_to_end_as_it_wants_to_be(system: hf.ActorSystem) -> None:
    assert await said_at_its_end(system) == "SIGTERM"
    assert await said_at_its_end(system, stop=signal.SIGINT) == "SIGINT"
    assert await said_at_its_end(system, stop=lambda pid: os.kill(pid, signal.SIGUSR1)) == "SIGUSR1"
    assert await said_at_its_end(system, stop=interrupt) == "SIGUSR1"
    assert await said_at_its_end(system, stop=["sh", "-c", "echo stopping; kill -INT $MAINPID"]) == ("stopping SIGINT")
    assert await said_at_its_end(system, shutdown="brutal_kill") == ""


@pytest.mark.parametrize("stop", [broken, ["no-such-command"], ["false"], ["sleep", "99"], signal.SIGURG])
async def test_if_that_does_not_end_it_it_gets_sigterm(system: hf.ActorSystem, stop: Any) -> None:
    assert await said_at_its_end(system, stop=stop, shutdown=1.0) == "SIGTERM"


async def test_one_that_ignores_sigterm_is_killed_when_its_time_is_over(system: hf.ActorSystem, ends: Ends) -> None:
    ref = await system.start(python(STUBBORN, ready="up", shutdown=0.3))
    ends.add((await info(system)).pid)
    began = asyncio.get_running_loop().time()
    with system.events() as events:
        await system.stop(ref)
        took = asyncio.get_running_loop().time() - began
        reasons = [event.reason for event in events.take() if isinstance(event, hf.ProcessDied)]
    assert reasons == [hf.Signal(9)]
    assert 0.3 <= took < 5
    await ends.all()


@pytest.mark.parametrize("shutdown", [0.2, "brutal_kill", 0])
async def test_nothing_of_it_is_left_when_the_stop_returns(system: hf.ActorSystem, shutdown: Any) -> None:
    pid, descendants = await family(system, python(FAMILY, shutdown=shutdown))
    keeper = keeper_of(pid)
    await system.stop(system.ref("/app/it", hf.Program))
    assert not [one for one in (pid, keeper.pid, *descendants) if psutil.pid_exists(one)]


async def test_its_descendants_end_with_it_before_it_is_started_anew(system: hf.ActorSystem) -> None:
    pid, descendants = await family(system, python(FAMILY))
    with system.events() as events:
        os.kill(pid, signal.SIGKILL)
        await next_event(events, hf.ProcessDied)
        assert not [one for one in (pid, *descendants) if psutil.pid_exists(one)]
        await next_event(events, hf.ProcessStarted)


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
            after = (await next_event(events, hf.ProcessStarted)).pid
        assert after != before.pid
        assert not [one for one in (before, *below) if one.is_running()]


async def test_however_long_that_takes(system: hf.ActorSystem) -> None:
    ref = await system.start(sh("exec sleep 99"))
    before = (await info(system)).pid
    keeper = keeper_of(before)
    keeper.suspend()  # It ends nothing now.
    with system.events() as events:
        try:
            ref.kill()
            await next_event(events, hf.ActorStarted)
            for _ in range(10):
                await asyncio.sleep(0)
            assert psutil.Process().children() == [keeper], "nothing else is started"
        finally:
            keeper.resume()
        assert (await next_event(events, hf.ProcessDied)).pid == before
        assert (await next_event(events, hf.ProcessStarted)).pid == (await info(system)).pid


async def test_a_stop_while_it_starts_ends_it(system: hf.ActorSystem, ends: Ends) -> None:
    with system.events() as events:
        starting = asyncio.ensure_future(system.start(sh("exec sleep 99", ready="never", shutdown="brutal_kill")))
        pid = (await next_event(events, hf.ProcessStarted)).pid
        ends.add(pid)
        system.ref("/app/it", hf.Program).kill()
        with pytest.raises(hf.StartFailed):
            await starting
    await ends.all()


async def test_a_keeper_that_is_killed_takes_its_program_with_it(system: hf.ActorSystem, ends: Ends) -> None:
    script = "sleep 98 & echo $!; exec sleep 99"
    with system.events() as events:
        await system.start(sh(script))
        below = int((await next_event(events, hf.LogLine)).text)
        pid = (await info(system)).pid
        ends.add(pid, below)
        keeper_of(pid).kill()
        assert (await next_event(events, hf.ProcessDied)).reason == hf.Signal(9)
        await ends.all()
        assert (await next_event(events, hf.ProcessStarted)).pid == (await info(system)).pid


ROOT_PROGRAM = """
import asyncio, sys
import holdfast as hf

async def main():
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.program([sys.executable, "-I", "-S", "-c", {family!r}], id="it")
        if {apart}:
            spec = hf.supervisor("top", children=[spec], isolation="process")
        with system.events() as events:
            ref = await system.start(spec)
            async for event in events:
                if isinstance(event, hf.LogLine):
                    print(event.text, flush=True)
                elif isinstance(event, hf.ProcessStarted):
                    print(event.pid, flush=True)

if __name__ == "__main__":
    hf.run(main())
"""


@pytest.mark.parametrize("apart", [False, True])
async def test_all_of_it_ends_with_a_root_that_is_killed(tmp_path: Path, ends: Ends, apart: bool) -> None:
    script = tmp_path / "root.py"
    script.write_text(ROOT_PROGRAM.format(family=FAMILY, apart=apart))
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE) as root:
        assert root.stdout is not None
        count = 4 if apart else 3  # its process, the two below it, and the supervisor's
        async with asyncio.timeout(30):
            lines = [await asyncio.to_thread(root.stdout.readline) for _ in range(count)]
        ends.add(*map(int, lines))
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
            await next_event(events, hf.ProcessStarted)
    await info(system)
    assert len(os.listdir("/proc/self/fd")) == files
    assert len(asyncio.all_tasks()) <= tasks + 1
    assert len(psutil.Process().children()) == 2, "two keepers"


# -- input ---------------------------------------------------------------------------------------------------------


async def test_it_reads_what_it_is_told(system: hf.ActorSystem) -> None:
    with system.events() as events:
        ref = await system.start(hf.program(["cat"], stdin=True, restart="transient"))
        ref.tell(hf.ProgramInput("grün\n"))
        ref.tell(hf.ProgramInput(data=b"two\n"))
        assert [(await next_event(events, hf.LogLine)).text for _ in range(2)] == ["grün", "two"]
        await ref.ask(hf.ProgramInput("last", end=True))
        assert (await next_event(events, hf.LogLine)).text == "last"
        assert (await next_event(events, hf.ProcessDied)).reason == hf.NORMAL


async def test_megabytes_of_input_arrive_whole(system: hf.ActorSystem) -> None:
    ref = await system.start(sh("sleep 0.1; wc -c", stdin=True, restart="transient"))
    with system.events() as events:
        sent = 0
        for number in range(200):
            data = bytes([number]) * 50_000
            while True:
                try:
                    await ref.ask(hf.ProgramInput(data=data, end=number == 199))
                except hf.InputRefused:  # It does not read yet.
                    await asyncio.sleep(0.005)
                else:
                    break
            sent += len(data)
        assert (await next_event(events, hf.LogLine)).text.strip() == str(sent)


async def feed(ref: hf.ActorRef[hf.Program], message: hf.ProgramInput) -> None:
    """The first ones may still be taken, by the pipe."""
    for _ in range(3):
        await ref.ask(message)


async def test_input_that_cannot_be_had_is_refused(system: hf.ActorSystem) -> None:
    for options, why in (({}, "program(..., stdin=True)"), ({"stdin": True}, "it does not read: ")):
        name = f"it-{len(options)}"
        ref = await system.start(sh("exec sleep 99", id=name, **options))
        with pytest.raises(hf.InputRefused, match=re.escape(why)):
            await feed(ref, hf.ProgramInput(data=b"x" * 1_000_000))
    ref = await system.start(sh("exec <&-; echo closed; exec sleep 99", id="closed", stdin=True, ready="closed"))
    with pytest.raises(hf.InputRefused, match="its standard input is closed"):
        await feed(ref, hf.ProgramInput("x"))


async def test_without_input_it_finds_the_end_at_once(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(sh("cat; echo end", restart="temporary"))
        assert (await next_event(events, hf.LogLine)).text == "end"


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
        await system.ref(path, hf.Program).ask(hf.ProgramInput("and this\n", end=True))
        assert (await next_event(events, hf.LogLine, lambda line: line.text == "and this")).address == path
        died = await next_event(events, hf.ProcessDied)
        assert (died.address, died.reason) == (path, hf.Exited(5))
        assert (await next_event(events, hf.ProcessStarted)).pid == (await info(system, path)).pid


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
        started = await next_event(events, hf.ProcessStarted, lambda event: event.address == path)
    assert started.pid == (await info(system, path)).pid != status.pid


async def test_what_cannot_be_sent_to_another_process_is_refused_by_name() -> None:
    with pytest.raises(hf.SpecError, match=r"stop: a value of type function"):
        hf.supervisor("top", children=[sh("true", stop=lambda pid: None)], isolation="process")


# -- specs ---------------------------------------------------------------------------------------------------------

BAD: list[tuple[Any, dict[str, Any], str]] = [
    ("sleep 1", {}, "the command must be a list of texts"),
    ([], {}, "the command must be a list of texts"),
    (["sleep", 1], {}, "the command must be a list of texts"),
    ([""], {}, "the command must be a list of texts"),
    (["a\0b"], {}, "the command must be a list of texts"),
    (["x"], {"id": "a/b"}, "the id must be text"),
    (["x"], {"ready": b"up"}, "ready must be a pattern"),
    (["x"], {"ready": "("}, "ready is no regular expression"),
    (["x"], {"ready": re.compile(b"up")}, "not for bytes"),
    (["x"], {"ready": -1}, "ready must be a pattern"),
    (["x"], {"ready": True}, "ready must be a pattern"),
    (["x"], {"ready": ("host", "port")}, "ready must be a pattern"),
    (["x"], {"ready_timeout": 0}, "ready_timeout must be"),
    (["x"], {"ready_timeout": float("inf")}, "ready_timeout must be"),
    (["x"], {"stop": "kill"}, "stop must be a signal"),
    (["x"], {"stop": []}, "stop must be a list of texts"),
    (["x"], {"stop": 999}, "stop must be a signal"),
    (["x"], {"stop": True}, "stop must be a signal"),
    (["x"], {"env": ["A=b"]}, "env must be a mapping"),
    (["x"], {"env": {"A": 1}}, "env must map names to texts"),
    (["x"], {"env": {"A=B": "1"}}, "env must map names to texts"),
    (["x"], {"cwd": 3}, "cwd must be a path"),
    (["x"], {"stdin": "yes"}, "stdin must be True or False"),
    (["x"], {"shutdown": -1}, "shutdown must be seconds"),
    (["x"], {"restart": "often"}, "restart must be one of"),
    (["x"], {"backoff": 1}, "backoff must be"),
    (["x"], {"limits": 1}, "limits must be"),
    (["x"], {"limits": hf.Limits(hung_after=1)}, "a program has no heartbeat"),
    (["x"], {"significant": True}, "a permanent child cannot be significant"),
]


@pytest.mark.parametrize(("command", "options", "problem"), BAD)
def test_a_bad_argument_is_refused_when_the_spec_is_built(command: Any, options: dict[str, Any], problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        hf.program(command, **options)


def test_a_pattern_keeps_its_flags_whatever_stands_in_it() -> None:
    for pattern in (re.compile("(?i)up", re.M), "(?i)up", re.compile("up", re.X | re.A)):
        assert hf.program(["x"], ready=pattern).id == "x"
