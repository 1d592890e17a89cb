"""What bricks say to each other: requests in batches, their outcomes, roles, and states that are transferred."""

from __future__ import annotations

import msgspec

from ..actors.errors import HoldfastError
from ..actors.message import Message
from ..checkpoint.records import Feed, Go, Live, Outcome, PipeDone, Released, Snapshot, SnapshotNow, TurnEnd, Unsaved


class StaleEpoch(HoldfastError):
    """Whoever says this has been replaced: a higher epoch has been seen here.  (fields: path, seen, got)"""


class Request(msgspec.Struct, array_like=True):
    """One request: who has sent it, in which life, and its number at the address (A45)."""

    client: str
    incarnation: int
    feed: Feed

    @property
    def number(self) -> int:
        return self.feed.id


class Work(Message):
    """A batch of requests on its way in. `again`: some may have been handled before (failover)."""

    epoch: int
    config: int
    number: int
    requests: list[Request]
    go: Go | None = None  # replay is over behind these
    again: bool = False


class Taken(msgspec.Struct, array_like=True):
    """The state behind these outcomes is captured, or nobody needs it: go on."""


class Done(Message[Taken]):
    """Outcomes on their way out, in turn order: all of a batch, or a part of it. Asked by Proceed, told by After."""

    epoch: int
    config: int
    number: int
    ends: list[TurnEnd]
    is_last: bool
    live: Live | None = None


class Inward(Message):
    """From the home to the life, past the bricks: outcomes of asks, an order for a snapshot."""

    epoch: int
    records: list[Outcome | SnapshotNow]


class Outward(Message):
    """From the life to the home, past the bricks: what is released in the middle of a turn, background results, snapshots."""

    epoch: int
    records: list[Released | PipeDone | Snapshot | Unsaved]


class Ended(Message):
    """The home has all outcomes of batch `number` (sent with the next Work or by itself when somebody waits)."""

    epoch: int
    number: int


class State(msgspec.Struct, array_like=True):
    """The state of the server after turn `turn`, with what belongs to it. Large ones travel in pieces."""

    epoch: int
    turn: int
    data: bytes
    stash: list[int]
    log: list[tuple[str, int, int, TurnEnd]]  # the reply log: client, incarnation, number, outcome
    is_delta: bool = False
    base: int = -1  # the turn a delta is to be applied to


class Lead(Message[int]):
    """Be primary (leader) from now on; the reply is the turn of the state it goes on from."""

    epoch: int
    config: int


class Follow(Message[int]):
    """Be backup (follower) of this epoch."""

    epoch: int
    config: int
