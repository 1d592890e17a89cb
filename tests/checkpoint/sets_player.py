"""A root that sends sets of texts in all ways, run by `test_sets.py`: python sets_player.py STORE ISOLATION END."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from typing import Any, NamedTuple

import holdfast as hf
from tests.checkpoint.players import start

WORDS = frozenset({"Adam", "Berta", "Caesar", "Dora", "Emil", "Frieda", "Gustav", "Heinrich"})


class Pair(NamedTuple):
    left: frozenset[str]
    right: dict[str, set[str]]


class Said(hf.Message[set[str]]):
    words: set[str]
    pairs: list[Pair]


class Say(hf.Message[Pair | None]):
    to: hf.ActorRef[Listener]


class Later(hf.Message[frozenset[str]]): ...


class No(hf.Refusal):
    words: set[str]


class Refuse(hf.Message): ...


class Heard(hf.Message[list[int]]): ...


class Listener(hf.Actor):
    """Counts what it hears of."""

    def __init__(self) -> None:
        self.heard: list[int] = []

    def on_start(self, restored: bool) -> None:
        if not isinstance(self, Speaker):
            self.ctx.subscribe("/words")

    @hf.on(Said)
    def listen(self, message: Said) -> set[str]:
        assert isinstance(message.words, set)
        self.heard.append(len(message.words))
        return message.words

    @hf.on(Heard, readonly=True)
    def read(self, message: Heard) -> list[int]:
        return self.heard


class Speaker(Listener):
    """Says the same in all ways."""

    def __init__(self) -> None:
        super().__init__()
        self.later: Any = None

    @hf.on(Say)
    async def say(self, message: Say) -> Pair:
        pair = Pair(WORDS, {"z": set(WORDS), "a": set(WORDS)})
        said = Said(set(WORDS), [pair])
        message.to.tell(said)
        await message.to.send(said)
        assert await message.to.ask(said) == WORDS
        await self.ctx.publish("/words", said)
        self.ctx.tell_after(3600.0, said)
        if self.later is not None:
            self.later.reply(WORDS)
        return pair

    @hf.on(Later)
    def promise(self, message: Later) -> hf.ReplyHandle[frozenset[str]]:
        self.later = self.ctx.reply_handle()
        return self.later

    @hf.on(Refuse)
    def refuse(self, message: Refuse) -> None:
        raise No(set(WORDS))


async def main(store: str, isolation: str, end: str) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        recovery = hf.hybrid(interval=1e6)
        listener = await system.start(hf.child("listener", hf.start(Listener), recovery=recovery))
        speaker = await start(system, isolation, "speaker", hf.start(Speaker), recovery=recovery)
        if end == "killed":
            later = speaker.ask(Later(), timeout=60.0)
            pair = await speaker.ask(Say(listener), timeout=60.0)
            assert pair is not None
            assert list(pair.right) == ["z", "a"], "the order of a dict has been lost"
            assert await later == WORDS
            with contextlib.suppress(No):
                await speaker.ask(Refuse(), timeout=60.0)
            os.kill(os.getpid(), signal.SIGKILL)
        answers = [await one.ask(Heard(), timeout=60.0) for one in (speaker, listener)]
        sys.stdout.write(json.dumps(answers) + "\n")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
