"""An ask whose asker has given up before its turn begins is not handled, wherever it waits and whoever is asked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import pytest

import holdfast as hf
from tests.checkpoint.conftest import ROOT
from tests.checkpoint.players import Barrier, Let, Pass, start, until
from tests.checkpoint.strikes import NEVER, strike

pytestmark = pytest.mark.usefixtures("warm_programs")

SHORT = 0.2
METHODS: dict[str, Any] = {
    "plain": None,
    "hybrid": hf.hybrid(interval=NEVER),
    "replay_only": hf.replay_only(),
    "checkpoint_only": hf.checkpoint_only(NEVER),
}


class Book(hf.Message):
    who: str


class Hold(hf.Message): ...


class Take(hf.Message): ...


class Open(hf.Message):
    goes_on: bool = False


class Booked(hf.Message[list[str]]): ...


class Hotel(hf.Actor):
    def __init__(self) -> None:
        self.is_open = self.goes_on = False
        self.booked: list[str] = []

    async def _barrier(self) -> None:
        await self.ctx.find("/app/barrier", Barrier).ask(Pass(), timeout=600.0)

    @hf.on(Book)
    async def book(self, message: Book) -> None:
        if not self.is_open:
            self.ctx.stash()
            return
        if self.goes_on:
            await self._barrier()
        self.booked.append(message.who)

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open, self.goes_on = True, message.goes_on
        self.ctx.unstash()

    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        self.is_open = True
        await self._barrier()

    @hf.on(Take)
    async def take(self, message: Take) -> None:
        self.is_open = True
        await self._barrier()
        try:
            self.booked.append((await self.ctx.wait_for(Book, timeout=SHORT)).who)
        except hf.errors.WaitTimeout:
            pass

    @hf.on(Booked)
    def read(self, message: Booked) -> list[str]:
        return self.booked


async def waits_at(barrier: hf.ActorRef[Barrier], count: int = 1) -> None:
    await until(lambda: len(barrier._cell.actor.waiting) >= count)  # type: ignore[union-attr]  # it is here


async def gives_up(hotel: hf.ActorRef[Hotel]) -> None:
    with pytest.raises(hf.AskTimeout):
        await hotel.ask(Book("late"), timeout=SHORT)


async def is_back(hotel: hf.ActorRef[Hotel], life: int) -> None:
    await until(lambda: hotel._cell.life > life and hotel._cell.host.is_up(hotel._cell))


Way = Literal["queued", "stashed", "waited for"]
ROWS = [
    (name, where, way, is_struck)
    for name, method in METHODS.items()
    for where in ("task", "process")
    for way in ("queued", "stashed", "waited for")
    for is_struck in (False, True)
    if way != "waited for" or (method is not None and method.replays)
]


@pytest.mark.parametrize(("name", "where", "way", "is_struck"), ROWS)
@pytest.mark.some(30)
async def test_who_has_given_up_before_the_turn_begins_is_not_served(
    system: hf.ActorSystem, name: str, where: str, way: Way, is_struck: bool
) -> None:
    """Neither as a task nor in a process, nor after a crash; who waits for longer is."""
    barrier = await system.start(hf.child("barrier", hf.start(Barrier)))
    hotel = await start(system, where, "hotel", hf.start(Hotel), recovery=METHODS[name])
    if way != "stashed":
        hotel.tell(Take() if way == "waited for" else Hold())
        await waits_at(barrier)
    await gives_up(hotel)
    patient = None if way == "waited for" else hotel.ask(Book("patient"), timeout=600.0)
    if way == "stashed":
        await hotel.ask(Booked(), timeout=60.0)
    if is_struck:
        life = hotel._cell.life
        strike(system, hotel)
        await is_back(hotel, life)
    await barrier.ask(Let(), timeout=60.0)
    await hotel.ask(Open(), timeout=60.0)
    if patient is not None and way == "stashed" and is_struck and (name, where) == ("plain", "process"):
        with pytest.raises(hf.errors.HoldfastError):  # Its stash ends with its process.
            await patient
        patient = None
    elif patient is not None:
        await patient
    assert await hotel.ask(Booked(), timeout=60.0) == ([] if patient is None else ["patient"])


@pytest.mark.parametrize("where", ["task", "process"])
@pytest.mark.parametrize("name", ["hybrid", "replay_only"])
@pytest.mark.some(2)
async def test_a_turn_that_has_begun_in_time_is_finished_in_the_next_life(
    system: hf.ActorSystem, name: str, where: str
) -> None:
    """Also that of a message that was put aside before: what it has sent has left, so it is not dropped."""
    barrier = await system.start(hf.child("barrier", hf.start(Barrier)))
    hotel = await start(system, where, "hotel", hf.start(Hotel), recovery=METHODS[name])
    late = hotel.ask(Book("late"), timeout=2.0)
    await hotel.ask(Booked(), timeout=60.0)
    hotel.tell(Open(goes_on=True))
    await waits_at(barrier)
    with pytest.raises(hf.AskTimeout):
        await late
    life = hotel._cell.life
    strike(system, hotel)
    await is_back(hotel, life)
    await barrier.ask(Let(), timeout=60.0)
    assert await hotel.ask(Booked(), timeout=60.0) == ["late"]


PROGRAM = """
import asyncio, os, sys
import holdfast as hf
from tests.checkpoint.test_given_up import METHODS, Barrier, Booked, Hold, Hotel, Let, Open, SHORT, Book, waits_at


async def main(store: str, name: str, way: str, is_first: bool) -> None:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        barrier = await system.start(hf.child("barrier", hf.start(Barrier), recovery=hf.hybrid()))
        hotel = await system.start(hf.child("hotel", hf.start(Hotel), recovery=METHODS[name]))
        if is_first:
            if way == "queued":
                await hotel.send(Hold())
                await waits_at(barrier)
            try:
                await hotel.ask(Book("late"), timeout=SHORT)
            except hf.AskTimeout as late:
                print(late.handled, flush=True)
                os.kill(os.getpid(), 9)
        await barrier.ask(Let(), timeout=60.0)
        await hotel.ask(Open(), timeout=60.0)
        print(await hotel.ask(Booked(), timeout=60.0))

asyncio.run(main(*sys.argv[1:4], sys.argv[4] == "first"))
"""


@pytest.mark.parametrize("way", ["queued", "stashed"])
@pytest.mark.parametrize("name", ["hybrid", "replay_only"])
def test_the_next_program_handles_what_was_accepted_unless_its_asker_was_told_otherwise(
    tmp_path: Path, name: str, way: str
) -> None:
    told, booked = ("False", "[]") if way == "queued" else ("None", "['late']")
    for turn, code, out in (("first", -9, f"{told}\n"), ("next", 0, f"{booked}\n")):
        command = [sys.executable, "-c", PROGRAM, f"sqlite:{tmp_path / 'app.db'}", name, way, turn]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        assert (done.returncode, done.stdout) == (code, out), done.stderr
