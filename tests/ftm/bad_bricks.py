"""Mechanisms whose bricks do wrong: how, when and in which role is a setting."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import time
from typing import Any, ClassVar

import holdfast as hf
from holdfast.ftm.bricks.brick_messages import Done, Work
from holdfast.ftm.bricks.bricks import After, Before, Proceed
from holdfast.ftm.bricks.standing import PeerLost
from holdfast.ftm.model.mechanism import Mechanism, Role

HOWS = ("hang", "raise", "exit", "allocate", "block", "garbage", "swallow")
WHENS = ("init", "start", "message", "peer")
PARTS = ("before", "after", "proceed")


class Hello(hf.Message[int]):
    """To the same brick of the other replica."""


def does(how: str) -> None:
    """Do wrong at once."""
    match how:
        case "raise":
            raise ValueError("a brick has raised this")
        case "exit":
            os._exit(9)
        case "allocate":
            bytearray(1 << 60)
        case "block":
            time.sleep(3600.0)


class Bad:
    """What the bricks have in common."""

    part: ClassVar[str]
    mechanism: Any
    _standing: Any

    def _is_meant(self, when: str) -> bool:
        bad = self.mechanism
        assert isinstance(bad, Wrong)
        role = "leader" if self._standing.leads else "other"
        is_real = self._standing.epoch >= 0  # Else it is only tried.
        return bad.when == when and bad.part == self.part and bad.whose in (role, "any") and (is_real or not bad.late)

    async def strike(self, when: str) -> bool:
        """Do wrong, if this is the moment; whether what is returned is to be garbage, or nothing."""
        if not self._is_meant(when):
            return False
        if self.mechanism.how == "hang":
            await asyncio.sleep(3600.0)
        does(self.mechanism.how)
        return True

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        if self._is_meant("init"):
            does("block" if self.mechanism.how == "hang" else self.mechanism.how)

    async def on_start(self, restored: bool) -> None:
        await self.strike("start")

    async def from_peer(self, message: hf.Message[Any]) -> int:
        await self.strike("peer")
        return 1

    def instead(self, value: Any) -> Any:
        """In place of what is right."""
        return 42 if self.mechanism.how == "garbage" else None


class BadBefore(Bad, Before):
    part = "before"
    peer_messages = (Hello,)

    async def before(self, work: Work) -> Work | None:
        if self.mechanism.late and not work.requests:
            return work
        if await self.strike("message"):
            return self.instead(work)
        if work.requests and self.has_peer and self.mechanism.when == "peer":
            with contextlib.suppress(PeerLost):
                await self.ask_peer(Hello())
        return work


class BadAfter(Bad, After):
    part = "after"

    async def after(self, done: Done) -> Done | None:
        if self.mechanism.late and not done.ends:
            return done
        if await self.strike("message"):
            return self.instead(done)
        return done


class BadProceed(Bad, Proceed):
    part = "proceed"

    async def _batch(self, work: Work) -> None:
        if (work.requests or not self.mechanism.late) and await self.strike("message"):
            return
        await super()._batch(work)


@dataclasses.dataclass(frozen=True)
class Wrong(Mechanism):
    """Does wrong in a Before or an After."""

    name: ClassVar[str] = "wrong"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {
        "leader": Role(before=BadBefore, after=BadAfter),
        "other": Role(before=BadBefore, after=BadAfter),
    }

    how: str = "raise"
    when: str = "message"
    part: str = "after"
    whose: str = "any"
    late: bool = True
    """Not when it is only tried."""


@dataclasses.dataclass(frozen=True)
class WrongProceed(Wrong):
    """Does wrong in a Proceed."""

    roles: ClassVar[dict[str, Role]] = {"leader": Role(proceed=BadProceed), "other": Role(proceed=BadProceed)}
    part: str = "proceed"
