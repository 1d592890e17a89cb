"""While a turn rests, asks that change nothing are answered beside it; everything else waits."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.effects.clerk import IN_TIME, lines, note
from tests.effects.test_long_waits import end_of, running, waits


class Go(hf.Message[list[str]]):
    """Take down "begun", wait for `times` words, and return all that was taken down."""

    times: int = 1
    file: str = ""


class Word(hf.Message):
    word: str


class See(hf.Message[list[str]]): ...


class SeeSoon(hf.Message[list[str]]):
    """The handler is async, and waits `wait`."""

    wait: bool = False


class Odd(hf.Message[str]):
    """The handler is said to change nothing, and does `how`."""

    how: str
    file: str = ""


class Told(hf.Message): ...


class Add(hf.Message[int]): ...


class No(hf.Refusal):
    why: str


class Sleeper(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[str] = []

    @hf.on(Go)
    async def go(self, message: Go) -> list[str]:
        self.seen.append("begun")
        numbers = [self.ctx.random.random()]
        for _ in range(message.times):
            self.seen.append((await self.ctx.wait_for(Word)).word)
            numbers.append(self.ctx.random.random())
            if message.file:
                await self.ctx.effect(note, message.file, self.seen[-1])
        self.numbers = numbers
        return self.seen

    @hf.on(Word)
    def word(self, message: Word) -> None:
        self.seen.append(f"not waited for: {message.word}")

    @hf.on(See, readonly=True)
    def see(self, message: See) -> list[str]:
        assert self.ctx.ref.path == self.ctx.path
        assert self.ctx.now() > 0 < self.ctx.life
        assert self.ctx.sender is None
        return self.seen

    @hf.on(SeeSoon, readonly=True)
    async def see_soon(self, message: SeeSoon) -> list[str]:
        async with asyncio.timeout(IN_TIME):
            if message.wait:
                await asyncio.sleep(0.001)
        return self.seen

    @hf.on(Odd, readonly=True)
    async def odd(self, message: Odd) -> str:
        try:
            match message.how:
                case "tells":
                    self.ctx.ref.tell(Told())
                case "asks":
                    await self.ctx.find(self.ctx.path, Sleeper).ask(See())
                case "draws":
                    return str(self.ctx.random.random())
                case "refuses":
                    raise No("not today")
                case "promises":
                    return self.ctx.reply_handle()  # type: ignore[return-value]  # that is the point
                case "dies":
                    note(message.file, "died")
                    os.kill(os.getpid(), signal.SIGKILL)
                case "dies once" if note(message.file, "died") == 1:
                    os.kill(os.getpid(), signal.SIGKILL)
                case _:
                    pass
        except hf.HoldfastError as error:
            if isinstance(error, No):
                raise
        return f"{message.how}: {self.seen[-1]}"

    @hf.on(Told)
    def told(self, message: Told) -> None:
        self.seen.append("told")

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append("added")
        return len(self.seen)


def sleeper(isolation: Any = "task", **options: Any) -> hf.ChildSpec[Sleeper]:
    method = options.pop("recovery", hf.hybrid(interval=1000.0))
    return hf.child("sleeper", hf.start(Sleeper), isolation=isolation, recovery=method, **options)


PATH = "/app/sleeper"


async def resting(system: hf.ActorSystem, ref: hf.ActorRef[Sleeper], **options: Any) -> asyncio.Future[list[str]]:
    asked = ref.ask(Go(**options), IN_TIME)
    await waits(system, ref.path)
    return asked


@pytest.mark.parametrize("mailbox", [None, hf.bounded(8), hf.bounded(8, overflow="drop_oldest")])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_it_is_seen_what_there_is_now_and_all_else_waits(tmp_path: Path, isolation: str, mailbox: Any) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(sleeper(isolation, mailbox=mailbox))
        early: list[asyncio.Future[Any]] = [ref.ask(Go(2), IN_TIME), ref.ask(Add(), IN_TIME), ref.ask(See(), IN_TIME)]
        assert await early[2] == ["begun"]
        added = ref.ask(Add(), IN_TIME)
        assert await ref.ask(SeeSoon(), IN_TIME) == ["begun"]
        await ref.ask(Word("a"), IN_TIME)
        assert await ref.ask(See(), IN_TIME) == ["begun", "a"]
        await ref.ask(Word("b"), IN_TIME)
        assert await early[0] == ["begun", "a", "b"]
        assert [await early[1], await added] == [4, 5]
        assert ref._cell.life == 1  # No life has said of an input that it has ended twice.


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_below_a_supervisor_with_a_process(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path) as system:
        await system.start(hf.supervisor("team", children=[sleeper(isolation)], isolation="process"))
        ref = system.ref("/app/team/sleeper", Sleeper)
        asked = await resting(system, ref)
        assert await ref.ask(See(), IN_TIME) == ["begun"]
        await ref.ask(Word("a"), IN_TIME)
        assert await asked == ["begun", "a"]


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("how", ["tells", "asks", "draws", "promises", "waits"])
async def test_what_does_more_than_look_waits_for_its_turn(tmp_path: Path, isolation: str, how: str) -> None:
    """And leaves no trace in the turn that rests, whose replay would diverge."""
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper(isolation))
        asked = await resting(system, ref, times=2)
        odd: asyncio.Future[Any] = ref.ask(SeeSoon(wait=True) if how == "waits" else Odd(how), IN_TIME)
        assert await ref.ask(See(), IN_TIME) == ["begun"]
        assert not odd.done()
        await ref.ask(Word("a"), IN_TIME)
        await waits(system, PATH)
        await end_of(system, isolation, PATH)
        await ref.ask(Word("b"), IN_TIME)
        assert await asked == ["begun", "a", "b"]
        if how != "promises":
            await odd
        wanted = ["begun", "a", "b", *(["told"] if how == "tells" else [])]
        assert await ref.ask(See(), IN_TIME) == wanted
        await end_of(system, isolation, PATH)
        assert await ref.ask(See(), IN_TIME) == wanted


async def test_a_refusal_is_an_answer(tmp_path: Path) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(sleeper("process"))
        asked = await resting(system, ref)
        with pytest.raises(No, match="not today"):
            await ref.ask(Odd("refuses"), IN_TIME)
        await ref.ask(Word("a"), IN_TIME)
        assert await asked == ["begun", "a"]


@pytest.mark.parametrize("durability", ["memory", "os"])
async def test_one_that_ends_the_process_is_asked_again_and_then_put_aside(tmp_path: Path, durability: str) -> None:
    """The turn that rests is not blamed, and goes on."""
    world = str(tmp_path / "world")
    async with running(tmp_path, durability) as system:
        ref = await system.start(sleeper("process"))
        asked = await resting(system, ref, times=2, file=str(tmp_path / "effects"))
        assert await ref.ask(Odd("dies once", world), IN_TIME) == "dies once: begun"
        await waits(system, PATH)
        await ref.ask(Word("a"), IN_TIME)
        await waits(system, PATH)
        with pytest.raises(hf.Quarantined):
            await ref.ask(Odd("dies", world), IN_TIME)
        await waits(system, PATH)
        await ref.ask(Word("b"), IN_TIME)
        assert await asked == ["begun", "a", "b"]
        assert len(lines(world)) == 1 + 1 + 3
        assert lines(tmp_path / "effects") == ["a", "b"]
        await end_of(system, "process", PATH)
        assert await ref.ask(See(), IN_TIME) == ["begun", "a", "b"]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_kills_between_all_steps_change_nothing(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper(isolation))
        asked = asyncio.ensure_future(ref.ask(Go(3), IN_TIME))
        said = ["begun"]
        for word in "abc":
            await waits(system, PATH)
            seen = ref.ask(See(), IN_TIME)  # Perhaps it is answered by the life that is ended now, or by the next one.
            await end_of(system, isolation, PATH)
            assert await seen == said
            await waits(system, PATH)
            assert await ref.ask(See(), IN_TIME) == said
            await end_of(system, isolation, PATH)
            await waits(system, PATH)
            await ref.ask(Word(word), IN_TIME)
            said = [*said, word]
        assert await asked == said
        await end_of(system, isolation, PATH)
        assert await ref.ask(See(), IN_TIME) == said
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper(isolation))
        assert await ref.ask(See(), IN_TIME) == said


async def test_the_next_program_goes_on_without_what_was_answered(tmp_path: Path) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper())
        asked = await resting(system, ref)
        for _ in range(3):
            assert await ref.ask(See(), IN_TIME) == ["begun"]
    with pytest.raises(hf.AskFailed):
        await asked
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper())
        await waits(system, PATH)
        assert len(system._node.cell_at(PATH).host.home.switch.open) == 1  # type: ignore[attr-defined]  # a unit
        assert await ref.ask(See(), IN_TIME) == ["begun"]


async def test_behind_a_mechanism_they_wait(tmp_path: Path) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(sleeper(mechanism=hf.ftm.TR()))
        asked = await resting(system, ref)
        seen = ref.ask(See(), IN_TIME)
        await asyncio.sleep(0.05)
        assert not seen.done()
        await ref.ask(Word("a"), IN_TIME)
        assert await asked == await seen == ["begun", "a"]
