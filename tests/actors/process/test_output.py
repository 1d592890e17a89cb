"""What an actor's process prints comes as LogLine events under its address, whatever it is."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import LogLine
from holdfast.actors.process.program import stdout
from holdfast.actors.process.program.stdout import LONGEST, OutputReader
from tests.actors.process.players import Run, Worker
from tests.actors.process.waiting import next_event, until


async def lines(system: hf.ActorSystem, what: str, with_: Any, last: str, stream: str = "stdout") -> list[str]:
    """What arrives on a stream, up to and without the line `last`."""
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    found: list[str] = []
    with system.events() as events:
        await worker.ask(Run(what, with_))
        while (line := await next_event(events, LogLine, lambda line: line.stream == stream)).text != last:
            assert line.address == "/app/worker"
            found.append(line.text)
    return found


async def test_lines_come_under_the_address_of_the_actor(system: hf.ActorSystem) -> None:
    assert await lines(system, "print", ["one", "two", "", "grün", "end"], "end") == ["one", "two", "", "grün"]


async def test_stderr_is_told_apart(system: hf.ActorSystem) -> None:
    assert await lines(system, "write", [2, b"warning\nend\n"], "end", "stderr") == ["warning"]


async def test_a_very_long_line_comes_in_pieces_and_none_is_lost(system: hf.ActorSystem) -> None:
    text = "".join(chr(ord("a") + number % 26) for number in range(1_000_000))
    pieces = await lines(system, "write", [1, text.encode() + b"\nend\n"], "end")
    assert "".join(pieces) == text
    assert len(pieces) > 1
    assert max(map(len, pieces)) <= LONGEST + 64 * 1024, "no piece grows without bound"


async def test_a_piece_does_not_cut_a_character(system: hf.ActorSystem) -> None:
    text = "€" * 100_000
    assert "".join(await lines(system, "write", [1, text.encode() + b"\nend\n"], "end")) == text


async def test_binary_junk_is_shown_as_text(system: hf.ActorSystem) -> None:
    junk = bytes(byte for byte in range(256) if byte != 10)
    found = await lines(system, "write", [1, junk + b"\nend\n"], "end")
    assert found == [junk.decode("utf-8", "replace")]


async def test_what_is_printed_last_before_kill_9_is_not_lost(system: hf.ActorSystem) -> None:
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    with system.events() as events:
        await worker.ask(Run("write", [1, b"no end of line"]))
        worker.kill()
        assert (await next_event(events, LogLine)).text == "no end of line"


async def test_a_program_that_prints_without_end_does_not_hold_up_the_root(system: hf.ActorSystem) -> None:
    """Lines are read in pieces, and the program's own callbacks run in between."""
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    writing = worker.ask(Run("write", [1, (b"x" * 99 + b"\n") * 100_000]), timeout=30)
    longest, before = 0.0, system._node.loop.time()
    while not writing.done():
        await asyncio.sleep(0)
        now = system._node.loop.time()
        longest, before = max(longest, now - before), now
    await writing
    assert longest < 1.0


async def test_of_a_flood_of_short_lines_others_have_their_turn_in_between(system: hf.ActorSystem) -> None:
    """Counted in lines that come between two turns of ours: a pipe holds 32,768 of them, and one read takes all."""
    flood = 100_000
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    with system.events() as events:
        writing = worker.ask(Run("write", [1, b"y\n" * flood]), timeout=60)
        came = list[int]()
        async with asyncio.timeout(60):
            while sum(came) + events.missed < flood:
                await asyncio.sleep(0)
                came.append(sum(isinstance(event, LogLine) for event in events.take()))
        await writing
    assert max(came) < 8_192


async def test_the_end_of_the_pipe_is_the_end_of_the_reader() -> None:
    out, into = os.pipe2(os.O_CLOEXEC)
    os.set_blocking(out, False)
    found: list[str] = []
    reader = OutputReader(asyncio.get_running_loop(), out, found.append)
    os.write(into, b"a\nb")
    os.close(into)
    await until(lambda: found == ["a", "b"])
    reader.close()
    reader.close()
    assert found == ["a", "b"]


async def test_others_have_their_turn_between_the_lines_of_one_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stdout, "SLICE_SECONDS", 0.0)
    loop = asyncio.get_running_loop()
    out, into = os.pipe2(os.O_CLOEXEC)
    os.set_blocking(out, False)
    turns, found = 0, list[int]()
    closed = asyncio.Event()

    def take_turn() -> None:
        nonlocal turns
        turns += 1
        if not closed.is_set():
            loop.call_soon(take_turn)

    loop.call_soon(take_turn)
    os.write(into, b"y\n" * 1000)
    reader = OutputReader(loop, out, lambda line: found.append(turns))
    await until(lambda: len(found) == 1000)
    os.write(into, b"y\n" * 1000)
    os.close(into)
    reader.close(closed.set)  # What is left is taken in the same way.
    await asyncio.wait_for(closed.wait(), 60)
    assert len(found) == 2000
    assert max(found.count(turn) for turn in set(found)) <= 2
