"""A root with a SQLite store for `test_dynamic.py`: python made_up_player.py STORE LIFE PLACE.

LIFE "first": a child with a made-up id has a message in hand; a tell, and the ask of a recorded actor, wait there; the
process ends by SIGKILL. LIFE "second": what became of them is printed.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import holdfast as hf
from holdfast.actors.events import DeadLetter


class Hold(hf.Message):
    marker: str


class Ping(hf.Message[int]): ...


class AskIt(hf.Message):
    path: str


class Outcome(hf.Message[str]): ...


class Busy(hf.Actor):
    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        Path(message.marker).touch()
        await asyncio.Event().wait()

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return 0


class Asks(hf.Actor):
    def __init__(self) -> None:
        self.outcome = ""

    @hf.on(AskIt)
    async def ask_it(self, message: AskIt) -> None:
        try:
            await self.ctx.find(message.path, Busy).ask(Ping(), timeout=500.0)
        except hf.HoldfastError as error:
            self.outcome = type(error).__name__

    @hf.on(Outcome, readonly=True)
    def read(self, message: Outcome) -> str:
        return self.outcome


async def main(store: str, life: str, place: Any) -> None:
    many = hf.dynamic("many", template=hf.child(None, hf.start(Busy), recovery=hf.hybrid()), isolation=place)
    asks = hf.child("asks", hf.start(Asks), recovery=hf.hybrid())
    marker = Path(f"{store}.held")
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        with system.events() as events:
            top = await system.start(many)
            asker = await system.start(asks)
            if life == "first":
                busy = await top.ask(hf.StartChild())
                await busy.send(Hold(str(marker)))
                await busy.send(Ping())
                await asker.send(AskIt(busy.path))
                while not marker.exists() or not (await system.get_status(busy)).queued >= 2:
                    await asyncio.sleep(0)
                await system._homes.settled()
                os.kill(os.getpid(), signal.SIGKILL)
            outcome = await asker.ask(Outcome(), timeout=60.0)
            told = [
                str(getattr(event.message, "name", "")).rpartition(":")[2]
                for event in events.take()
                if isinstance(event, DeadLetter)
            ]
        print(json.dumps([outcome, sorted(told), system._homes.known("/app/many")]))


if __name__ == "__main__":
    hf.run(main(*sys.argv[1:]))
