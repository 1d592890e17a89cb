"""The current life as its home sees it: how far it has come, and whether its words still count."""

from __future__ import annotations

import asyncio
import dataclasses
import time
from typing import TYPE_CHECKING, Protocol

from ...actors.exit_reasons import Crash

if TYPE_CHECKING:
    from ...actors.errors import ReplayDiverged
    from ...actors.exit_reasons import ExitReason
    from ..inputs import Input
    from ..protocol import ToLife


class LifePort(Protocol):
    """The way to the present life."""

    @property
    def begins(self) -> bool:
        """Whether what is handed to it may be begun at any time from then on. If not, it says itself when."""
        ...

    @property
    def is_far(self) -> bool:
        """Whether that life is in another process."""
        ...

    def take(self, source: Input) -> None:
        """Hand a new input to the life, as what it has to know of it; it is handled in order."""
        ...

    def to_life(self, record: ToLife) -> None:
        """Hand a record to the life; it is handled in order."""
        ...


@dataclasses.dataclass(slots=True)
class PresentLife:
    """What a home knows of the life that it has, or waits for.

    Attributes:
        port: the way to it; None between two lives.
        live: ends when it has caught up, with the seconds its restore took.
        live_at: when it had, on the machine's clock.
        has_come_up: whether the last one that was started has.
        settled: ends when the turn that had begun before is as far as it was, or waits; None if nobody follows a start.
        owed: how many outputs that turn had let out.
        told: how many outcomes the life was told.
        heard: how many of them it has said that it has heard, while it comes as far as an earlier one.
        is_as_far: whether the turn that an earlier life had begun has come as far as it was.
        is_released: whether it gets what is new.
        waits_for_release: whether somebody else says when it gets that.
        is_kept_back: whether it waits for the others of its group.
        replayed: how many turns it is to handle again.
        diverged: why its replay has led elsewhere: nothing that it says counts.
        is_void: whether its state is not the one that its home has for it, which has come from outside: nothing that it
            says counts.
        seen_turn: the last turn that it has handled again.
        seen_k: how many outputs of that turn have come again.
        has_ended: whether the last one has ended as a turn of it has said; its supervisor decides what follows.
        token: the fencing token of its effects; a replica that leads after another one has one of its own.
    """

    port: LifePort | None = None
    live: asyncio.Future[float] | None = None
    live_at: float = 0.0
    has_come_up: bool = False
    settled: asyncio.Future[None] | None = None
    owed: int = 0
    told: int = 0
    heard: int = 0
    is_as_far: bool = False
    is_released: bool = False
    waits_for_release: bool = False
    is_kept_back: bool = False
    replayed: int = 0
    diverged: ReplayDiverged | None = None
    is_void: bool = False
    seen_turn: int = -1
    seen_k: int = 0
    has_ended: bool = False
    token: int = 0

    @property
    def is_awaited(self) -> bool:
        """Whether somebody waits for it to catch up."""
        return self.live is not None and not self.live.done()

    @property
    def is_live(self) -> bool:
        """Whether it has caught up, even if somebody else says when it gets what is new."""
        if not (self.waits_for_release or self.is_kept_back):
            return self.is_released
        return self.is_released or (self.port is not None and self.live is not None and self.live.done())

    @property
    def counts(self) -> bool:
        """Whether what it says counts; else it is about to end."""
        return self.diverged is None and not self.is_void

    @property
    def may_be_released(self) -> bool:
        """Whether nobody else has a say in it, and those that it may send to are there."""
        return not self.waits_for_release and not self.is_kept_back

    @property
    def is_ready(self) -> bool:
        """Whether it has caught up well, and does not get yet what is new."""
        live = self.live
        has_come_up = live is not None and live.done() and not live.cancelled() and live.exception() is None
        return self.port is not None and has_come_up and not self.is_released

    def expect(self, live: asyncio.Future[float]) -> None:
        """Wait for the next life: it is held back until it has caught up."""
        self.is_released = self.waits_for_release = self.is_void = self.has_ended = False
        self.replayed, self.diverged = 0, None
        self.abandon()
        self.live, self.settled = live, None

    def follow(self) -> None:
        """Somebody waits until its start is over, and ends it if that fails."""
        assert self.live is not None
        self.settled, self.has_come_up = self.live.get_loop().create_future(), False

    def attach(self, port: LifePort) -> None:
        """Begin the replay to it."""
        self.port, self.seen_turn, self.owed = port, -1, 0
        self.told, self.heard, self.is_as_far = 0, 0, False

    def come_up(self, restore_seconds: float) -> None:
        """Tell whoever waits for it that it has caught up."""
        self.live_at, self.has_come_up = time.monotonic(), True
        if self.live is not None and not self.live.done():
            self.live.set_result(restore_seconds)

    def settle(self) -> None:
        """Tell whoever follows its start that nothing more comes of what was recorded."""
        if self.settled is not None and not self.settled.done():
            self.settled.set_result(None)

    async def settles(self) -> None:
        """Wait until nothing more comes of what was recorded, unless others say when it goes on with that.

        Raises:
            ReplayDiverged: it has gone another way.
        """
        if self.settled is not None and self.is_released:
            await self.settled
        if self.diverged is not None:
            raise self.diverged

    def waits(self, heard: int) -> None:
        """The turn that had begun waits, and it has heard so many outcomes: if that is all, it goes on when it can."""
        self.heard = heard
        if heard >= self.told:
            self.settle()

    def comes_so_far(self, turn: int) -> bool:
        """Whether a turn that had begun in an earlier life is as far now, for the first time, as it was seen then."""
        if self.is_as_far or self.seen_of(turn) < self.owed or self.heard < self.told:
            return False
        self.is_as_far = True
        return True

    def fail(self, error: Exception) -> bool:
        """Tell whoever waits for it that it will not catch up; False if nobody does, or follows its start."""
        is_awaited = self.settled is not None
        if self.live is not None and not self.live.done():
            self.live.set_exception(error)
            self.live.exception()  # Whoever waited may be gone.
            is_awaited = True
        self.settle()
        return is_awaited

    def abandon(self) -> None:
        """Nobody waits for it any more."""
        if self.live is not None and not self.live.done():
            self.live.cancel()
        self.settle()

    def die(self) -> None:
        """It is over: what comes is for the next one."""
        self.port, self.is_released = None, False
        self.settle()

    def resume(self, port: LifePort | None) -> None:
        """Go on with a life that was at rest, in the place of one that has not become the next one."""
        self.abandon()
        self.diverged, self.is_void = None, False
        self.port, self.is_released = port, True

    def see_again(self, turn: int, k: int) -> None:
        """Take down that output `k` of a replayed turn has come again; 0: none."""
        if self.seen_turn != turn:
            self.seen_turn, self.seen_k = turn, 0
        self.seen_k = k or self.seen_k

    def seen_of(self, turn: int) -> int:
        """How many outputs of a turn have come again."""
        return self.seen_k if self.seen_turn == turn else 0


def is_end_of(wanted: ExitReason, reason: ExitReason) -> bool:
    """Whether a life that was to end for a reason has done so: `on_stop` may say otherwise, and nobody has cut it off.

    >>> from holdfast.actors.exit_reasons import KILLED, NORMAL, SHUTDOWN
    >>> is_end_of(NORMAL, SHUTDOWN), is_end_of(NORMAL, KILLED)
    (True, False)
    """
    return reason == wanted or reason.is_clean or isinstance(reason, Crash)
