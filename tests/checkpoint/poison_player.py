"""A root that one message kills, for `test_poison.py`: python poison_player.py STORE SYNC|ASYNC FIRST|AGAIN."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys

import holdfast as hf

DELIVERIES = 3


class Work(hf.Message[int]):
    kills: bool = False
    waits: bool = False


class Get(hf.Message[int]): ...


class Worker(hf.Actor):
    """Counts; one message kills the process that it lives in."""

    def __init__(self) -> None:
        self.done = 0

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> int:
        return self.done

    @hf.on(Work)
    def work(self, message: Work) -> int:
        if message.kills:
            os.kill(os.getpid(), signal.SIGKILL)
        self.done += 1
        return self.done


class Patient(Worker):
    """The same, in turns that wait."""

    @hf.on(Work)
    async def work(self, message: Work) -> int:  # type: ignore[override]
        if message.kills:
            await asyncio.sleep(0)
            os.kill(os.getpid(), signal.SIGKILL)
        self.done += 1
        return self.done


async def main(store: str, kind: type[Worker], first: bool) -> None:
    told: list[hf.events.Event] = []
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        system._node.events.add_sink(told.append)
        recovery = hf.hybrid(interval=1000.0, max_deliveries=DELIVERIES)
        sick, well = [
            await system.start(hf.child(name, hf.start(kind), recovery=recovery)) for name in ("sick", "well")
        ]
        if first:
            assert await sick.ask(Work(), timeout=60.0) == 1
            await asyncio.gather(sick.send(Work(kills=True)), sick.send(Work()), well.send(Work()))
        have = [await one.ask(Get(), timeout=60.0) for one in (sick, well)]
        held = [(one.address, one.attempts) for one in system.quarantined()]
        events = sum(isinstance(event, hf.events.MessageQuarantined) for event in told)
        sys.stdout.write(json.dumps([have, held, events]))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], Patient if sys.argv[2] == "ASYNC" else Worker, sys.argv[3] == "FIRST"))
