"""A line: what one program sends another arrives once and in order, over a transport that may lose and repeat.

Both ends number what they send, keep it until the other end says that it has it, and send it again from there on. A
line joins two incarnations: what was sent to a program that was started anew since is refused, however late it comes.
"""

from __future__ import annotations

import asyncio
import sys
from collections import deque
from collections.abc import Callable
from typing import Final, Literal, NamedTuple

import msgspec

RESEND_SECONDS: Final = 0.5
"""After so long without a word that something has come, it is sent again."""
MOST_RESEND_SECONDS: Final = 4.0
"""That time doubles each time up to this."""
ACK_SECONDS: Final = 0.02
"""How long what has come may wait to be acknowledged with what is sent anyway."""
ACK_AT_ONCE: Final = 256
"""Items after which that is not waited for."""
BATCH_BYTES: Final = 256 * 1024
"""Bytes of items after which a batch is full."""
MOST_BYTES: Final = 7 * 1024 * 1024
"""The largest item, in bytes: servers take messages of 8 MiB."""
WINDOW_BYTES: Final = 8 * 1024 * 1024
"""Bytes on the way from which on senders that can wait do."""


class Boot(NamedTuple):
    """One run of a program: of two runs of one system the later one has the larger era."""

    era: int
    token: str


NOBODY: Final = Boot(0, "")
"""The incarnation that a greeting is for: whoever is there."""

Note = Literal["", "full", "lost", "unknown", "bye"]
"""What a batch says besides: no more messages for now; something before it has not come; whoever it answers is not
known; the line ends."""


class LineBatch(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """What is posted at once.

    Attributes:
        sender: the name of the program that sends it.
        boot: the incarnation of that program.
        to: the incarnation that it is for; NOBODY in a greeting.
        got: how many items of the other end have come.
        first: the number of the first item.
        items: in order.
        note: what it says besides.
        line: the number of the line, of all that the sender has begun with this program.
        to_line: the same as the other end counts; 0 in a greeting.
    """

    sender: str
    boot: Boot
    to: Boot
    got: int
    first: int
    items: tuple[bytes, ...]
    note: Note = ""
    line: int = 0
    to_line: int = 0


class Unarrived(NamedTuple):
    """What is kept until it has arrived, and what is done then."""

    data: bytes
    arrived: Callable[[], None] | None


class Line:
    """One end of a line.

    Args:
        loop: whose clock it goes by.
        post: posts a batch of the items from a number on, with what has come so far, and a note; it may get lost.
        take: is given each item of the other end, once and in order.

    Attributes:
        got: how many items of the other end have come.
    """

    __slots__ = (
        "_arrived",
        "_bytes",
        "_flushing",
        "_flying",
        "_is_choked",
        "_loop",
        "_missed",
        "_moved",
        "_owed",
        "_owing",
        "_patience",
        "_post",
        "_resend",
        "_sent",
        "_take",
        "_unnumbered",
        "_waiters",
        "_waiting",
        "got",
        "is_open",
    )

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        post: Callable[[int, tuple[bytes, ...], Note], None],
        take: Callable[[bytes], None],
    ) -> None:
        self._loop, self._post, self._take = loop, post, take
        self.got = 0
        self.is_open = True
        self._waiting: deque[Unarrived] = deque()  # sent, and not known to have arrived; then what is not sent yet
        self._unnumbered: deque[bytes] = deque()  # what waits until the other end takes more
        self._flying = 0  # bytes of what has a number
        self._is_choked = False  # whether the other end wants no more messages for now
        self._arrived = 0  # how many of all items so far the other end has said to have
        self._sent = 0  # how many of all items so far have been sent
        self._owed = 0  # items that have come and are not acknowledged
        self._patience = RESEND_SECONDS
        self._missed = -1  # how many had come when it was last said that the next one had not
        self._moved = loop.time()  # when something of ours has last arrived, or was sent when nothing else was out
        self._bytes = 0
        self._flushing: asyncio.Handle | None = None
        self._owing: asyncio.TimerHandle | None = None
        self._resend: asyncio.TimerHandle | None = None
        self._waiters: list[tuple[Callable[[], bool], asyncio.Future[None]]] = []

    # -- out --------------------------------------------------------------------------------------------------------

    def put(self, data: bytes, arrived: Callable[[], None] | None = None) -> None:
        """Send an item with all others of this tick; `arrived` is called when the other end has said that it has it."""
        if not self.is_open:
            return
        if not self._waiting:
            self._moved = self._loop.time()
        self._waiting.append(Unarrived(data, arrived))
        self._bytes += len(data)
        self._flying += len(data)
        if self._flushing is None:
            self._flushing = self._loop.call_soon(self.flush)

    def put_message(self, data: bytes) -> None:
        """Send an item when the other end takes it: it may want no more for now, and what answers it goes past that."""
        if self._unnumbered or self._is_choked or self._flying >= WINDOW_BYTES:
            if self.is_open:
                self._unnumbered.append(data)
                self._bytes += len(data)
        else:
            self.put(data)

    def _number_some(self) -> None:
        """Send what has waited until the other end takes more."""
        while self._unnumbered and not self._is_choked and self._flying < WINDOW_BYTES:
            data = self._unnumbered.popleft()
            self._bytes -= len(data)
            self.put(data)

    def emptied(self) -> asyncio.Future[None] | None:
        """None if all messages are on their way; else a future that ends when they are, or the line has ended."""
        return self._until(lambda: not self._unnumbered)

    @property
    def waiting_bytes(self) -> int:
        """How many bytes of items there are that the other end is not known to have."""
        return self._bytes

    def stuck_for(self, seconds: float, most: int) -> int:
        """How many bytes wait, if more do than may, or if the other end has had none of a full window for so long."""
        if self._flying < WINDOW_BYTES and self._bytes < WINDOW_BYTES:
            return 0
        is_stuck = self._loop.time() - self._moved > seconds
        return self._bytes if is_stuck or self._bytes > most else 0

    @property
    def has_room(self) -> bool:
        """Whether the other end keeps up."""
        return self._bytes < WINDOW_BYTES

    def room(self) -> asyncio.Future[None] | None:
        """None while the other end keeps up; else a future that ends when it does again, or the line has ended."""
        return self._until(lambda: self.has_room)

    def _until(self, holds: Callable[[], bool]) -> asyncio.Future[None] | None:
        """None if something holds; else a future that ends when it does, or the line has ended."""
        if holds() or not self.is_open:
            return None
        future: asyncio.Future[None] = self._loop.create_future()
        self._waiters.append((holds, future))
        return future

    def flush(self, most: int = sys.maxsize) -> None:
        """Post what has not been sent yet, in so many batches at most."""
        if self._flushing is not None:
            self._flushing.cancel()
            self._flushing = None
        if not self.is_open:
            return
        at = self._sent - self._arrived
        while at < len(self._waiting) and most > 0:
            most -= 1
            items: list[bytes] = []
            size = 0
            while at + len(items) < len(self._waiting) and (not items or size < BATCH_BYTES):
                data = self._waiting[at + len(items)].data
                items.append(data)
                size += len(data)
            first, self._sent = self._sent + 1, self._sent + len(items)
            at += len(items)
            self._acknowledged()
            self._post(first, tuple(items), "")
        if self._waiting and self._resend is None:
            self._resend = self._loop.call_later(self._patience, self._probe)

    def say(self, note: Note = "") -> None:
        """Post a batch without items: what has come, and a note."""
        if self.is_open:
            self._acknowledged()
            self._post(self._sent + 1, (), note)

    def _acknowledged(self) -> None:
        self._owed = 0
        if self._owing is not None:
            self._owing.cancel()
            self._owing = None

    def _probe(self) -> None:
        """Nothing was said for long: send the oldest batch again. If it is only late, the rest is on its way."""
        self._resend = None
        self._patience = min(2.0 * self._patience, MOST_RESEND_SECONDS)
        self._sent = self._arrived
        self.flush(1)

    def _again(self) -> None:
        if self._resend is not None:
            self._resend.cancel()
            self._resend = None
        self._sent = self._arrived
        self.flush()

    # -- in ---------------------------------------------------------------------------------------------------------

    def hear(self, batch: LineBatch) -> None:
        """Take a batch of the other end."""
        self._arrive(batch.got)
        if batch.note in ("", "full"):
            self._is_choked = batch.note == "full"
            self._number_some()
            self._release()
        if batch.note == "lost" and self._waiting:
            self._again()
        if not batch.items:
            return
        if batch.first > self.got + 1:
            if self._missed != self.got:  # Once: if that is lost too, it is sent again after a while.
                self._missed = self.got
                self.say("lost")
            return
        before = self.got
        for data in batch.items[self.got + 1 - batch.first :]:
            if not self.is_open:
                return
            self.got += 1
            self._owed += 1
            self._take(data)
        if self._owed >= ACK_AT_ONCE or self.got == before:  # Or all of it is sent again: our word was lost.
            self.say()
        elif self._owed and self._owing is None:
            self._owing = self._loop.call_later(ACK_SECONDS, self.say)

    def _arrive(self, got: int) -> None:
        """The other end has so many of our items."""
        if got <= self._arrived:
            return
        self._moved = self._loop.time()
        if self._resend is not None:
            self._resend.cancel()
            self._resend = None
        while self._arrived < got and self._waiting:
            item = self._waiting.popleft()
            self._arrived += 1
            self._bytes -= len(item.data)
            self._flying -= len(item.data)
            if item.arrived is not None:
                item.arrived()
        self._sent = max(self._sent, self._arrived)
        self._patience = RESEND_SECONDS
        self._number_some()
        if self._waiting:
            self.flush()
        self._release()

    def close(self) -> None:
        """End it: nothing is sent or taken any more, and whoever waits for room goes on."""
        self.is_open = False
        for handle in (self._flushing, self._owing, self._resend):
            if handle is not None:
                handle.cancel()
        self._flushing = self._owing = self._resend = None
        self._waiting.clear()
        self._unnumbered.clear()
        self._release()

    def _release(self) -> None:
        """Have those go on who wait for what holds now."""
        if not self._waiters:
            return
        waiters, self._waiters = self._waiters, []
        for holds, future in waiters:
            if self.is_open and not holds():
                self._waiters.append((holds, future))
            elif not future.done():
                future.set_result(None)
