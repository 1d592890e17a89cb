"""An orderly stop does not wait for an answer of somebody who is suspended: the next program has it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.effects.clerk import IN_TIME

LONG = 1000.0
SHUTDOWN = 3.0


class Post(hf.Message[int]):
    ref: hf.ActorRef[Any] | None = None


class Posted(hf.Message[int]): ...


class Ledger(hf.Actor):
    def __init__(self) -> None:
        self.posted = 0

    @hf.on(Post)
    async def post(self, message: Post) -> int:
        if message.ref is not None:
            self.posted = await message.ref.ask(Post(), LONG)
        else:
            self.posted += 1
        return self.posted

    @hf.on(Posted)
    def count(self, message: Posted) -> int:
        return self.posted


def ledger(name: str, isolation: Any = "task") -> hf.ChildSpec[Ledger]:
    return hf.child(name, hf.start(Ledger), isolation=isolation, recovery=hf.hybrid(), shutdown=SHUTDOWN)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_stop_leaves_a_turn_that_waits_for_who_is_suspended(tmp_path: Path, isolation: str) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        books = await system.start(ledger("books"))
        till = await system.start(ledger("till", isolation))
        await system.suspend(books)
        till.tell(Post(books))
        async with asyncio.timeout(IN_TIME):
            while (await system.get_status(books)).queued == 0:
                await asyncio.sleep(0.01)
    async with hf.ActorSystem("app", log=False, store=store) as system:
        assert not system.history(kinds=["ShutdownError"]).events, "it was waited for"
        books, till = await system.start(ledger("books")), await system.start(ledger("till", isolation))
        assert [await till.ask(Posted(), IN_TIME), await books.ask(Posted(), IN_TIME)] == [1, 1]
