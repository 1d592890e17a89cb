"""What a program prints, told to an actor line by line."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.services import program_lines
from holdfast.supervision.services.program_lines import MOST
from tests.actors.process.waiting import next_event, until
from tests.supervision.programs import info, python, refused, sh

ECHO = "for line in iter(input, 'quit'): print('got', line, flush=True)"


class Lines(hf.Message[list[tuple[str, str, str]]]): ...


class Listener(hf.Actor):
    """Keeps what it hears; waits for the gate before each line, if it has one."""

    def __init__(self, gate: asyncio.Event | None = None, crashes_on: str = "") -> None:
        self.heard: list[tuple[str, str, str]] = []
        self._gate, self._crashes_on = gate, crashes_on

    @hf.on(hf.supervision.ProgramLine)
    async def hear(self, line: hf.supervision.ProgramLine) -> None:
        if self._gate is not None:
            await self._gate.wait()
        if line.text == self._crashes_on:
            raise ValueError(line.text)
        self.heard.append((line.program, line.stream, line.text))

    @hf.on(Lines)
    def lines(self, message: Lines) -> list[tuple[str, str, str]]:
        return list(self.heard)


async def heard(listener: hf.ActorRef[Listener], count: int) -> list[str]:
    """The texts, when so many have come."""
    async with asyncio.timeout(30.0):
        while True:
            found = await listener.ask(Lines())
            if len(found) >= count:
                return [text for _, _, text in found]
            await asyncio.sleep(0.005)


async def say(system: hf.ActorSystem, text: str) -> None:
    await system.ref("/app/it", hf.supervision.Program).ask(hf.supervision.ProgramInput(f"{text}\n"), 30)


async def printed(events: hf.events.EventStream, text: str) -> None:
    while (await next_event(events, hf.events.LogLine)).text != text:
        pass


@pytest.mark.parametrize("how", ["ref", "address", "name", "recorded", "process"])
async def test_each_line_comes_in_order_and_says_where_from(system: hf.ActorSystem, how: str) -> None:
    options: dict[str, Any] = {"recovery": hf.hybrid()} if how == "recorded" else {}
    options |= {"isolation": "process"} if how == "process" else {}
    listener = await system.start(hf.child("listener", hf.start(Listener), **options))
    system.register("console", listener)
    to = {"address": listener.path, "name": "console"}.get(how, listener)
    await system.start(sh("for i in 1 2 3; do echo $i; done; exec sleep 99", lines_to=to))
    assert await heard(listener, 3) == ["1", "2", "3"]
    assert await listener.ask(Lines()) == [("/app/it", "stdout", text) for text in "123"]


async def test_so_it_is_below_a_supervisor_in_a_process(system: hf.ActorSystem) -> None:
    listener: hf.ActorRef[Listener] = await system.start(hf.child("listener", hf.start(Listener)))
    spec = sh("echo out; echo no >&2; exec sleep 99", lines_to=listener)
    await system.start(hf.supervisor("far", isolation="process", children=[spec]))
    assert sorted(await heard(listener, 2)) == ["no", "out"]
    assert sorted(await listener.ask(Lines())) == [("/app/far/it", "stderr", "no"), ("/app/far/it", "stdout", "out")]
    by_name = sh("exec sleep 99", id="named", lines_to="console")
    with pytest.raises(hf.StartFailed, match="the name 'console' is known in the root only: say an address"):
        await system.start(hf.supervisor("other", isolation="process", children=[by_name]))


async def test_a_program_that_prints_faster_than_its_lines_are_handled_waits(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    gate, done = asyncio.Event(), tmp_path / "done"
    listener = await system.start(hf.child("listener", hf.start(Listener, gate)))
    script = f"for n in range(20_000): print(n, '.' * 90)\nimport sys; sys.stdout.flush(); open({str(done)!r}, 'w')"
    with system.events() as events:
        await system.start(python(script, lines_to=listener, restart="temporary"))
        await until(lambda: listener._cell.host.backlog(listener._cell) >= MOST - 1)
        for _ in range(50):
            await info(system)  # It answers meanwhile.
        assert (await system.get_status(listener)).queued < MOST, "the hundredth is in hand"
        assert not done.exists()
        gate.set()
        await next_event(events, hf.events.ProcessDied)
    found = await heard(listener, 20_000)
    assert [int(text.split()[0]) for text in found] == list(range(20_000))


async def test_its_end_does_not_wait_for_its_lines(system: hf.ActorSystem) -> None:
    """Whoever does not handle lines keeps nobody from hearing of the end; the lines come all the same."""
    gate = asyncio.Event()
    listener = await system.start(hf.child("listener", hf.start(Listener, gate)))
    with system.events() as events:
        await system.start(python("for n in range(500): print(n)", lines_to=listener, restart="temporary"))
        assert (await next_event(events, hf.events.ProcessDied)).reason == hf.NORMAL
    gate.set()
    assert await heard(listener, 500) == [str(n) for n in range(500)]


async def test_the_first_lines_are_kept_until_the_receiver_is_there(system: hf.ActorSystem) -> None:
    with system.events() as events:
        await system.start(python(ECHO, stdin=True, lines_to="/app/listener"))
        for n in range(3 * MOST):
            await say(system, str(n))
        await printed(events, f"got {3 * MOST - 1}")
        listener = await system.start(hf.child("listener", hf.start(Listener)))
        await say(system, "now")
        assert await heard(listener, 3 * MOST + 1) == [*(f"got {n}" for n in range(3 * MOST)), "got now"]
        await system.stop(listener)
        await say(system, "gone")
        assert (await next_event(events, hf.events.DeadLetter)).message.text == "got gone"


class Bound(Listener):
    """Starts only when the program that it hears is up."""

    driver: hf.Binding[hf.supervision.Program]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_receiver_that_is_bound_to_the_program_hears_its_first_lines(
    system: hf.ActorSystem, isolation: Any
) -> None:
    hearing = hf.child("sense", hf.start(Bound), bindings={"driver": "/app/robot/lidar"}, isolation=isolation)
    lidar = sh("echo header; echo first; exec sleep 99", id="lidar", ready="first", lines_to="/app/robot/sense")
    await system.start(hf.supervisor("robot", children=[lidar, hearing]))
    sense = system.ref("/app/robot/sense", Bound)
    assert await heard(sense, 2) == ["header", "first"]


async def test_so_they_are_below_a_supervisor_in_a_process(system: hf.ActorSystem) -> None:
    lidar = sh("for n in 1 2 3 4 5; do echo $n; done; exec sleep 99", lines_to="/app/listener")
    with system.events() as events:
        await system.start(hf.supervisor("far", isolation="process", children=[lidar]))
        await printed(events, "5")
        listener: hf.ActorRef[Listener] = await system.start(hf.child("listener", hf.start(Listener)))
        assert await heard(listener, 5) == [*"12345"]


async def test_lines_that_wait_for_a_receiver_are_bounded_in_number_and_time(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program_lines, "MOST_KEPT", 3)
    monkeypatch.setattr(program_lines, "PATIENCE", 0.3)
    with system.events() as events:
        await system.start(python(ECHO, stdin=True, lines_to="/app/listener"))
        for n in range(5):
            await say(system, str(n))
        lost = [(await next_event(events, hf.events.DeadLetter)).message.text for _ in range(5)]
        assert lost == [f"got {n}" for n in range(5)]
        await say(system, "late")
        assert (await next_event(events, hf.events.DeadLetter)).message.text == "got late"


async def test_a_name_is_looked_up_for_each_line(system: hf.ActorSystem) -> None:
    one, two = [await system.start(hf.child(name, hf.start(Listener))) for name in ("one", "two")]
    await system.start(python(ECHO, stdin=True, lines_to="console"))
    for listener, text in ((one, "b"), (two, "c")):
        system.register("console", listener)
        await say(system, text)
        assert await heard(listener, 1) == [f"got {text}"]
        system.unregister("console")
    with system.events() as events:
        await say(system, "a")
        letter = await next_event(events, hf.events.DeadLetter)
        assert (letter.address, letter.message.text) == ("console", "got a")


@pytest.mark.parametrize("logged", [True, False])
async def test_lines_are_logged_unless_that_is_not_wanted(logged: bool, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "holdfast")
    async with hf.ActorSystem("app") as system:
        listener = await system.start(hf.child("listener", hf.start(Listener)))
        await system.start(sh("echo scan; exec sleep 99", lines_to=listener, log_lines=logged))
        assert await heard(listener, 1) == ["scan"]
        assert [line.text for line in system.logs("/app/it").lines if line.source == "stdout"] == ["scan"]
        told = [record for record in caplog.records if "scan" in record.getMessage()]
        assert len(told) == logged
        assert not [record for record in told if "is_logged" in record.getMessage()]


async def test_a_line_that_crashes_its_receiver_is_not_told_again(system: hf.ActorSystem) -> None:
    crashing = hf.start(Listener, None, "got bad")
    listener = await system.start(hf.child("listener", crashing))
    await system.start(python(ECHO, stdin=True, lines_to=listener))
    with system.events() as events:
        for text in ("bad", "good"):
            await say(system, text)
        assert await heard(listener, 1) == ["got good"]
        assert not [event for event in events.take() if isinstance(event, hf.events.DeadLetter)]


async def test_who_cannot_take_lines_is_named(system: hf.ActorSystem) -> None:
    await system.start(hf.child("deaf", hf.start(hf.Actor)))
    assert "/app/deaf has no handler for" in await refused(system, sh("exec sleep 99", lines_to="/app/deaf"))
    for wrong in (5, "", ["/app/deaf"]):
        with pytest.raises(hf.SpecError, match="lines_to must be a ref, an address or a registered name, not"):
            sh("exec sleep 99", lines_to=wrong)
