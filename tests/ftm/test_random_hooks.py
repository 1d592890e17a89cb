"""Random programs of an actor that fails, falls between its turns, and puts back what it has put aside when it returns.

Whatever dies: what is acknowledged is in the state, once, at the place that the reply has said. A run that has failed
leaves no trace, and as long as nothing ends at a moment of its own, no mechanism takes one run for another.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import StatesDiffer
from holdfast.ftm.group.group_place import GroupPlace
from tests.ftm.test_failover import pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

SEED = int(os.environ.get("HOLDFAST_SEED", "0"))
PROGRAMS = int(os.environ.get("HOLDFAST_PROGRAMS", "4"))
IN_TIME = 25.0
FAILED = -1


class Enter(hf.Message[int]):
    """Answered with how many have entered, this one included."""

    tag: int


class Wait(hf.Message[int]):
    """The same, when the door is open."""

    tag: int


class Open(hf.Message[None]): ...


class Close(hf.Message[None]): ...


class Fail(hf.Message[None]):
    """A turn that raises, and has changed the state before."""


class Fall(hf.Message[None]):
    """Have the life end soon, outside of any turn."""

    ticks: int = 0


class Note(hf.Message[None]):
    """Have a task write down, in a file for each process, that it was begun."""

    folder: str


class Entered(hf.Message[list[int]]): ...


class Room(hf.Actor):
    """Opens its door when it returns."""

    def __init__(self) -> None:
        self.tags: list[int] = []
        self.is_open = False
        self.returns = 0

    def on_recovered(self) -> None:
        self.returns += 1
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Enter)
    def enter(self, message: Enter) -> int:
        self.tags.append(message.tag)
        return len(self.tags)

    @hf.on(Wait)
    def wait(self, message: Wait) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        self.tags.append(message.tag)
        return len(self.tags)

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Close)
    def close(self, message: Close) -> None:
        self.is_open = False

    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        self.tags.append(FAILED)
        raise ValueError("failed")

    @hf.on(Fall)
    def fall(self, message: Fall) -> None:
        self.ctx.create_task(self._fall(message.ticks))

    async def _fall(self, ticks: int) -> None:
        for _ in range(ticks):
            await asyncio.sleep(0)
        raise RuntimeError("fell")

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.ctx.create_task(self._note(Path(message.folder)))

    async def _note(self, folder: Path) -> None:
        with (folder / str(os.getpid())).open("a") as file:
            file.write("noted\n")

    @hf.on(Entered)
    def entered(self, message: Entered) -> list[int]:
        return self.tags


class Program:
    """One random program: bursts of messages, and kills in between."""

    def __init__(self, system: hf.ActorSystem, ref: hf.ActorRef[Any], rng: random.Random, *, falls: bool) -> None:
        self.system, self.ref, self.rng, self.falls = system, ref, rng, falls
        self.replies: dict[int, int] = {}
        self.asks: list[asyncio.Task[None]] = []

    async def run(self) -> list[int]:
        """Run it; returns what the state has come to."""
        for _ in range(self.rng.randint(6, 14)):
            for _ in range(self.rng.randint(1, 12)):
                self._say()
                if self.rng.random() < 0.3:
                    await asyncio.sleep(0)
            await asyncio.sleep(self.rng.random() * 0.05)
            self._strike()
        self.asks.append(asyncio.create_task(self._order(Open())))
        await asyncio.wait_for(asyncio.gather(*self.asks), 2 * IN_TIME)
        return await self.ref.ask(Entered(), IN_TIME)

    def _say(self) -> None:
        at, tag = self.rng.random(), len(self.asks)
        if at < 0.75:
            self.asks.append(asyncio.create_task(self._enter(Enter(tag) if at < 0.45 else Wait(tag))))
        elif at < 0.93:
            message = Close() if at < 0.8 else Open() if at < 0.84 else Fail()
            self.asks.append(asyncio.create_task(self._order(message)))
        elif self.falls:
            self.ref.tell(Fall())

    def _strike(self) -> None:
        """Have all of it recover, or kill the process of the replica that leads."""
        at, place = self.rng.random(), self.ref._cell.host.place
        if at < 0.15:
            self.ref.kill()
        elif at < 0.3 and isinstance(place, GroupPlace) and place.group is not None:
            primary = place.group.membership.primary
            if primary is not None:
                with contextlib.suppress(KeyError, ProcessLookupError):  # It has ended by itself meanwhile.
                    os.kill(pid_of(self.system, self.ref, primary), signal.SIGKILL)

    async def _enter(self, message: Enter | Wait) -> None:
        """Ask until the door is open: nobody else may come to open it."""
        asked = asyncio.ensure_future(self.ref.ask(message, 2 * IN_TIME))
        while not (await asyncio.wait((asked,), timeout=1.0))[0]:
            await self._order(Open())
        self.replies[message.tag] = asked.result()

    async def _order(self, message: hf.Message[None]) -> None:
        with contextlib.suppress(hf.RemoteCrash):  # What `Fail` is for.
            await self.ref.ask(message, IN_TIME)


def mechanisms() -> dict[str, hf.ftm.Mechanism | tuple[hf.ftm.Mechanism, ...] | None]:
    return {
        "none": None,
        "pbr": hf.ftm.PBR(),
        "lfr": hf.ftm.LFR(compare_every=0.0),
        "tr": hf.ftm.TR(),
        "tmr": hf.ftm.TMR(),
        "pbr+tr": hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
    }


@pytest.mark.parametrize("name", ["pbr", "lfr", "tr", "tmr"])
async def test_a_life_that_ends_at_any_moment_of_a_batch_keeps_what_is_acknowledged(name: str) -> None:
    """Also between two of the pieces in which the batch is given to it: what the first ones have left ends with it."""
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        ref = await system.start(hf.child("room", hf.start(Room), recovery=hf.hybrid(), mechanism=mechanisms()[name]))
        await two_again(ref)
        tags = iter(range(10_000))
        for ticks in range(12):
            ref.tell(Fall(ticks))
            asked = [asyncio.ensure_future(ref.ask(Enter(next(tags)), IN_TIME)) for _ in range(40)]
            assert await asyncio.gather(*asked) == list(range(ticks * 40 + 1, ticks * 40 + 41))
        assert await ref.ask(Entered(), IN_TIME) == list(range(480))


@pytest.mark.parametrize("name", ["lfr", "tmr"])
async def test_a_task_is_not_begun_again_by_a_turn_that_was_handed_over(name: str, tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        ref = await system.start(hf.child("room", hf.start(Room), mechanism=mechanisms()[name]))
        await two_again(ref)
        await ref.ask(Note(str(tmp_path)), IN_TIME)
        for tag in range(3):
            with pytest.raises(hf.RemoteCrash):
                await ref.ask(Fail(), IN_TIME)
            assert await ref.ask(Enter(tag), IN_TIME) == tag + 1
        for one in tmp_path.iterdir():
            assert one.read_text() == "noted\n"
        assert list(tmp_path.iterdir())


@pytest.mark.pairs
@pytest.mark.parametrize("seed", range(SEED, SEED + PROGRAMS))
@pytest.mark.parametrize("falls", [False, True], ids=["stays up", "falls"])
@pytest.mark.parametrize("name", sorted(mechanisms()))
async def test_what_is_acknowledged_is_in_the_state_once(name: str, falls: bool, seed: int) -> None:
    await run_program(name, seed, falls=falls)


async def run_program(name: str, seed: int, *, falls: bool) -> None:
    """Run a program, and see what has become of what it said."""
    mechanism = mechanisms()[name]
    recovery = hf.hybrid(interval=0.05 if seed % 2 else 3600.0)
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        events = system.events()
        ref = await system.start(hf.child("room", hf.start(Room), recovery=recovery, mechanism=mechanism))
        if mechanism is not None:
            await two_again(ref)
        program = Program(system, ref, random.Random(seed), falls=falls)
        tags = await program.run()
        assert {tag: tags.index(tag) + 1 for tag in program.replies} == program.replies
        assert len(tags) == len(set(tags))
        assert FAILED not in tags
        if not falls:  # Else a life ends where it likes, which is what mechanisms that compare do not cover.
            told = hf.events.Masked, hf.events.Diverged, StatesDiffer
            assert [event for event in events.take() if isinstance(event, told)] == []
