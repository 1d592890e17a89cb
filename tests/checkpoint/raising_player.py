"""A root with a SQLite store for `test_restart_root.py`: python raising_player.py STORE LIFE HOW.

LIFE "first": each actor has a message in hand and another one waits, and the process ends by SIGKILL. LIFE "second":
the handlers raise when they are run again (HOW "raises"), or kill their own process, once (HOW "kills", which is for
actors in other processes alone); what became of each actor is printed.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from pathlib import Path

import holdfast as hf

PLACES = {
    "raises": ("/app/task", "/app/process", "/app/here/below", "/app/there/below"),
    "kills": ("/app/process", "/app/there/below"),
}


class Hand(hf.Message):
    marker: str
    how: str


class Ping(hf.Message): ...


class Seen(hf.Message[int]): ...


class Raises(hf.Actor):
    """Holds what it is handed as long as its program lives; raises if that is over, or kills its process once."""

    def __init__(self) -> None:
        self.pings = 0

    @hf.on(Hand)
    async def hold(self, message: Hand) -> None:
        marker, killed = Path(message.marker), Path(f"{message.marker}.killed")
        if not marker.exists():
            marker.touch()
            await asyncio.Event().wait()
        if message.how == "raises":
            raise ValueError("not again")
        if not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    @hf.on(Ping)
    def ping(self, message: Ping) -> None:
        self.pings += 1

    @hf.on(Seen, readonly=True)
    def seen(self, message: Seen) -> int:
        return self.pings


async def main(store: str, life: str, how: str) -> None:
    places = PLACES[how]
    below = hf.child("below", hf.start(Raises), recovery=hf.hybrid())
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=len(places)) as system:
        with system.events() as events:
            await system.start(hf.child("task", hf.start(Raises), recovery=hf.hybrid()))
            await system.start(hf.child("process", hf.start(Raises), recovery=hf.hybrid(), isolation="process"))
            await system.start(hf.supervisor("here", children=[below]))
            await system.start(hf.supervisor("there", children=[below], isolation="process"))
            refs = [system.ref(path, Raises) for path in places]
            if life == "first":
                markers = [Path(f"{store}.{number}") for number in range(len(refs))]
                for ref, marker in zip(refs, markers, strict=True):
                    await ref.send(Hand(str(marker), how))
                    await ref.send(Ping())
                while not all(marker.exists() for marker in markers):
                    await asyncio.sleep(0)
                await system._homes.settled()
                os.kill(os.getpid(), signal.SIGKILL)
            pings = [await ref.ask(Seen(), timeout=50.0) for ref in refs]
            told = events.take()
        crashes = sorted(event.address for event in told if isinstance(event, hf.events.ActorCrashed))
        restarted = sorted(event.address for event in told if isinstance(event, hf.events.ChildRestarted))
        print(json.dumps([pings, crashes, restarted]))


if __name__ == "__main__":
    hf.run(main(*sys.argv[1:]))
