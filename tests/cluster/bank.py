"""A program that stands by, leads, and does what its clients ask for over a Unix socket, one JSON line a request.

    python -m tests.cluster.bank STORE SOCKET [task | process]

Whoever leads listens on the socket, and on one of its own, SOCKET.PID, where it can be asked after it was deposed, too.
Each answer says who gives it, and in which epoch. The requests:

{"id": 7, "amount": 3}              deposit, which counts once; the balance is the answer
{}                                  balance and number of the deposits
{"add": 7, "to": "a", "amount": 3, "size": 9}  add 3 to what "a" has, each time; what it has then is the answer. The
                                    message is so many bytes larger, and the account keeps the last few of them
{"of": "a"}                         what "a" has
{"books": true}                     the adds that were done, in order, and those that the audit was told of
{"worker": true}                    the process of the account
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import sys
from pathlib import Path
from typing import Any, Literal

import holdfast as hf

KEPT = 4
"""How many notes the account keeps: with large ones its snapshots are large, too."""


class Deposit(hf.Message[int]):
    id: int
    amount: int


class Gain(hf.Message[int]):
    amount: int


class Report(hf.Message[dict[str, int]]): ...


class Add(hf.Message[int]):
    id: int
    to: str
    amount: int
    note: bytes


class Look(hf.Message[int]):
    of: str


class Added(hf.Message):
    id: int


class Books(hf.Message[list[int]]): ...


class Audit(hf.Actor):
    """Is told of each add by the account."""

    def __init__(self) -> None:
        self.ids: list[int] = []

    @hf.on(Added)
    def added(self, message: Added) -> None:
        self.ids.append(message.id)

    @hf.on(Books, readonly=True)
    def books(self, message: Books) -> list[int]:
        return self.ids


class Account(hf.Actor):
    """Adds up what it is given; a deposit of the same id counts once, an add each time."""

    audit: hf.Binding[Audit]

    def __init__(self) -> None:
        self.balance = 0
        self.done: dict[int, int] = {}
        self.sums: dict[str, int] = {}
        self.ids: list[int] = []
        self.notes: list[bytes] = []

    @hf.on(Deposit)
    def deposit(self, message: Deposit) -> int:
        known = self.done.get(message.id)
        if known is None:
            self.balance += message.amount
            known = self.done[message.id] = self.balance
        return known

    @hf.on(Gain)
    def gain(self, message: Gain) -> int:
        """As a deposit, but each one counts, also one that is the same again."""
        self.balance += message.amount
        return self.balance

    @hf.on(Report)
    def report(self, message: Report) -> dict[str, int]:
        return {"balance": self.balance, "count": len(self.done)}

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.sums[message.to] = self.sums.get(message.to, 0) + message.amount
        self.ids.append(message.id)
        if message.note:
            self.notes = [*self.notes, message.note][-KEPT:]
        self.audit.tell(Added(message.id))
        return self.sums[message.to]

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> int:
        return self.sums.get(message.of, 0)

    @hf.on(Books, readonly=True)
    def books(self, message: Books) -> list[int]:
        return self.ids


async def answer(system: hf.ActorSystem, request: dict[str, Any]) -> Any:
    """Do what a client has asked for."""
    account, audit = system.ref("/bank/account", Account), system.ref("/bank/audit", Audit)
    match request:
        case {"id": id, "amount": amount}:
            return await account.ask(Deposit(id, amount), timeout=60.0)
        case {"add": id, "to": to, "amount": amount, "size": size}:
            return await account.ask(Add(id, to, amount, random.Random(id).randbytes(size)), timeout=60.0)
        case {"of": of}:
            return await account.ask(Look(of), timeout=60.0)
        case {"books": True}:
            return [await account.ask(Books(), timeout=60.0), await audit.ask(Books(), timeout=60.0)]
        case {"worker": True}:
            return system.pid_of(account)
        case _:
            return await account.ask(Report(), timeout=60.0)


async def epoch_of(system: hf.ActorSystem) -> int:
    """In which epoch the system leads; waits until it does."""
    with system.events() as events:
        return (await events.until(hf.events.LeadershipTaken, timeout=86400.0)).epoch


async def main() -> None:
    """Stand by, lead, and serve until another leads."""
    store, socket = sys.argv[1:3]
    isolation: Literal["task", "process"] = "process" if sys.argv[3:] == ["process"] else "task"
    system = hf.ActorSystem("bank", store=store, standby="warm", log=False)
    leading = asyncio.ensure_future(epoch_of(system))  # It begins while the system opens its store.
    try:
        async with system:
            recovery = hf.hybrid(interval=0.5)
            await system.start(hf.child("audit", hf.start(Audit), recovery=recovery))
            bindings = {"audit": "/bank/audit"}
            spec = hf.child("account", hf.start(Account), recovery=recovery, isolation=isolation, bindings=bindings)
            await system.start(spec)
            told = {"pid": os.getpid(), "epoch": await leading}

            async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
                with contextlib.suppress(OSError, hf.HoldfastError):
                    while line := await reader.readline():
                        found = await answer(system, json.loads(line))
                        writer.write(json.dumps({**told, "answer": found}).encode() + b"\n")
                        await writer.drain()
                writer.close()

            own, new = f"{socket}.{os.getpid()}", f"{socket}.{os.getpid()}.new"
            async with await asyncio.start_unix_server(serve, own):
                Path(new).unlink(missing_ok=True)
                os.link(own, new)
                os.replace(new, socket)  # From here on clients come to this leader.
                print("leads", flush=True)
                await asyncio.Event().wait()
    finally:
        leading.cancel()


def program() -> None:
    """Stand by and lead, until a signal ends it."""
    with contextlib.suppress(FileNotFoundError):
        hf.run(main, again=True)
    Path(sys.argv[2]).with_suffix(".ended").touch()


if __name__ == "__main__":
    from tests.cluster import bank  # Here the messages would have other names than for those who send them.

    bank.program()
