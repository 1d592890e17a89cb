"""External programs as supervised children: their output, their input, and when they are ready."""

from __future__ import annotations

import asyncio
import re
import socket
import tempfile
import textwrap
import threading
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.actors.process.waiting import next_event
from tests.supervision.programs import STUBBORN, Ends, info, python, refused, sh

# -- output and questions ------------------------------------------------------------------------------------------


async def test_its_output_is_logged_under_the_path_of_its_actor(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(sh("echo one; echo 'zwei, ü'; echo no >&2; exec sleep 99"))
        lines = [await next_event(events, hf.events.LogLine) for _ in range(3)]
    assert {line.address for line in lines} == {"/app/it"}
    assert [line.text for line in lines if line.stream == "stdout"] == ["one", "zwei, ü"]
    assert [line.text for line in lines if line.stream == "stderr"] == ["no"]


async def test_it_can_be_asked_how_it_is(system: hf.ActorSystem) -> None:
    script = 'i=0; while [ $i -lt 30 ]; do echo $i; i=$((i+1)); done; printf "end of $$"; exec sleep 99'
    await system.start(sh(script))
    pid = (await info(system)).pid
    await until_line(system, f"end of {pid}")
    status = await info(system)
    assert status.lines == [*map(str, range(11, 30)), f"end of {pid}"], "the last twenty, the one without an end too"
    assert status.pid == pid
    assert 0 < status.uptime < 30


async def until_line(system: hf.ActorSystem, text: str) -> None:
    async with asyncio.timeout(30):
        while text not in (await info(system)).lines:
            await asyncio.sleep(0.002)


async def test_megabytes_of_output_arrive_whole_and_in_order(system: hf.ActorSystem) -> None:
    count = 200_000
    with system.events() as events:
        texts: list[str] = []
        system._node.events.add_sink(
            lambda event: texts.append(event.text) if isinstance(event, hf.events.LogLine) else None
        )
        await system.start(python(f"for n in range({count}): print(n, 'x' * 20)", restart="temporary"))
        await next_event(events, hf.events.ProcessDied)
    assert texts == [f"{number} {'x' * 20}" for number in range(count)]


async def test_output_that_is_no_text_or_has_no_end(system: hf.ActorSystem) -> None:
    script = r"import os; os.write(1, b'\xff\xfe gr\xc3\xbcn\n\x00' + b'y' * 3_000_000); os.write(2, b'half')"
    texts: dict[str, list[str]] = {"stdout": [], "stderr": []}
    with system.events() as events:
        system._node.events.add_sink(
            lambda event: texts[event.stream].append(event.text) if isinstance(event, hf.events.LogLine) else None
        )
        await system.start(python(script, restart="temporary"))
        assert (await next_event(events, hf.events.ProcessDied)).reason == hf.NORMAL
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


async def test_a_sign_that_is_cut_in_a_very_long_line_is_found(system: hf.ActorSystem) -> None:
    """Lines are handed on in pieces of 16 KiB or more; a sign may begin in one and end in the next."""
    script = """
    import os, time
    os.write(1, b"x" * (16 * 1024 - 3) + b"LISTEN")
    while not os.path.exists({path!r}): time.sleep(0.005)
    os.write(1, b"ING{end}")
    time.sleep(99)
    """
    for name, end in (("part", "y" * 20_000), ("line", "\\n")):
        path = f"/proc/self/cwd/{name}-go"
        with tempfile.TemporaryDirectory() as folder:
            spec = python(textwrap.dedent(script).format(path=path, end=end), id=name, ready="LISTENING", cwd=folder)
            with system.events() as events:
                starting = asyncio.ensure_future(system.start(spec))
                line = await next_event(events, hf.events.LogLine)
                assert line.text.endswith("LISTEN")
                Path(folder, f"{name}-go").touch()
                await asyncio.wait_for(starting, 60)


async def test_a_function_that_blocks_holds_up_nobody_and_not_beyond_its_time(system: hf.ActorSystem) -> None:
    gate = threading.Event()
    late = asyncio.ensure_future(refused(system, sh("exec sleep 99", ready=gate.wait, ready_timeout=0.2)))
    assert "it was not ready after 0.2 s" in await asyncio.wait_for(late, 60)
    gate.set()


async def test_a_function_that_is_cancelled_is_a_failed_start(system: hf.ActorSystem) -> None:
    async def cancelled() -> bool:
        raise asyncio.CancelledError

    told = await asyncio.wait_for(refused(system, sh("exec sleep 99", ready=cancelled)), 60)
    assert "what `ready` waited for was cancelled" in told


async def test_the_end_of_a_line_in_whatever_form(system: hf.ActorSystem) -> None:
    await system.start(sh(r"printf 'up\r\n'; exec sleep 99", ready="up$"))


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
        ends.add((await next_event(events, hf.events.ProcessStarted)).pid)
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
    none = hf.supervision.program(["no-such-program", "x"], stop=asked.append)
    assert "no-such-program: No such file or directory: no-such-program" in await refused(system, none)
    assert asked == [], "whoever stops it is not given the pid of a program that never ran"
    (tmp_path / "data").write_text("no program")
    assert "Permission denied" in await refused(system, hf.supervision.program([str(tmp_path / "data")]))
    assert f"No such file or directory: {tmp_path}/none" in await refused(system, sh("true", cwd=tmp_path / "none"))


async def test_environment_and_directory(
    system: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GONE", "here")
    monkeypatch.setenv("KEPT", "kept")
    script = "pwd; echo $KEPT ${GONE-gone} $NEW; exec sleep 99"
    await system.start(sh(script, cwd=tmp_path, env={"GONE": None, "NEW": "new"}, ready="kept"))
    assert (await info(system)).lines == [str(tmp_path), "kept gone new"]


# -- input ---------------------------------------------------------------------------------------------------------


async def test_it_reads_what_it_is_told(system: hf.ActorSystem) -> None:
    with system.events() as events:
        ref = await system.start(hf.supervision.program(["cat"], stdin=True, restart="transient"))
        ref.tell(hf.supervision.ProgramInput("grün\n"))
        ref.tell(hf.supervision.ProgramInput(data=b"two\n"))
        assert [(await next_event(events, hf.events.LogLine)).text for _ in range(2)] == ["grün", "two"]
        await ref.ask(hf.supervision.ProgramInput("last", end=True))
        assert (await next_event(events, hf.events.LogLine)).text == "last"
        assert (await next_event(events, hf.events.ProcessDied)).reason == hf.NORMAL


async def test_megabytes_of_input_arrive_whole(system: hf.ActorSystem) -> None:
    ref = await system.start(sh("sleep 0.1; wc -c", stdin=True, restart="transient"))
    with system.events() as events:
        sent = 0
        for number in range(200):
            data = bytes([number]) * 50_000
            while True:
                try:
                    await ref.ask(hf.supervision.ProgramInput(data=data, end=number == 199))
                except hf.errors.InputRefused:  # It does not read yet.
                    await asyncio.sleep(0.005)
                else:
                    break
            sent += len(data)
        assert (await next_event(events, hf.events.LogLine)).text.strip() == str(sent)


async def feed(ref: hf.ActorRef[hf.supervision.Program], message: hf.supervision.ProgramInput) -> None:
    """The first ones may still be taken, by the pipe."""
    for _ in range(3):
        await ref.ask(message)


async def test_input_that_cannot_be_had_is_refused(system: hf.ActorSystem) -> None:
    for options, why in (({}, "program(..., stdin=True)"), ({"stdin": True}, "it does not read: ")):
        name = f"it-{len(options)}"
        ref = await system.start(sh("exec sleep 99", id=name, **options))
        with pytest.raises(hf.errors.InputRefused, match=re.escape(why)):
            await feed(ref, hf.supervision.ProgramInput(data=b"x" * 1_000_000))
    ref = await system.start(sh("exec <&-; echo closed; exec sleep 99", id="closed", stdin=True, ready="closed"))
    with pytest.raises(hf.errors.InputRefused, match="its standard input is closed"):
        await feed(ref, hf.supervision.ProgramInput("x"))


async def test_without_input_it_finds_the_end_at_once(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(sh("cat; echo end", restart="temporary"))
        assert (await next_event(events, hf.events.LogLine)).text == "end"


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
    (["x"], {"silent_after": 0}, "silent_after must be"),
    (["x"], {"silent_after": True}, "silent_after must be"),
    (["x"], {"significant": True}, "a permanent child cannot be significant"),
]


@pytest.mark.parametrize(("command", "options", "problem"), BAD)
def test_a_bad_argument_is_refused_when_the_spec_is_built(command: Any, options: dict[str, Any], problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        hf.supervision.program(command, **options)


def test_a_pattern_keeps_its_flags_whatever_stands_in_it() -> None:
    for pattern in (re.compile("(?i)up", re.M), "(?i)up", re.compile("up", re.X | re.A)):
        assert hf.supervision.program(["x"], ready=pattern).id == "x"
