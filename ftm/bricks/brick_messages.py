"""The messages between bricks: batches of requests, outcomes, roles, and transferred states."""

from __future__ import annotations

import msgspec

from ...actors.kernel.message import Message, Refusal
from ...checkpoint.protocol import (
    Clock,
    Closed,
    Feed,
    Go,
    Hooked,
    Ignored,
    Live,
    MidTurn,
    PastInputs,
    PipeDone,
    Snapshot,
    TurnEnd,
    Unsaved,
)
from .state_images import Image, Patch


class StaleLeader(
    Refusal, text="{path} has seen epoch {seen}, and whoever speaks leads in {got} only: it has been replaced"
):
    """Whoever says this has been replaced: a higher epoch has been seen here."""

    path: str
    seen: int
    got: int


class ConfigMismatch(
    Refusal, text="{path} has the mechanisms of change {here}, and whoever speaks those of {there}: they do not fit"
):
    """The two replicas have different stacks of mechanisms: what one says makes no sense to the other."""

    path: str
    here: int
    there: int


class NotFollowing(
    Refusal, text="{path} follows in epoch {seen}, if at all, and this is of epoch {got}: it is not for this life"
):
    """This life has not been told that it follows in this epoch: what was meant for the one before is not for it."""

    path: str
    seen: int
    got: int


class CannotJoin(Refusal, text="{path} cannot be brought to the state of the leader: {why}"):
    """This replica cannot be brought to the state of the one that leads."""

    path: str
    why: str


class RequestDropped(Refusal):
    """A brick of the mechanism has neither passed this request on nor ended it.

    `may_have_run`: a turn was handled whose outcome was lost in the bricks too, and that may be this one.
    """

    path: str
    number: int
    may_have_run: bool = False

    def __str__(self) -> str:
        known = "it may have been handled" if self.may_have_run else "it was not handled: ask again"
        return (
            f"a brick of {self.path} has neither passed request {self.number} on nor ended it: mend the brick; {known}"
        )


class NoReply(
    Refusal,
    text="{brick} has ended {message} with what is no reply to it: {problem}; mend the brick; it was not handled",
):
    """A brick of the mechanism has answered this request itself, and not as the message declares its reply."""

    brick: str
    message: str
    problem: str


class ReplyEvicted(
    Refusal, text="request {number} to {path} was handled, but its reply is not kept any more: ask for what it has done"
):
    """The request was handled, but its reply is not kept any more: the reply log is bounded."""

    path: str
    number: int


MOST_REQUESTS = 512
"""Of one batch; no other one is on its way meanwhile."""
FORWARDED = -(1 << 40)
"""A batch with this number or a lower one came from a leader, and home knows nothing of it here.

Each state that a follower takes lowers the number: what was on its way to the one before is known by that.
"""


def marker_of(epoch: int) -> int:
    """The number of the batch that a new leader sends through its own bricks before any request.

    When it comes out, all that the last leader gave this replica to compute has ended.
    """
    return -2 - epoch


def is_marker(number: int) -> bool:
    """Whether a batch is the first one of a new leader."""
    return FORWARDED < number < -1


class CannotLead(Refusal, text="{path} does not have the state of the last leader: another replica has to lead"):
    """This replica does not have the state of the last leader (any more): another one has to lead, or none."""

    path: str


class Request(msgspec.Struct, array_like=True, gc=False):
    """One request: who has sent it, in which life, and its number at the address (A45)."""

    client: str
    incarnation: int
    feed: Feed

    @property
    def number(self) -> int:
        """It counts the inputs of the address."""
        return self.feed.id


Logged = tuple[str, int, int, TurnEnd]
"""An entry of the reply log: client, incarnation, number, outcome."""


class Work(Message):
    """A batch of requests on its way in. `copy`: home wants the state behind it too."""

    epoch: int
    config: int
    number: int
    requests: list[Request]
    go: Go | None = None  # replay is over behind these
    copy: bool = False


class Taken(msgspec.Struct, array_like=True):
    """The state behind these outcomes is captured, or nobody needs it: go on."""


class Strayed(msgspec.Struct, array_like=True, tag=41):
    """From a leader: the replica at this path has not got our state any more, and does not count."""

    path: str


class WorkLost(msgspec.Struct, array_like=True, tag=42):
    """From a leader: background work that turns up to this one had begun has ended with the life that ran it."""

    turn: int


class PutBack(msgspec.Struct, array_like=True, tag=43):
    """From a leader: between two batches, a hook has put back what was put aside; it is handled with the next batch."""


Beside = PipeDone | Snapshot | Unsaved | Closed | Ignored | Hooked | Strayed | WorkLost | PutBack
"""What goes home besides the ends of turns, behind them."""


class Done(Message[Taken]):
    """Outcomes on their way out, in turn order: all of a batch, or a part of it. Asked by Proceed, told to the Proxy.

    `more` goes home behind the ends, and behind all turns up to `behind`; `live` goes behind all. `part` counts what
    Proceed hands over; with `wait` it waits for `PartEnded` of it.
    """

    epoch: int
    config: int
    number: int
    ends: list[TurnEnd]
    is_last: bool
    live: Live | None = None
    more: list[Beside] = []  # noqa: RUF012  # a struct copies it
    part: int = 0
    wait: bool = False
    behind: int = -1


class Inward(Message):
    """From the home to the life, past the bricks: outcomes of asks and effects, orders for an effect or a snapshot."""

    epoch: int
    records: list[PastInputs]


class Outward(Message):
    """From the life to the home, past the bricks, of a turn that is at the front: what is released in the middle of it,
    and what its effects have come to."""

    epoch: int
    records: list[MidTurn]


class PartEnded(Message):
    """The home has the outcomes of part `number` and of all before it. Sent only if a `Done` asks for it."""

    epoch: int
    number: int


class ServerState(msgspec.Struct, array_like=True, tag=1):
    """The state of the server after turn `turn`, with what belongs to it: `data`, and `deltas` on top of that.

    `live`: it has caught up with its home. Large ones travel in pieces.
    """

    turn: int
    data: Image
    deltas: list[bytes]
    stash: list[Feed]
    returned: list[Feed]
    live: bool
    stash_ids: list[int] = []
    traps: bool = False  # `ctx.trap_exits`
    absent: list[str] = []  # variables that `__init__` has made, and that are no more
    variables: list[str] = []  # that the class had which has saved it, if that was another version, perhaps
    timers: dict[str, Clock] = {}  # those whose messages may still come


class StateDelta(msgspec.Struct, array_like=True, tag=2):
    """What leads from the state after turn `base` to that after `turn`.

    Either `deltas` (with their checksum) on top of those that are there, or, with a `patch`, another image with these.
    """

    turn: int
    base: int
    patch: Patch | None
    deltas: list[bytes]
    check: int
    stash: list[Feed]
    returned: list[Feed]
    live: bool
    stash_ids: list[int] = []
    traps: bool = False
    absent: list[str] = []
    timers: dict[str, Clock] | None = None  # None: those of the state after turn `base`


class Lead(Message[int]):
    """Be primary (leader) from now on; the reply is the turn of the state it goes on from.

    `turn`: the last one that home knows of. Those that are lost (which only a mechanism that does not wait for its
    backup admits) are not numbered anew. `peer`: a replica that stays a member under this leader. `known`: the turn
    up to which home has the background work that was begun, and has given it up.
    """

    epoch: int
    config: int
    turn: int = -1
    peer: str | None = None
    known: int = -1


class Follow(Message[int]):
    """Be backup (follower) of this epoch."""

    epoch: int
    config: int
