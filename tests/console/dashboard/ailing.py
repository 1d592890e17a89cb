"""Actors that can be made ill, for the page to show: each by one message."""

from __future__ import annotations

import asyncio
import os
import signal

import holdfast as hf

EVIL_NAME = "<img src=x onerror=window.evil=1>"
EVIL_TEXT = "</p><script>window.evil=2</script><b>x"


class Work(hf.Message[int]):
    what: str = ""


class Worker(hf.Actor):
    """Counts what it is asked for; or hangs, raises, or ends its process."""

    bank: hf.Binding[hf.Actor]

    def __init__(self) -> None:
        self.done = 0
        self.note = EVIL_TEXT

    @hf.on(Work)
    async def work(self, message: Work) -> int:
        match message.what:
            case "hang":
                await asyncio.Event().wait()
            case "raise":
                raise RuntimeError(EVIL_TEXT)
            case "die":
                os.kill(os.getpid(), signal.SIGKILL)
            case "print":
                print(f"{EVIL_TEXT} \x1b[31m", flush=True)
            case "wait":
                return await self.bank.ask(Work("hang"), timeout=600.0)
            case _:
                self.done += 1
        return self.done


class Leaf(hf.Actor): ...
