"""The judge of a fleet finds each kind of wrong that a program may do: one that does is asked over its socket."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from holdfast.testing import NotLinearizable
from tests.cluster.machines.outside import Clients

SEED = 3
WRONGS = {
    "nothing": "",
    "an add is lost": "not linearizable|answered and not done",
    "an add is done twice": "not linearizable|done twice",
    "a look is stale": "not linearizable",
    "an answer of a leader that was deposed": "answered in epoch 1, behind epoch 2",
    "an add that is answered is not in the books": "answered and not done",
    "an add is twice in the books": "done twice",
    "the audit is told twice": "the audit was told",
    "the audit is told in another order": "the audit was told",
}


class Wrong:
    """Keeps sums as a right program does, but for one wrong, once, from its 30th request on."""

    def __init__(self, wrong: str) -> None:
        self.wrong = wrong
        self.sums: dict[str, int] = {}
        self.ids: list[int] = []
        self.audited: list[int] = []
        self.count = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one client."""
        while line := await reader.readline():
            writer.write(json.dumps(self.answer(json.loads(line))).encode() + b"\n")
        writer.close()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request."""
        self.count += 1
        found, epoch = self._done(request, self.wrong), 2
        if self.count > 30 and self.wrong == "an answer of a leader that was deposed":
            epoch = 1
        return {"pid": epoch, "epoch": epoch, "answer": found}

    def _done(self, request: dict[str, Any], wrong: str) -> Any:
        is_due = self.count > 30
        if "books" in request:
            return [self.ids, self.audited]
        if "of" in request:
            known = self.sums.get(request["of"], 0)
            return known - 1 if is_due and wrong == "a look is stale" else known
        number, to, amount = request["add"], request["to"], request["amount"]
        before = self.sums.get(to, 0)
        if is_due and wrong == "an add is lost":
            self.wrong = ""
            return before + amount
        times = 2 if is_due and wrong == "an add is done twice" else 1
        self.sums[to] = before + times * amount
        if is_due and wrong == "an add that is answered is not in the books":
            self.wrong = ""
            return self.sums[to]
        in_books = 2 if is_due and wrong == "an add is twice in the books" else times
        told = 2 if is_due and wrong == "the audit is told twice" else in_books
        self.ids += [number] * in_books
        self.audited += [number] * told
        if is_due and wrong == "the audit is told in another order":
            self.audited[-2:] = self.audited[:-3:-1]
        return before + amount if times == 2 else self.sums[to]


@pytest.mark.parametrize("wrong", WRONGS)
async def test_each_wrong_is_found(tmp_path: Path, wrong: str) -> None:
    program = Wrong(wrong)
    socket = tmp_path / "socket"
    async with await asyncio.start_unix_server(program.serve, socket):
        clients = Clients(socket, 4, SEED, pause=0.0)
        try:
            await clients.progress(100)
            await clients.stop()
            if wrong == "nothing":
                await clients.judge()
            else:
                with pytest.raises((AssertionError, NotLinearizable), match=WRONGS[wrong]):
                    await clients.judge()
        finally:
            await clients.close()
