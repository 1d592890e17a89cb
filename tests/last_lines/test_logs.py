"""What processes of actors print, and what holdfast logs, is known to whoever asks: in the program, and by command."""

import asyncio
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.process.program import stdout
from holdfast.console.endpoint import served
from holdfast.console.remote import NotReached, RemoteSystem
from holdfast.console.wire import AskLogs
from holdfast.system.last_lines.line_memory import LineLimits
from holdfast.system.last_lines.line_page import LogQuestion
from tests.actors.process.players import Run, Worker
from tests.actors.process.waiting import next_event, until
from tests.console.commands import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")


async def worker_of(system: hf.ActorSystem, name: str = "worker") -> hf.ActorRef[Worker]:
    return await system.start(hf.child(name, hf.start(Worker), isolation="process"))


def said(system: hf.ActorSystem, path: str = "**") -> list[tuple[int, str]]:
    return [(line.life, line.text) for line in system.logs(path).lines]


@pytest.mark.parametrize("slowly", [False, True])
async def test_lines_before_kill_9_are_there_with_the_life_that_printed_them(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, slowly: bool
) -> None:
    """Also if they are read when the next life runs already."""
    if slowly:
        monkeypatch.setattr(stdout, "SLICE_SECONDS", 0.0)
    worker = await worker_of(system)
    many = [f"line {number}" for number in range(100)]
    with system.events() as events:
        await worker.ask(Run("print", ["first"]))
        await worker.ask(Run("write", [1, "\n".join([*many, "no end of line"]).encode()]))
        os.kill(system.pid_of(worker), signal.SIGKILL)
        await next_event(events, hf.events.ActorStarted)
        await worker.ask(Run("print", ["second"]))
    await until(lambda: len(said(system)) == 103)
    assert sorted(said(system), key=lambda one: one[0]) == [
        *((1, text) for text in ["first", *many, "no end of line"]),
        (2, "second"),
    ]


async def test_a_program_says_which_life_it_is(system: hf.ActorSystem) -> None:
    await system.start(hf.supervision.program(["sh", "-c", "echo out; echo err >&2; exit 3"], id="it"))
    await until(lambda: {life for life, _ in said(system, "/app/it")} >= {1, 2})
    first = [line for line in system.logs("/app/it").lines if line.life == 1]
    assert {(line.source, line.level, line.text) for line in first} == {
        ("stdout", "info", "out"),
        ("stderr", "warning", "err"),
    }


async def test_in_a_storm_of_events_lines_are_kept_all_the_same(system: hf.ActorSystem) -> None:
    await worker_of(system)
    [process] = system._workers.by_cell.values()
    system._node.events.rest("others")
    assert not system._node.events.has_listeners
    process._on_line("stdout", "in the storm")
    assert said(system) == [(1, "in the storm")]


async def test_a_flood_takes_no_more_memory_than_it_may_and_others_keep_their_lines(system: hf.ActorSystem) -> None:
    quiet, loud = await worker_of(system, "quiet"), await worker_of(system, "loud")
    await quiet.ask(Run("print", ["here I am"]))
    await until(lambda: said(system, "/app/quiet") == [(1, "here I am")])
    after, got, dropped, count = system.logs().next, 0, 0, 60_000
    writing = loud.ask(Run("write", [1, (b"x" * 99 + b"\n") * count]), timeout=60)
    memory, limits = system._line_memory, LineLimits()
    async with asyncio.timeout(60):
        while got + dropped < count:
            page = await system.follow_logs("/app/loud", after=after)
            after, got, dropped = page.next, got + len(page.lines), dropped + page.dropped
            assert memory.bytes <= 2 * limits.address_bytes
    await writing
    assert (got + dropped, got > 0) == (count, True)
    assert len(system.logs("/app/loud").lines) <= limits.lines
    assert said(system, "/app/quiet") == [(1, "here I am")]


async def test_whoever_follows_hears_of_each_line(system: hf.ActorSystem) -> None:
    worker = await worker_of(system)
    following = asyncio.create_task(system.follow_logs(worker, after=system.logs().next))
    await until(lambda: len(system._line_memory.followers) == 1)
    await worker.ask(Run("print", ["one"]))
    page = await following
    assert [line.text for line in page.lines] == ["one"]
    assert not system._line_memory.followers
    empty = await system.follow_logs(after=page.next, timeout=0.01)
    assert (empty.lines, empty.dropped, empty.next) == ([], 0, page.next)


async def test_what_holdfast_logs_is_among_them_if_it_logs(caplog: pytest.LogCaptureFixture) -> None:
    async with hf.ActorSystem("app", intensity=1000) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        with pytest.raises(hf.RemoteCrash):
            await worker.ask(Run("no such thing"))
        await until(lambda: bool(system.logs("/app/worker").lines))
        [line] = system.logs("/app/worker").lines
        assert (line.source, line.level) == ("holdfast", "error")
        assert line.text.startswith("actor crashed reason=")
        assert "\n" not in line.text
        assert "address=" not in line.text
    assert "actor crashed" in caplog.text


async def test_a_system_without_history_keeps_none() -> None:
    async with hf.ActorSystem("app", log=False, history=False) as system:
        with pytest.raises(hf.SpecError, match="made with history=False"):
            system.logs()


@pytest.mark.parametrize("asked", [{"limit": 0}, {"path": "x" * 2_000}, {"since": float("nan")}])
async def test_a_question_from_outside_is_checked_there(path: Path, asked: dict[str, Any]) -> None:
    def ask() -> None:
        with RemoteSystem(path) as remote:
            remote._client.call(AskLogs(LogQuestion(**asked)), 10.0)

    with pytest.raises(hf.SpecError):
        await asyncio.to_thread(ask)


@pytest.mark.parametrize(
    "ask",
    [
        lambda system: system.logs(level="loud"),
        lambda system: system.logs(limit=0),
        lambda system: system.logs(after="one"),
    ],
)
async def test_what_cannot_be_asked_is_refused(system: hf.ActorSystem, ask: Callable[[Any], Any]) -> None:
    with pytest.raises(hf.SpecError, match="logs"):
        ask(system)


async def test_whoever_follows_a_program_that_ends_is_not_left_waiting(tmp_path: Path) -> None:
    system = hf.ActorSystem("app", log=False)

    def follow() -> None:
        with RemoteSystem(tmp_path / "app.sock") as remote:
            asyncio.run(remote.follow_logs(after=0, timeout=600.0))

    async with served(system, tmp_path / "app.sock"):
        following = asyncio.create_task(asyncio.to_thread(follow))
        await until(lambda: len(system._line_memory.followers) == 1)
    with pytest.raises(NotReached):
        await following
    assert not (tmp_path / "app.sock").exists()


async def test_the_command_shows_them_and_what_a_terminal_would_obey_as_text(
    system: hf.ActorSystem, path: Path
) -> None:
    worker = await worker_of(system)
    system._node.register("till", worker._cell)
    await worker.ask(Run("write", [1, "red \x1b[31m \x9b \u202e grün\tok\n".encode()]))
    await worker.ask(Run("write", [2, b"careful\n"]))
    await until(lambda: len(said(system)) == 2)
    code, out, errors = await holdfast("logs", "till", "--socket", path)
    shown = sorted(line.split(" ", 2)[2] for line in out.splitlines())
    assert (code, errors) == (0, "")
    assert shown == [
        "/app/worker life 1 stderr: careful",
        "/app/worker life 1 stdout: red \\x1b[31m \\x9b \\u202e grün\tok",
    ]
    code, out, _ = await holdfast("logs", "/app/**", "--json", "--level", "warning", "--since", "1h", "--socket", path)
    [line] = map(json.loads, out.splitlines())
    assert (line["address"], line["life"], line["source"], line["text"]) == ("/app/worker", 1, "stderr", "careful")


async def test_the_command_says_why_there_is_nothing(system: hf.ActorSystem, path: Path, tmp_path: Path) -> None:
    await system.start(hf.child("task", hf.start(Worker)))
    code, out, errors = await holdfast("logs", "/app/task", "--socket", path)
    assert (code, out, "no process of their own is not kept here" in errors) == (0, "", True)
    code, out, errors = await holdfast("logs", "/app/nobody", "--socket", path)
    assert (code, out, "nobody is at /app/nobody" in errors) == (1, "", True)
    code, _, errors = await holdfast("logs", "--since", "yesterday", "--socket", path)
    assert (code, "--since: 'yesterday' is neither 90s" in errors) == (2, True)
    code, _, errors = await holdfast("logs", "--socket", tmp_path / "nobody.sock")
    assert (code, "no system answers at" in errors) == (2, True)


async def test_lines_that_are_followed_come_as_they_are_printed(system: hf.ActorSystem, path: Path) -> None:
    worker = await worker_of(system)
    await worker.ask(Run("print", ["one", "two"]))
    await until(lambda: len(said(system)) == 2)
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "holdfast.console.cli", "logs", "/app/worker", "-f", "--json", "--last", "1"),
        *("--socket", str(path)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    assert json.loads(await asyncio.wait_for(process.stdout.readline(), 60.0))["text"] == "two"
    await worker.ask(Run("print", ["three"]))
    assert json.loads(await asyncio.wait_for(process.stdout.readline(), 60.0))["text"] == "three"
    process.send_signal(signal.SIGINT)
    _, errors = await asyncio.wait_for(process.communicate(), 60.0)
    assert (process.returncode, errors) == (0, b"")
