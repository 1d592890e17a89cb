"""What many turns have to write is written together, also when a write takes longer than a slice of the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

import holdfast as hf
from holdfast.checkpoint.journal import Entry
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.root_player import All, Ledger, Put

TELLS = 10_000
BURST = 1_000


class Counting(SqliteJournal):
    """A store that counts how often it is written to."""

    appends = 0

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        self.appends += 1
        return super().append(entries)


async def test_turns_of_a_recorded_actor_share_their_writes(tmp_path: Path) -> None:
    engine = Counting(tmp_path / "app.db")
    async with hf.ActorSystem("app", store=engine, log=False) as system:
        ledger = await system.start(hf.child("a", hf.start(Ledger), recovery=hf.hybrid(interval=1000.0)))
        before = engine.appends
        for number in range(TELLS):
            ledger.tell(Put(number))
            if number % BURST == BURST - 1:
                await asyncio.sleep(0)
        assert await ledger.ask(All(), timeout=60.0) == [*range(TELLS)]
        assert engine.appends - before < TELLS / 4, "each turn was written on its own"
