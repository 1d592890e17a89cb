"""Requests on their way between a protected address's home and its primary: data and decisions.

One batch is out at a time. Another leader gets all again that has no end yet; what a replica had that does not lead any
more, and has not ended since, counts as inside.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Container
from typing import TYPE_CHECKING, Literal

import msgspec

from ...checkpoint.protocol import DROPPED, Feed, Go, Outcome, PastInputs, Perform, SnapshotNow, ToLife
from ..bricks.brick_messages import MOST_REQUESTS

if TYPE_CHECKING:
    from ...checkpoint.protocol import TurnEnd
    from ..bricks.brick_messages import PartEnded, Work

MOST_BYTES = 1_000_000
"""Of one batch."""


@dataclasses.dataclass(slots=True)
class Delivery:
    """What has come from the home of one address, and how far it is.

    Attributes:
        waiting: what has not been sent to whoever leads now, in order.
        inward: what goes past the bricks.
        finished: parts whose outcomes somebody waits to be at home.
        fed: what the home has fed and not heard the end of, by number, in that order.
        earlier: what it has fed again for a later turn, by number: what was put aside is replayed for both turns.
        careful: inputs in whose company a replica has died: each is sent alone.
        inside: inputs that a replica had that does not lead any more, not ended since.
        out: the batch that is out.
        number: of the last batch.
        is_again: another leader has not been sent all there is.
        is_live: the life has caught up.
        has_gone: it has been told that nothing of its past follows.
        is_held: nothing new goes in: nobody could take over yet.
        is_suspended: nothing new goes in: somebody has ordered that.
        is_stopping: nothing new goes in: the life is about to end, or to move.
        is_resting: nothing new goes in: the mechanism is about to be changed.
        stale: messages of earlier epochs, for whoever wants to know.
        doubled: outcomes that were known, the same.
    """

    waiting: deque[Feed | Go] = dataclasses.field(default_factory=deque)
    inward: list[PastInputs] = dataclasses.field(default_factory=list)
    finished: list[PartEnded] = dataclasses.field(default_factory=list)
    fed: dict[int, Feed] = dataclasses.field(default_factory=dict)
    earlier: dict[int, list[Feed]] = dataclasses.field(default_factory=dict)
    careful: set[int] = dataclasses.field(default_factory=set)
    inside: set[int] = dataclasses.field(default_factory=set)
    out: Work | None = None
    number: int = 0
    is_again: bool = False
    is_live: bool = False
    has_gone: bool = False
    is_held: bool = False
    is_suspended: bool = False
    is_stopping: bool = False
    is_resting: bool = False
    stale: int = 0
    doubled: int = 0

    @property
    def is_idle(self) -> bool:
        """Whether nothing is out, and nothing waits."""
        return self.out is None and not self.waiting

    @property
    def is_quiet(self) -> bool:
        """Whether no replica has anything that has not ended."""
        return self.out is None and not self.inside

    @property
    def takes_new(self) -> bool:
        """Whether what was inside no replica before may go in."""
        return not (self.is_suspended or self.is_stopping or self.is_resting)

    def put(self, record: ToLife) -> bool:
        """Take what the home has for its life; False if it is only for lives that are no group."""
        match record:
            case Feed():
                before = self.fed.pop(record.id, None)
                if before is not None:
                    self.earlier.setdefault(record.id, []).append(before)
                self.fed[record.id] = record
                self.waiting.append(record)
            case Go():  # Whoever leads does not end in the middle of the start: its place ends it behind that.
                self.waiting.append(msgspec.structs.replace(record, ends=None, ended=record.turn))
            case Outcome() | Perform() | SnapshotNow():
                self.inward.append(record)
                if isinstance(record, Outcome) and self.fed.pop(record.taken, None) is not None:
                    self.inside.discard(record.taken)  # It is none any more: a turn has waited for it.
            case _:
                return False
        return True

    def come_up(self) -> None:
        """The life has caught up: what is fed from now on is new."""
        self.is_live = True
        self.earlier.clear()

    def next_inward(self) -> list[PastInputs]:
        """Take what goes past the bricks; a snapshot is asked for when the home knows all that a replica does."""
        records, self.inward = self.inward, []
        if self.inside:
            self.inward = [one for one in records if isinstance(one, SnapshotNow)]
            records = [one for one in records if one not in self.inward]
        return records

    def next_batch(self, open_inputs: Container[int]) -> tuple[list[Feed], Go | None] | None:
        """Take what goes out next, if anything does. What was inside once is sent in any case.

        Another leader is sent a batch even if it is empty: what it has to say of the time before waits for that.
        """
        if self.out is not None:
            return None
        batch, go, size = list[Feed](), None, 0
        is_open = not (self.has_gone and self.is_held)
        while is_open and self.waiting and len(batch) < MOST_REQUESTS and size < MOST_BYTES:
            first = self.waiting[0]
            if not self.takes_new and (isinstance(first, Go) or first.id not in self.inside):
                break
            if isinstance(first, Go):
                go, self.has_gone = first, True
                self.waiting.popleft()
                break
            is_alone = first.id in self.careful
            if batch and (is_alone or (first.id in self.earlier and any(one.id == first.id for one in batch))):
                break
            self.waiting.popleft()
            if self.is_live and first.id not in open_inputs:  # The home has dropped it meanwhile.
                self.fed.pop(first.id, None)
                self.inside.discard(first.id)
                continue
            batch.append(first)
            size += len(first.body)
            if is_alone:
                break
        if not batch and go is None and not self.is_again:
            return None
        if not self.waiting or not batch:
            self.is_again = False
        self.number += 1
        return batch, go

    def end_batch(self, number: int) -> Work | None:
        """The batch of this number has ended: take it back, if it is the one that is out."""
        out = self.out
        if out is None or out.number != number:
            return None
        self.out = None
        ended = {one.feed.id for one in out.requests}
        self.careful -= ended
        self.inside -= ended
        return out

    def send_again(self, open_inputs: Container[int], begun: int, *, careful: bool = False) -> None:
        """All that has no end yet goes to whoever leads now.

        Args:
            open_inputs: what has no end, as far as the home knows, once the life is live.
            begun: what had begun to let something out, -1 if nothing: it comes first, whatever its deadline.
            careful: a replica has died with a batch inside; if that was the fault of one of its messages, it will be
                seen which one.
        """
        out = self.out
        if careful and out is not None:
            self.careful = {one.feed.id for one in out.requests if one.feed.id in self.fed}
        left = [feed for feed in self.fed.values() if not self.is_live or feed.id in open_inputs]
        left = [msgspec.structs.replace(feed, has_begun=False) if feed.has_begun else feed for feed in left]
        self.fed = {feed.id: feed for feed in left}
        if not self.is_live:
            left += [feed for key, feeds in self.earlier.items() if key in self.fed for feed in feeds]
            left.sort(key=lambda feed: feed.turn if feed.turn >= 0 else math.inf)
        unsent = {one.id for one in self.waiting if isinstance(one, Feed)} - self.inside
        self.inside = self.fed.keys() - unsent
        left.sort(key=lambda feed: feed.id != begun)
        if left and left[0].id == begun:
            left[0] = self.fed[begun] = msgspec.structs.replace(left[0], deadline=0.0, has_begun=True)
        gone: list[Go] = [one for one in self.waiting if isinstance(one, Go)]
        if out is not None and out.go is not None and not self.is_live:
            gone = [out.go]
        self.waiting = deque([*left, *gone])
        self.out, self.is_again = None, True

    def withdraw(self, open_inputs: Container[int], begun: int) -> None:
        """Nothing is inside any more: all that has no end yet is sent again when something may go in."""
        self.send_again(open_inputs, begun)
        self.inside.clear()
        self.is_again = False

    def only_suspect_input(self) -> int:
        """The input in whose turn a replica must have died, if only one was inside; else -1."""
        requests = [] if self.out is None else self.out.requests
        return requests[0].feed.id if len(requests) == 1 and requests[0].feed.id in self.fed else -1

    def judge(self, end: TurnEnd, turn: int, *, is_open: bool, is_known: Callable[[int, int], bool]) -> Judgement:
        """Decide what the end of a turn is to the home.

        Args:
            end: as a replica has said it.
            turn: the last one that the home knows of.
            is_open: the home waits for the end of this input.
            is_known: whether the home has this input in this turn, or among those that were put aside.
        """
        if end.turn < 0 and end.status == DROPPED:
            return "dropped"
        if not self.is_live or (end.turn > turn and is_open):
            return "new"
        return "double" if not is_open or is_known(end.turn, end.id) else "behind"


Judgement = Literal["dropped", "new", "double", "behind"]
"""An end without a turn; one that counts; one that is known; one of a life that is not what was acknowledged."""
