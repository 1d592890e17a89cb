"""A root process with a SQLite store, run by `test_restart_root.py`: python root_player.py STORE FIRST LAST.

It tells two recorded actors numbers, says on stdout which ones were accepted, and is killed in the middle of it. With
FIRST > LAST it only says what they have.
"""

from __future__ import annotations

import asyncio
import json
import sys

import holdfast as hf


class Put(hf.Message):
    n: int
    to: hf.ActorRef[hf.Actor] | None = None


class All(hf.Message[list[int]]): ...


class Ledger(hf.Actor):
    """Keeps each number, and passes it on if it is told to whom."""

    def __init__(self) -> None:
        self.numbers: list[int] = []

    @hf.on(Put)
    def put(self, message: Put) -> None:
        self.numbers.append(message.n)
        if message.to is not None:
            message.to.tell(Put(message.n))

    @hf.on(All, readonly=True)
    def read(self, message: All) -> list[int]:
        return self.numbers


async def main(store: str, first: int, last: int) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=100) as system:
        recovery = hf.hybrid(interval=0.03)
        second = await system.start(hf.child("second", hf.start(Ledger), recovery=recovery))
        ledger = await system.start(hf.child("first", hf.start(Ledger), isolation="process", recovery=recovery))
        for n in range(first, last + 1):
            await ledger.send(Put(n, second))
            sys.stdout.write(f"{n}\n")  # It is accepted: from here on it must not get lost.
            sys.stdout.flush()
            if n % 5 == 0:
                await asyncio.sleep(0)
        await ledger.ask(All(), timeout=30.0)
        have = [await one.ask(All(), timeout=30.0) for one in (ledger, second)]
        sys.stdout.write(json.dumps(have) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    hf.run(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
