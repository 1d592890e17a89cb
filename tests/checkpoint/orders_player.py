"""A program whose recorded actor gives orders to actors without recovery in a turn: STORE ORDER PLACE RUN.

The first run kills itself while the order is obeyed; the next one prints what the turn has heard.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import Any

import holdfast as hf

FIRST = "first"


class Give(hf.Message): ...


class Heard(hf.Message[list[str]]): ...


class Killed(hf.Actor):
    """Kills the whole program where it is told to, in the first run."""

    def __init__(self, kills: int = 0) -> None:
        self._kills = kills

    def on_start(self, restored: bool) -> None:
        if self._kills == 1:
            os.kill(root(), signal.SIGKILL)

    async def on_stop(self, reason: hf.ExitReason) -> None:
        if self._kills == 2:
            os.kill(root(), signal.SIGKILL)


class Giver(hf.Actor):
    def __init__(self, order: str) -> None:
        self._order = order
        self.heard: list[str] = []

    @hf.on(Give)
    async def give(self, message: Give) -> None:
        for path, order in ORDERS[self._order]:
            try:
                heard: Any = await self.ctx.find(path, hf.Actor).ask(order, timeout=60.0)
            except hf.AskTimeout as error:
                self.heard.append(f"AskTimeout {error.handled}")
            except hf.Refusal as error:
                self.heard.append(type(error).__name__)
            else:
                self.heard.append(heard.path if isinstance(heard, hf.ActorRef) else type(heard).__name__)

    @hf.on(Heard, readonly=True)
    def read(self, message: Heard) -> list[str]:
        return self.heard


class Witness(hf.Actor):
    """An actor of the user's own, which keeps no journal."""

    @hf.on(Give)
    def give(self, message: Give) -> None:
        os.kill(root(), signal.SIGKILL)


TEMPLATE, LIST, WITNESS = "/app/house/dynamic", "/app/house", "/app/witness"
ORDERS: dict[str, list[tuple[str, hf.Message[Any]]]] = {
    "by id": [(TEMPLATE, hf.StartChild(id="one"))],
    "without id": [(TEMPLATE, hf.StartChild())],
    "fresh": [(TEMPLATE, hf.StartChild(id="one", fresh=True))],
    "end": [(LIST, hf.TerminateChild("ends"))],
    "erase": [(LIST, hf.TerminateChild("ends")), (LIST, hf.DeleteChild("ends"))],
    "restart": [(LIST, hf.RestartChild("ends", running=True))],
    "of the user": [(WITNESS, Give())],
}


def root() -> int:
    """The process of the program, also seen from one of its actors."""
    return int(os.environ["ROOT"])


async def main(store: str, order: str, place: Any, run: str) -> None:
    os.environ.setdefault("ROOT", str(os.getpid()))
    kills = run == FIRST
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        children = [
            hf.dynamic("dynamic", template=hf.child(None, hf.start(Killed, int(kills)))),
            hf.child("ends", hf.start(Killed, 2 * kills)),
        ]
        await system.start(hf.supervisor("house", children=children, isolation=place, intensity=100))
        await system.start(hf.child("witness", hf.start(Witness)))
        giver = await system.start(hf.child("giver", hf.start(Giver, order), recovery=hf.hybrid()))
        if kills:
            await giver.ask(Give(), timeout=60.0)
        print(" ".join(await giver.ask(Heard(), timeout=60.0)))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
