"""A program for `test_standstill.py`, whose loop stands still: python standstill_player.py turn|call|stop|slow|well.

It says "busy" when its actor is, or "up" when it will be as soon as it is to stop.
"""

from __future__ import annotations

import asyncio
import sys
import time

import holdfast as hf

STANDSTILL, LENIENT = 0.4, 2.0
"""Seconds that the loop may stand still: where it does, and where it does not, on a machine that is busy."""


class Begin(hf.Message):
    """Never end."""


def never_end() -> None:
    while True:
        pass


class Busy(hf.Actor):
    @hf.on(Begin)
    def begin(self, message: Begin) -> None:
        print("busy", flush=True)
        if sys.argv[1] == "call":
            time.sleep(10_000.0)
        never_end()

    async def on_stop(self, reason: hf.ExitReason) -> None:
        if sys.argv[1] == "stop":
            never_end()
        elif sys.argv[1] == "slow":
            await asyncio.sleep(1.5 * LENIENT)


async def main() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        busy = await system.start(hf.child("busy", hf.start(Busy)))
        if sys.argv[1] in ("turn", "call"):
            busy.tell(Begin())
        else:
            print("up", flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    hf.run(main, standstill=LENIENT if sys.argv[1] in ("slow", "well") else STANDSTILL)
