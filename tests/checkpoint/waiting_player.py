"""A root with a SQLite store for `test_restart_asks.py`: python waiting_player.py STORE ORDER LIFE.

LIFE "first": an asker's turn waits for room in a full mailbox, and the process ends by SIGKILL. LIFE "second": the
tree is started again, and what became of the ask is printed.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path

import holdfast as hf


class Work(hf.Message[int]): ...


class Go(hf.Message):
    marker: str


class Outcome(hf.Message[str]): ...


class Busy(hf.Actor):
    @hf.on(Work)
    async def work(self, message: Work) -> int:
        await asyncio.Event().wait()
        return 0


class Asker(hf.Actor):
    def __init__(self) -> None:
        self.outcome = ""

    @hf.on(Go)
    async def go(self, message: Go) -> None:
        Path(message.marker).touch()
        try:
            self.outcome = str(await self.ctx.find("/app/busy", Busy).ask(Work(), timeout=2.0))
        except hf.AskTimeout as late:
            self.outcome = f"late, handled: {late.handled}"

    @hf.on(Outcome, readonly=True)
    def read(self, message: Outcome) -> str:
        return self.outcome


async def main(store: str, order: str, life: str) -> None:
    marker = Path(f"{store}.asked")
    specs = {
        "busy": hf.child("busy", hf.start(Busy), recovery=hf.hybrid(), mailbox=hf.bounded(1), shutdown="brutal_kill"),
        "asker": hf.child("asker", hf.start(Asker), recovery=hf.hybrid()),
    }
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        for name in order.split(","):
            await system.start(specs[name])
        busy, asker = system.ref("/app/busy", Busy), system.ref("/app/asker", Asker)
        if life == "first":
            for _ in range(2):  # One in hand, one that waits.
                await busy.send(Work())
            asker.tell(Go(str(marker)))
            while not marker.exists():
                await asyncio.sleep(0)
            await system._homes.settled()
            os.kill(os.getpid(), signal.SIGKILL)
        print(await asker.ask(Outcome(), timeout=50.0))


if __name__ == "__main__":
    hf.run(main(*sys.argv[1:]))
