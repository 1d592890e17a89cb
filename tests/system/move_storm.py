"""A storm of moves: actors below supervisors here and in processes are moved, protected and struck, all at once.

Clients number what they ask all the while. Each state has a mark of its own, so an answer says which state it is of,
and the how-manieth entry there. Every change has to end; what was acknowledged stands where it was said to stand, once
and in order; a state is lost by a strike only, and a recorded one never.

`python -m tests.system.move_storm FIRST LAST [STEPS]` carries out these seeds and prints each.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import random
import signal
import sys
import uuid
from collections.abc import Awaitable, Callable
from typing import Any

import holdfast as hf
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.testing.hanging import what_waits

IN_TIME = 40.0
"""Seconds in which whatever is asked is answered, and every change is over."""
SUPERVISORS = {"near": "task", "far": "process", "other": "process"}
TEAM = "team"
"""A supervisor below one of these, which is moved too, and given a process of its own."""
KINDS = ("plain", "slow", "kept")
PAUSES = (0.0, 0.0, 0.005, 0.03, 0.1, 0.3)
STRIKES = ((), ("crash",), ("crash", "kill"), ("crash", "crash", "kill", "kill_supervisor"))
CHANGES = (
    ("isolate", "move"),
    ("isolate", "protect", "detach"),
    ("isolate", "isolate", "move", "protect", "detach"),
    ("isolate", "isolate", "move", "protect", "detach", "give_up", "cancel", "suspend"),
    ("move", "move_team", "isolate_team"),
    ("isolate", "move", "move_team", "isolate_team", "protect", "detach", "give_up", "cancel", "suspend"),
)

Entry = tuple[str, int]
"""A client, and its number."""


class Enter(hf.Message[tuple[str, int]]):
    client: str
    number: int


class Crash(hf.Message[None]): ...


class Entries(hf.Message[tuple[str, list[Entry]]]): ...


class Book(hf.Actor):
    """Notes all entries in order, and says in which state, and where in it."""

    def __init__(self, mark: str = "") -> None:
        self.mark = mark or uuid.uuid4().hex[:6]
        self.entries: list[Entry] = []

    @hf.on(Enter)
    def enter(self, message: Enter) -> tuple[str, int]:
        self.entries.append((message.client, message.number))
        return self.mark, len(self.entries)

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("a strike")

    @hf.on(Entries)
    def tell_entries(self, message: Entries) -> tuple[str, list[Entry]]:
        return self.mark, self.entries


class SlowBook(Book):
    """Its turns wait for something."""

    @hf.on(Enter)
    async def enter(self, message: Enter) -> tuple[str, int]:  # type: ignore[override]  # as a handler it is one
        await asyncio.sleep(0.002)
        self.entries.append((message.client, message.number))
        return self.mark, len(self.entries)


@dataclasses.dataclass
class Known:
    """What is known of one book from outside."""

    name: str
    ref: hf.ActorRef[Any]
    is_recorded: bool
    strikes: int = 0
    told: dict[Entry, tuple[str, int]] = dataclasses.field(default_factory=dict)
    failed: list[str] = dataclasses.field(default_factory=list)

    def problems(self, mark: str, entries: list[Entry]) -> list[str]:
        """What is wrong, when the last state has this mark and these entries."""
        found: list[str] = []
        for client in {client for client, _ in entries}:
            numbers = [number for other, number in entries if other == client]
            if numbers != sorted(set(numbers)):
                found.append(f"{client} is doubled or out of order: {numbers}")
        if len(set(self.told.values())) < len(self.told):
            found.append("two entries were told the same")
        for entry, said in self.told.items():
            if said[0] == mark and entries[said[1] - 1 : said[1]] != [entry]:
                found.append(f"{entry} was told {said}, and is not there ({len(entries)} entries)")
        marks = {said[0] for said in self.told.values()} | {mark}
        if len(marks) > 1 + self.strikes:
            found.append(f"{len(marks)} states after {self.strikes} strikes")
        if self.failed and (self.is_recorded or not self.strikes):
            found.append(f"asks have failed: {self.failed[:3]}")
        return [f"{self.name}: {problem}" for problem in found]


class Storm:
    """One run; the seed decides what is begun and when, but not how it falls."""

    def __init__(self, seed: int, *, steps: int) -> None:
        self.chance = random.Random(seed)
        self.steps, self.strikes, self.changes = steps, self.chance.choice(STRIKES), self.chance.choice(CHANGES)
        self.books: list[Known] = []
        self.log: list[str] = []
        self._is_over = False

    async def run(self) -> list[str]:
        """Carry it out; returns what is wrong."""
        async with hf.ActorSystem("app", log=False, intensity=100_000) as self._system:
            await self._plant()
            clients = [asyncio.create_task(self._ask(book, f"c{n}")) for book in self.books for n in range(2)]
            begun: list[asyncio.Task[None]] = []
            for number in range(self.steps):
                begun.append(self._begin(number))
                await asyncio.sleep(self.chance.choice(PAUSES))
            found = await self._over(begun)
            self._is_over = True
            found += await self._over(clients)
            for book in self.books:
                try:
                    mark, entries = await self._last_word(book)
                except (hf.HoldfastError, TimeoutError) as error:
                    found.append(f"{book.name} says nothing: {error}")
                else:
                    found += book.problems(mark, [(client, number) for client, number in entries])
            return found

    async def _plant(self) -> None:
        for name, place in SUPERVISORS.items():
            isolation: Any = place
            specs = [
                hf.child(
                    f"{name}_{kind}",
                    hf.start(SlowBook if kind == "slow" else Book, name if kind == "kept" else ""),
                    recovery=hf.hybrid(interval=0.1) if kind == "kept" else None,
                )
                for kind in KINDS
            ]
            team = [] if name != "near" else [self._team()]
            children = [*specs, *team]
            await self._system.start(hf.supervisor(name, children=children, isolation=isolation, intensity=100_000))
            for spec in specs:
                ref = self._system.ref(f"/app/{name}/{spec.id}", Book)
                self.books.append(Known(spec.id, ref, spec.recovery is not None))
        self.team = self._system.ref(f"/app/near/{TEAM}", hf.Supervisor)
        for path, is_recorded in (("member", False), ("deep/kept_member", True)):
            ref = self._system.ref(f"{self.team.path}/{path}", Book)
            self.books.append(Known(path, ref, is_recorded))

    @staticmethod
    def _team() -> hf.ChildSpec:
        kept = hf.child("kept_member", hf.start(Book, "team"), recovery=hf.hybrid(interval=0.1))
        deep = hf.supervisor("deep", children=[kept], intensity=100_000)
        return hf.supervisor(TEAM, children=[hf.child("member", hf.start(Book)), deep], intensity=100_000)

    async def _ask(self, book: Known, client: str) -> None:
        number = 0
        while not self._is_over:
            number += 1
            try:
                mark, place = await book.ref.ask(Enter(client, number), IN_TIME)
            except hf.HoldfastError as error:
                book.failed.append(f"{client} {number}: {error}")
            else:
                book.told[client, number] = mark, place
            await asyncio.sleep(0.002)

    async def _over(self, tasks: list[asyncio.Task[None]]) -> list[str]:
        _, left = await asyncio.wait(tasks, timeout=IN_TIME)
        found = [f"has not ended: {one.get_name()}" for one in left] + ([what_waits()] if left else [])
        for one in left:
            one.cancel()
        found += [f"{one.get_name()}: {error!r}" for one in set(tasks) - left if (error := one.exception()) is not None]
        return found

    async def _last_word(self, book: Known) -> tuple[str, list[Entry]]:
        """The state and the entries at the end. It may have been struck just before."""
        async with asyncio.timeout(IN_TIME):
            while True:
                try:
                    return await book.ref.ask(Entries(), IN_TIME)
                except (hf.AskFailed, hf.ActorStopped):
                    await asyncio.sleep(0.05)

    # -- what is done -------------------------------------------------------------------------------------------------

    def _begin(self, number: int) -> asyncio.Task[None]:
        book = self.chance.choice(self.books[:2] if self.chance.random() < 0.5 else self.books)
        verb = self.chance.choice((*self.changes, *self.strikes))
        name = f"{number} {verb} {book.name}"
        self.log.append(name)
        return asyncio.create_task(self._noted(name, VERBS[verb](self, book)), name=name)

    async def _noted(self, name: str, work: Awaitable[object]) -> None:
        try:
            said = await work
        except hf.HoldfastError as error:
            said = error
        self.log.append(f"    {name}: {said or 'done'}")

    @property
    def _seconds(self) -> float:
        return self.chance.choice((2.0, 10.0))

    async def _change(self, collect: Callable[[hf.system.Change], None], seconds: float) -> None:
        async with self._system.transaction(timeout=seconds) as change:
            collect(change)

    async def isolate(self, book: Known) -> None:
        to: Any = self.chance.choice(("task", "process"))
        await self._system.set_isolation(book.ref, to, timeout=self._seconds)

    async def move(self, book: Known) -> None:
        to = self.chance.choice([*(f"/app/{name}" for name in SUPERVISORS), self.team.path])
        await self._change(lambda change: change.move(book.ref, to), self._seconds)

    async def move_team(self, book: Known) -> None:
        to = self.chance.choice([*SUPERVISORS])
        await self._change(lambda change: change.move(self.team, f"/app/{to}"), self._seconds)

    async def isolate_team(self, book: Known) -> None:
        to: Any = self.chance.choice(("task", "process"))
        await self._system.set_isolation(self.team, to, timeout=self._seconds)

    async def protect(self, book: Known) -> None:
        mechanism = self.chance.choice((PBR, LFR))()
        await self._change(lambda change: change.protect(book.ref, mechanism), self._seconds)

    async def detach(self, book: Known) -> None:
        await self._change(lambda change: change.protect(book.ref, None), self._seconds)

    async def give_up(self, book: Known) -> None:
        """A transaction that has hardly any time."""
        to = self.chance.choice([*SUPERVISORS])
        isolation: Any = self.chance.choice(("task", "process"))
        collect: Callable[[hf.system.Change], None] = self.chance.choice(
            (
                lambda change: change.move(book.ref, f"/app/{to}"),
                lambda change: change.move(self.team, f"/app/{to}"),
                lambda change: change.protect(book.ref, PBR()),
                lambda change: change.isolation(book.ref, isolation),
            )
        )
        await self._change(collect, self.chance.choice((0.01, 0.05, 0.2, 0.5)))

    async def cancel(self, book: Known) -> None:
        work = self.chance.choice((self.isolate, self.move, self.move_team, self.protect, self.detach))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(work(book), self.chance.choice((0.001, 0.01, 0.1, 0.5)))

    async def suspend(self, book: Known) -> None:
        await self._system.suspend(book.ref)
        await asyncio.sleep(self.chance.choice((0.0, 0.01, 0.1)))
        with contextlib.suppress(hf.errors.NotSuspended):
            await self._system.resume(book.ref)

    async def crash(self, book: Known) -> None:
        for _ in range(self.chance.choice((1, 1, 1, 8))):
            book.strikes += 1
            with contextlib.suppress(hf.AskFailed):
                await book.ref.ask(Crash(), IN_TIME)

    async def kill(self, book: Known) -> None:
        pid = self._system.pid_of(book.ref)
        if pid == os.getpid():
            book.strikes += 1
            book.ref.kill()
        else:
            self._strike(pid)

    async def kill_supervisor(self, book: Known) -> None:
        path = self.chance.choice(("/app/far", "/app/other", self.team.path))
        pid = self._system.pid_of(self._system.ref(path, hf.Supervisor))
        if pid != os.getpid():
            self._strike(pid)

    def _strike(self, pid: int) -> None:
        for book in self.books:
            book.strikes += 1  # Any of them may live there.
        with contextlib.suppress(ProcessLookupError):  # It has ended by itself.
            os.kill(pid, signal.SIGKILL)


VERBS: dict[str, Callable[[Storm, Known], Awaitable[object]]] = {
    verb: vars(Storm)[verb] for verb in dict.fromkeys(verb for verbs in (*CHANGES, *STRIKES) for verb in verbs)
}


def main(first: int, last: int, steps: int) -> None:
    for seed in range(first, last):
        storm = Storm(seed, steps=steps)
        found = asyncio.run(storm.run())
        acknowledged = sum(len(book.told) for book in storm.books)
        print(f"seed {seed}: {acknowledged} acknowledged, {'FAILED' if found else 'ok'}", flush=True)
        if found:
            print(*found, *storm.log, sep="\n", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 60)
