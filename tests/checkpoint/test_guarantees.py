"""Lines of docs/guarantees.md that no other test shows in full."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Seen, until
from tests.checkpoint.strikes import NEVER, event, strike

IN_TIME = 25.0


class Mark(hf.Message):
    """Leave a mark outside, without `ctx.effect`; `gate`: and do not end before that file is there."""

    text: str
    gate: str = ""


class Marks(hf.Message[int]): ...


class Marker(hf.Actor):
    def __init__(self, path: str) -> None:
        self.path, self.count = path, 0

    @hf.on(Mark)
    async def mark(self, message: Mark) -> None:
        with Path(self.path).open("a") as file:
            file.write(message.text)
        while message.gate and not Path(message.gate).exists():
            await asyncio.sleep(0.001)
        self.count += 1

    @hf.on(Marks)
    def marks(self, message: Marks) -> int:
        return self.count


@pytest.mark.parametrize(
    ("method", "first", "second"),
    [
        (hf.hybrid(interval=NEVER), "bcd", "d"),
        (hf.replay_only(), "abcd", "abcd"),
        (hf.checkpoint_only(interval=NEVER), "d", "d"),
    ],
    ids=["hybrid", "replay_only", "checkpoint_only"],
)
async def test_what_a_handler_does_outside_is_repeated_as_its_method_says(
    tmp_path: Path, method: hf.Method, first: str, second: str
) -> None:
    """All turns since the snapshot, and a replay is followed by one; all since the start; or only the one in hand."""
    marks, gate = tmp_path / "marks", tmp_path / "gate"
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        spec = hf.child("marker", hf.start(Marker, str(marks)), recovery=method, isolation="process")
        ref = await system.start(spec)
        await ref.send(Mark("a"))
        assert await ref.ask(Marks(), IN_TIME) == 1
        if first != "abcd":
            await system.checkpoint(ref)
        for text in "bc":
            await ref.send(Mark(text))
        assert await ref.ask(Marks(), IN_TIME) == 3
        await ref.send(Mark("d", str(gate)))
        await until(lambda: marks.read_text() == "abcd")
        with system.events() as events:
            strike(system, ref)
            await until(lambda: len(marks.read_text()) >= len("abcd" + first), IN_TIME)
            if first == "bcd":
                await event(events, hf.events.SnapshotTaken)
        strike(system, ref)
        await until(lambda: len(marks.read_text()) >= len("abcd" + first + second), IN_TIME)
        gate.touch()
        assert await ref.ask(Marks(), IN_TIME)
        assert marks.read_text() == "abcd" + first + second


async def test_an_ask_ends_with_the_supervisor_that_gives_up_first(system: hf.ActorSystem, tmp_path: Path) -> None:
    """By default it allows one restart, and a message three deaths; of one that was told the deaths are counted on."""
    child = hf.child("doer", hf.start(Doer), isolation="process", recovery=hf.hybrid())
    await system.start(hf.supervisor("top", children=[child]))
    ref = system.ref("/app/top/doer", Doer)
    with system.events() as events:
        with pytest.raises(hf.AskFailed):
            await ref.ask(Do([f"die {tmp_path}/deaths"]), IN_TIME)
        await event(events, hf.events.SupervisorGaveUp)
    assert (tmp_path / "deaths").read_text() == "xx"
    assert await system.ref("/app/top/doer", Doer).ask(Seen(), IN_TIME) == []
    assert not system.quarantined()


class Go(hf.Message): ...


class News(hf.Message): ...


class Told(hf.Message[int]): ...


class Reader(hf.Actor):
    def __init__(self) -> None:
        self.news = 0

    @hf.subscribe("/news")
    @hf.on(News)
    def read(self, message: News) -> None:
        self.news += 1

    @hf.on(Told)
    def told(self, message: Told) -> int:
        return self.news


class Ask(hf.Message):
    """Ask another one, when a Go has come."""

    timeout: float


class Teller(hf.Actor):
    """Waits in a turn for a Go, and then tells the world, or asks somebody."""

    def __init__(self) -> None:
        self.said = ""

    @hf.on(News)
    async def tell(self, message: News) -> None:
        await self.ctx.wait_for(Go)
        await self.ctx.publish("/news", News())
        self.said = "told"

    @hf.on(Ask)
    async def ask(self, message: Ask) -> None:
        await self.ctx.wait_for(Go)
        try:
            await self.ctx.find("/app/late", Reader).ask(Told(), message.timeout)
        except hf.AskTimeout as late:
            self.said = f"late, handled: {late.handled}"

    @hf.on(Go)
    def go(self, message: Go) -> None: ...

    @hf.on(Seen)
    def seen(self, message: Seen) -> list[str]:
        return [self.said]


async def left_to_wait(store: str, message: hf.Message) -> None:
    """The program ends while the turn of the teller waits."""
    async with hf.ActorSystem("app", log=False, store=store) as system:
        await system.start(hf.child("late", hf.start(Reader), recovery=hf.hybrid()))
        teller = await system.start(TELLER)
        await teller.send(message)


TELLER = hf.child("teller", hf.start(Teller), recovery=hf.hybrid(interval=NEVER), shutdown=0.1)


async def test_a_publication_of_a_turn_that_goes_on_reaches_the_subscribers_that_are_up(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await left_to_wait(store, News())
    async with hf.ActorSystem("app", log=False, store=store) as system:
        early = await system.start(hf.child("early", hf.start(Reader)))
        teller = await system.start(TELLER)
        await teller.send(Go())
        assert await teller.ask(Seen(), IN_TIME) == ["told"]
        late = await system.start(hf.child("late", hf.start(Reader), recovery=hf.hybrid()))
        assert (await early.ask(Told()), await late.ask(Told())) == (1, 0)


async def test_the_time_of_an_ask_to_somebody_who_is_not_started_runs_on(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await left_to_wait(store, Ask(0.2))
    async with hf.ActorSystem("app", log=False, store=store) as system:
        teller = await system.start(TELLER)
        await teller.send(Go())
        [said] = await teller.ask(Seen(), IN_TIME)
        assert said.startswith("late, handled: ")


class Begins(hf.Actor):
    """Its lives after the first one do not begin before a file is there."""

    def __init__(self, gate: str) -> None:
        self._gate, self.turns = gate, 0

    async def on_start(self, restored: bool) -> None:
        while restored and not Path(self._gate).exists():
            await asyncio.sleep(0.001)

    @hf.on(Go)
    def go(self, message: Go) -> None: ...

    @hf.on(Told)
    def told(self, message: Told) -> int:
        self.turns += 1
        return self.turns


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_ask_whose_time_is_over_during_a_recovery_was_not_handled(tmp_path: Path, isolation: Any) -> None:
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("one", hf.start(Begins, str(gate)), isolation=isolation, recovery=hf.hybrid())
        ref = await system.start(spec)
        await ref.ask(Told(), IN_TIME)
        await system.checkpoint(ref)
        strike(system, ref)
        await until(lambda: ref._cell.life > 1 or not ref._cell.host.is_up(ref._cell))
        with pytest.raises(hf.AskTimeout) as late:
            await ref.ask(Told(), 0.05)
        gate.touch()
        assert late.value.handled is False
        assert await ref.ask(Told(), IN_TIME) == 2


class Blocks(hf.Actor):
    def __init__(self, gate: str) -> None:
        self._gate = gate

    @hf.on(Go)
    def go(self, message: Go) -> None:
        Path(f"{self._gate}.begun").touch()
        while not Path(self._gate).exists():
            time.sleep(0.001)  # It is the process that is blocked; nobody waits for a time.

    @hf.on(Told)
    def told(self, message: Told) -> int:
        return 1


async def test_what_waits_in_a_process_that_is_blocked_was_not_handled(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("one", hf.start(Blocks, str(gate)), isolation="process", recovery=hf.hybrid())
        ref = await system.start(spec)
        ref.tell(Go())
        await until(Path(f"{gate}.begun").exists)
        with pytest.raises(hf.AskTimeout) as late:
            await ref.ask(Told(), 0.05)
        gate.touch()
        assert late.value.handled is False
        assert await ref.ask(Told(), IN_TIME) == 1


async def test_a_replay_begins_behind_on_start(system: hf.ActorSystem) -> None:
    """So what this hook does to the state must be the same each time: the turns are handled again on top of it."""
    ref = await system.start(hf.child("one", hf.start(Shifts), recovery=hf.replay_only(), backoff=hf.Backoff()))
    assert await ref.ask(Told(), IN_TIME) == 2
    SHIFT[0] = 2
    with system.events() as events:
        ref.kill()
        assert "turn 1: the reply to" in (await event(events, hf.events.RecoveryFailed)).reason
    SHIFT[0] = 1
    assert await ref.ask(Told(), IN_TIME) == 3


SHIFT = [1]


class Shifts(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    def on_start(self, restored: bool) -> None:
        self.count = SHIFT[0]

    @hf.on(Told)
    def told(self, message: Told) -> int:
        self.count += 1
        return self.count


class Weathers(hf.Actor):
    """Its state depends on a file, and its replies do not."""

    def __init__(self, file: str) -> None:
        self._file, self.is_wet = file, False

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.is_wet = Path(self._file).exists()

    @hf.on(Told)
    def told(self, message: Told) -> int:
        return 1


@pytest.mark.parametrize("checks", [False, True])
async def test_a_replay_that_leaves_another_state_goes_unnoticed_unless_it_is_checked(
    system: hf.ActorSystem, tmp_path: Path, checks: bool
) -> None:
    rain, method = tmp_path / "rain", hf.hybrid(interval=NEVER, check_replay=checks)
    spec = hf.child("one", hf.start(Weathers, str(rain)), recovery=method, backoff=hf.Backoff())
    ref = await system.start(spec)
    await ref.send(Go())
    assert await ref.ask(Told(), IN_TIME) == 1
    rain.touch()
    with system.events() as events:
        ref.kill()
        if checks:
            assert "its state is not what it was" in (await event(events, hf.events.RecoveryFailed)).reason
            rain.unlink()
        else:
            await event(events, hf.events.Recovered)
    assert await ref.ask(Told(), IN_TIME) == 1
    assert (await system.get_state(ref))["is_wet"] is not checks


@pytest.mark.parametrize("restored", [True, False])
async def test_work_that_a_hook_has_begun_holds_up_no_snapshot(system: hf.ActorSystem, restored: bool) -> None:
    """The first start is a turn: its work does."""
    ref = await system.start(hf.child("one", hf.start(Listens, restored), recovery=hf.hybrid(interval=NEVER)))
    assert await ref.ask(Told(), IN_TIME) == 1
    if restored:
        await system.checkpoint(ref, timeout=IN_TIME)
        with system.events() as events:
            ref.kill()
            await event(events, hf.events.Recovered)
        assert await ref.ask(Told(), IN_TIME) == 2
    saved = asyncio.ensure_future(system.checkpoint(ref, timeout=IN_TIME))
    assert await ref.ask(Told(), IN_TIME) == 2 + restored
    if restored:
        await saved
    else:
        assert not saved.done()
        saved.cancel()


class Listens(hf.Actor):
    """Begins work that goes on for ever when it is started for the first time, or each time after that."""

    def __init__(self, wanted: bool) -> None:
        self._wanted, self.count = wanted, 0

    def on_start(self, restored: bool) -> None:
        if restored is self._wanted:
            self.ctx.pipe_to_self(asyncio.Event().wait(), lambda _: Go())

    @hf.on(Go)
    def go(self, message: Go) -> None: ...

    @hf.on(Told)
    def told(self, message: Told) -> int:
        self.count += 1
        return self.count
