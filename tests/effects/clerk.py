"""An actor that has effects on an outside world, which writes down what was done to it: a file, one line for each."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from pathlib import Path
from typing import Any

import holdfast as hf

IN_TIME = 20.0


class Do(hf.Message[str]):
    """Have effects `world.<name>` for each word, one after another; `file` is the world, and the reply what they said.

    A word may have a way to go wrong behind a colon: see `deed`.
    """

    file: str
    words: list[str]
    dies_after: int = -1  # the process is killed behind this effect, in its first life


class Done(hf.Message[list[str]]): ...


class No(hf.Refusal):
    why: str


def lines(file: str | Path) -> list[str]:
    """What was done to a world: a word and the key that came with it, for each time."""
    path = Path(file)
    return path.read_text().splitlines() if path.exists() else []


def words(file: str | Path) -> list[str]:
    """What was done, without keys."""
    return [line.split()[0] for line in lines(file)]


def note(file: str, line: str) -> int:
    """Do something to the world, once more; returns how often that was done."""
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(descriptor, f"{line}\n".encode())
    os.close(descriptor)
    return lines(file).count(line)


async def deed(file: str, word: str, key: str) -> str:
    """An effect: `a`; `a:die` kills its process the first time, `a:raise2` raises two times, `a:no` refuses."""
    name, _, how = word.partition(":")
    times = note(file, f"{name} {key}")
    await asyncio.sleep(0)
    if how == "die" and times == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if how.startswith("raise") and times <= int(how.removeprefix("raise")):
        raise ConnectionError(f"no line to {name}")
    if how == "no":
        raise No(name)
    if how == "slow" and times == 1:
        await asyncio.sleep(3600.0)
    if how == "unsavable":
        return object()  # type: ignore[return-value]  # that is the point
    return f"{name}!"


def deed_in_thread(file: str, word: str, key: str) -> str:
    """The same in a thread."""
    time.sleep(0.001)
    return asyncio.run(deed(file, word, key))


class Clerk(hf.Actor):
    def __init__(self) -> None:
        self.done: list[str] = []

    @hf.on(Do)
    async def do(self, message: Do) -> str:
        said: list[str] = []
        for index, word in enumerate(message.words):
            said.append(await self.attempted(message.file, word))
            if index == message.dies_after and self.ctx.life == 1:
                os.kill(os.getpid(), signal.SIGKILL)
        self.done.append(" ".join(said))
        return self.done[-1]

    async def attempted(self, file: str, word: str) -> str:
        try:
            return await self.effect(file, word)
        except (No, hf.errors.EffectFailed, hf.errors.EffectInDoubt, hf.errors.UnsavableValue) as error:
            return f"({error})"

    def effect(self, file: str, word: str) -> asyncio.Future[str]:
        key, options = self.ctx.message_id, dict[str, Any]()
        name, _, how = word.partition(":")
        if name.startswith("once"):
            options["at_most_once"] = True
        elif how.startswith("raise"):
            options["retry"] = hf.Retry(attempts=3, backoff=hf.Backoff(initial=0.001), on=(ConnectionError,))
        elif how == "slow":
            options |= {"timeout": 0.05, "retry": hf.Retry(attempts=2, backoff=hf.Backoff(initial=0.001))}
        if name.startswith("t"):
            return self.ctx.effect(deed_in_thread, file, word, key, **options)
        return self.ctx.effect(deed, file, word, key, **options)

    @hf.on(Done)
    def read(self, message: Done) -> list[str]:
        return self.done


def clerk(isolation: Any = "process", **options: Any) -> hf.ChildSpec[Clerk]:
    method = options.pop("recovery", hf.hybrid(interval=1000.0))
    return hf.child("clerk", hf.start(Clerk), isolation=isolation, recovery=method, **options)
