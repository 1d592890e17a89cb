"""A root whose actors have just got other mechanisms: it waits until it is killed, or its input ends."""

from __future__ import annotations

import asyncio
import sys

import holdfast as hf
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Add, Counter

SPECS = (
    hf.child("alice", hf.start(Counter), recovery=hf.hybrid(interval=0.05)),
    hf.child("bob", hf.start(Counter), recovery=hf.hybrid(interval=0.05), mechanism=PBR()),
)


async def main(store: str) -> None:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        alice, bob = [await system.start(one) for one in SPECS]
        async with system.transaction(timeout=60) as change:
            change.protect(alice, PBR())
            change.protect(bob, LFR())
        await alice.ask(Add(0))
        print("changed", flush=True)
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
