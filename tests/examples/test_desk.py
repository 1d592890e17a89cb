"""The desk of docs/how-to/start-actors-on-demand.md, in a program that is killed at each step of its work."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("warm_programs")

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "start-actors-on-demand.md"
STRIKE = "(os.kill(os.getpid(), 9) if sys.argv[2] == 'first' else None)"
STEPS = {
    "the desk has a bid": ("        self.ctx.forward(await", f"        {STRIKE}\n        self.ctx.forward(await"),
    "the auction starts": ("        if not restored:", f"        {STRIKE}\n        if not restored:"),
    "the auction is there": (
        "        except hf.errors.AlreadyStarted as running:\n            return running.ref\n",
        f"        except hf.errors.AlreadyStarted as running:\n            return running.ref\n        {STRIKE}\n",
    ),
    "the auction has a bid": ("        self.bids += 1\n", f"        self.bids += 1\n        {STRIKE}\n"),
    "the auction is idle": (
        "        auction = await self.auction(message",
        f"        {STRIKE}\n        auction = await self.auction(message",
    ),
    "the auction says that it may leave": (
        "        return self.is_idle\n",
        f"        {STRIKE}\n        return self.is_idle\n",
    ),
    "the auction leaves": (
        "    @hf.on(MayLeave)\n",
        f"    def on_stop(self, reason: hf.ExitReason) -> None:\n        {STRIKE}\n\n    @hf.on(MayLeave)\n",
    ),
    "the auction has left": (
        "hf.TerminateChild(message.auction))\n",
        f"hf.TerminateChild(message.auction))\n                {STRIKE}\n",
    ),
}
HOUSE = """
import os, sys

async def house(store: str, run: str) -> None:
    async with hf.ActorSystem("house", store=store, log=False, intensity=2) as system:
        auction = hf.child(None, hf.start(Auction), recovery=hf.hybrid(), bindings={"desk": "/house/desk"})
        await system.start(hf.dynamic("auctions", template=auction, journal=True))
        desk = await system.start(
            hf.child("desk", hf.start(Desk), recovery=hf.hybrid(), bindings={"auctions": "/house/auctions"})
        )
        with system.events() as events:
            if run == "first":
                await desk.send(Bid("vase", 500))
                print("accepted", flush=True)
                await asyncio.sleep(60.0)
            bids = await desk.ask(Bid("vase", 600), timeout=60.0)
            seen = events.take()
            while not any(isinstance(event, hf.events.ChildStopped) for event in seen):
                await asyncio.sleep(0.01)
                seen += events.take()
            print(bids, await desk.ask(Bid("vase", 700), timeout=60.0))
            assert not any(isinstance(event, hf.events.ActorCrashed) for event in [*seen, *events.take()])

asyncio.run(house(*sys.argv[1:]))
"""


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.some(4)
def test_no_bid_is_lost_or_doubled_by_a_kill_of_the_program(tmp_path: Path, step: str) -> None:
    block = re.search(r"```python\n(.*?)async def house", PAGE.read_text(), re.DOTALL)
    assert block is not None
    before, after = STEPS[step]
    assert block[1].count(before) == 1
    program = tmp_path / "house.py"
    program.write_text(block[1].replace(before, after) + HOUSE)
    command = [sys.executable, str(program), f"sqlite:{tmp_path / 'house.db'}"]
    first = subprocess.run([*command, "first"], capture_output=True, text=True)
    assert first.returncode == -9, first.stderr
    following = subprocess.run([*command, "next"], capture_output=True, text=True)
    before_it = int(following.stdout.split()[0]) - 1 if following.stdout else -1
    assert before_it == 1 or (before_it == 0 and not first.stdout), following.stderr
    assert following.stdout == f"{before_it + 1} {before_it + 2}\n", following.stderr
