"""A program that stands by, leads, and does what its clients ask for over a Unix socket, one JSON line a request.

    python -m tests.cluster.bank STORE SOCKET [task | process]

Whoever leads listens on the socket; a request `{"id": 7, "amount": 3}` is answered with the balance, and done once.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any, Literal

import holdfast as hf


class Deposit(hf.Message[int]):
    id: int
    amount: int


class Add(hf.Message[int]):
    amount: int


class Report(hf.Message[dict[str, int]]): ...


class Account(hf.Actor):
    """Adds up what it is given; the same id counts once."""

    def __init__(self) -> None:
        self.balance = 0
        self.done: dict[int, int] = {}

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        known = self.done.get(message.id)
        if known is None:
            self.balance += message.amount
            known = self.done[message.id] = self.balance
        return known

    @hf.on(Add)
    def add(self, message: Add) -> int:
        """As a deposit, but each one counts, also one that is the same again."""
        self.balance += message.amount
        return self.balance

    @hf.on(Report)
    def report(self, message: Report) -> dict[str, int]:
        return {"balance": self.balance, "count": len(self.done)}


async def main() -> None:
    store, socket = sys.argv[1:3]
    isolation: Literal["task", "process"] = "process" if sys.argv[3:] == ["process"] else "task"
    async with hf.ActorSystem("bank", store=store, standby="warm", log=False) as system:
        spec = hf.child("account", hf.start(Account), recovery=hf.hybrid(), isolation=isolation)
        account = await system.start(spec)

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            answer: Any
            with contextlib.suppress(OSError, hf.HoldfastError):
                while line := await reader.readline():
                    request = json.loads(line)
                    if "id" in request:
                        answer = await account.ask(Deposit(request["id"], request["amount"]), timeout=60.0)
                    else:
                        answer = await system.ref(account.path, Account).ask(Report(), timeout=60.0)
                    writer.write(json.dumps({"pid": os.getpid(), "answer": answer}).encode() + b"\n")
                    await writer.drain()
            writer.close()

        own = f"{socket}.{os.getpid()}"
        async with await asyncio.start_unix_server(serve, own):
            os.replace(own, socket)  # From here on clients come to this leader.
            print("leads", flush=True)
            await asyncio.Event().wait()


def program() -> None:
    """Stand by and lead, until a signal ends it."""
    with contextlib.suppress(FileNotFoundError):
        hf.run(main, again=True)
    Path(sys.argv[2]).with_suffix(".ended").touch()


if __name__ == "__main__":
    from tests.cluster import bank  # Here the messages would have other names than for those who send them.

    bank.program()
