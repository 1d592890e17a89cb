"""The state of a replica besides its rewind points: the part in hand, what turns let out, what goes home.

All here is data and decisions about it; the server (`protected_actor.py`) carries them out.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Container, Iterable
from typing import Final

from ...checkpoint.protocol import AWAITED, DOWN, EXIT, PIPE, START, Feed, Out, Outcome, PipeDone, TurnEnd
from ..bricks.brick_messages import Beside, Request
from .replica_life import ABANDONED

PART: Final = 0.001
"""Seconds of work after which the outcomes so far are handed over: a slow request does not hold up quick ones."""
MOST_TAKEN: Final = 4096
"""Requests that are remembered because a turn has waited for them: more than can be inside a replica."""
MOST_AT_ONCE: Final = 256
"""Requests that are given to the life at once."""

# What follows when the life ends in the middle of a part.
GIVE_UP, STOP, REWIND, GO_ON = "give up", "stop", "rewind", "go on"


@dataclasses.dataclass(slots=True)
class ReplicaState:
    """What holds of the protected actor in this replica, whichever life it is in."""

    has_access: bool = True  # to its state
    has_deltas: bool = False  # it says itself what has changed
    is_lazy: bool = False  # what comes out is the same each time: points may be far apart
    can_save: bool = True  # as far as is known, where nobody looks at the state after each part
    is_over: bool = False  # it has ended itself
    is_stopping: bool = False  # it is being ended
    is_quiet: bool = False  # a life handles again what was handed over since its point: nobody hears of it
    is_again: bool = False  # a part is run once more: nothing leaves
    is_as_given: bool = False  # a life begins that stands as another one does, whatever its hooks do
    is_work_lost: bool = False  # background work has ended with the last life
    wants_life: bool = False  # one is to begin whose hooks count, though no request waits for it
    start_turn: int = -1  # that a life without a point goes on from
    handed: int = 0  # parts that were handed over
    confirmed: int = 0  # parts that are known to be at home
    begun: int = -1  # the request that had sent something in a turn without an end, when it came
    alone: set[tuple[str, str]] = dataclasses.field(default_factory=set)  # inputs that have wanted to be at the front
    waiting: frozenset[str] = frozenset()  # messages whose handlers may wait for something


@dataclasses.dataclass(slots=True)
class BatchPart:
    """The part of a batch that is in hand: what was given to the life, and how it has ended."""

    pending: deque[Request]
    begun: list[Request] = dataclasses.field(default_factory=list)
    ends: list[TurnEnd] = dataclasses.field(default_factory=list)
    is_cut: bool = False  # it ends behind the turn in hand, which has let something out, or has put messages back
    is_given_up: bool = False

    def take_back(self) -> None:
        """Nothing of it has happened: all that was begun is pending again."""
        self.pending.extendleft(reversed(self.begun))
        self.begun, self.ends = [], []

    def give_up(self) -> None:
        """What was to be run does not count any more: another state is put in the place of what it leads to."""
        self.is_given_up = True
        self.pending.clear()
        self.begun, self.ends = [], []

    def hand_out(self) -> tuple[list[Request], list[TurnEnd]]:
        """Take out what has ended: the requests, and their ends."""
        ends, self.ends = self.ends, []
        known = {end.id for end in ends}
        handed = [one for one in self.begun if one.feed.id in known]
        self.begun = [one for one in self.begun if one.feed.id not in known]
        return handed, ends

    def leave_out(self, numbers: Container[int]) -> None:
        """These are requests no more: a turn that has waited for them has them."""
        left = [one for one in self.pending if one.feed.id not in numbers]
        self.pending.clear()  # It is the same deque for whoever has given it.
        self.pending.extend(left)

    def send_back(self, numbers: set[int]) -> None:
        """These requests were given to the life, and taken from it before it began them."""
        self.pending.extendleft(reversed([one for one in self.begun if one.feed.id in numbers]))
        self.begun = [one for one in self.begun if one.feed.id not in numbers]


@dataclasses.dataclass(slots=True)
class Attempts:
    """How requests are tried: how many at once, and what has come of those that were tried before."""

    size: int = 8  # requests at once
    singles: int = 0  # requests that are run one at a time: one of them has left what cannot be saved
    crashes: int = 0  # ends of the life outside any turn, one after another
    crashed: float = 0.0  # when it last has, by the loop's clock
    failed: int | None = None  # the request whose turn has failed, and with it the life
    skips: dict[int, TurnEnd] = dataclasses.field(default_factory=dict)  # requests that fail without being run
    owed: set[int] = dataclasses.field(default_factory=set)  # those whose failure ends the life that comes to them
    is_undone: bool = False  # no crash has ended the last life: the next one does not recover, it goes on

    def still_owed(self) -> dict[int, TurnEnd]:
        """How those requests fail whose failure is still to come."""
        return {number: end for number, end in self.skips.items() if number in self.owed}


@dataclasses.dataclass(slots=True)
class Traces:
    """What turns have asked, heard and let out, as far as they may be run again."""

    heard: dict[tuple[int, int], Outcome] = dataclasses.field(default_factory=dict)  # by turn and number of the ask
    withheld: list[Out] = dataclasses.field(default_factory=list)  # of the turn in hand, on a follower
    inputs: dict[int, Request] = dataclasses.field(default_factory=dict)  # as they came in, for other runs of them
    objections: dict[int, str] = dataclasses.field(default_factory=dict)  # what hooks have against requests
    results: set[tuple[int, int]] = dataclasses.field(default_factory=set)  # of background work, by turn and output
    taken: dict[int, None] = dataclasses.field(default_factory=dict)  # requests that turns have waited for, in order

    def hear(self, outcome: Outcome) -> None:
        """Take down what an ask has come to, and the request that a turn has waited for."""
        self.heard[outcome.turn, outcome.k] = outcome
        if outcome.taken >= 0:  # It may be on its way still, in a batch from whoever leads.
            self.taken[outcome.taken] = None
            if len(self.taken) > MOST_TAKEN:
                del self.taken[next(iter(self.taken))]

    def begin_anew(self, heard: Iterable[Outcome]) -> None:
        """Nothing is known but what asks came to elsewhere."""
        self.heard = {(one.turn, one.k): one for one in heard}
        self.withheld, self.objections = [], {}

    def note_results(self, requests: Iterable[Request]) -> None:
        """These have come: the background work whose result they bring is not begun again."""
        for feed in (one.feed for one in requests):
            if feed.kind == PIPE and feed.origin:
                turn, k = map(int, feed.origin.split("."))
                self.results.add((turn, k))

    def forget(self, turn: int) -> None:
        """Turns up to this one are not run again."""
        if self.heard:
            self.heard = {key: one for key, one in self.heard.items() if key[0] > turn}
        if self.results:
            self.results = {key for key in self.results if key[0] > turn}


@dataclasses.dataclass(slots=True)
class Reports:
    """What goes home besides the ends of turns."""

    more: list[Beside] = dataclasses.field(default_factory=list)
    is_snapshot_wanted: bool = False
    is_large: bool = False  # the state is not gone through again for a copy

    def take_back(self, turn: int) -> None:
        """Background work that turns behind this one have begun has brought nothing."""
        self.more = [one for one in self.more if not isinstance(one, PipeDone) or one.turn <= turn]


def known_outcomes(traces: Traces, turn: int, outs: Iterable[Out]) -> list[Outcome] | None:
    """Find what the asks of a turn came to when it was run before; None if that is not known of all of them."""
    found = [traces.heard.get((turn, out.k)) for out in outs if out.verb in AWAITED]
    known = [one for one in found if one is not None]
    return known if len(known) == len(found) else None


def is_front(state: ReplicaState, part: BatchPart, *, leads: bool) -> bool:
    """Whether home has the ends of all turns before the one in hand: it may let something out before its end."""
    return leads and not part.ends and state.confirmed >= state.handed


def runs_alone(state: ReplicaState, feed: Feed, *, leads: bool, has_work: bool) -> bool:
    """Whether an input has to stand at the front: it may want something released before its end.

    Otherwise the life ends if it does want that, and begins again before the part. While background work is out
    (`has_work`) that must not be: the work would end with the life.
    """
    if state.is_again or (state.is_lazy and not leads):
        return False
    if feed.kind == START or (feed.kind, feed.name) in state.alone:
        return True
    may_wait = feed.name in state.waiting or feed.kind in (DOWN, EXIT)
    return may_wait and (has_work or not state.has_access)


def next_requests(
    state: ReplicaState, part: BatchPart, attempts: Attempts, *, leads: bool, has_work: bool
) -> list[Request]:
    """Take the next few pending requests that can be given to the life at once; none if they have to wait."""
    pending = part.pending
    if runs_alone(state, pending[0].feed, leads=leads, has_work=has_work):
        is_early = leads and state.confirmed < state.handed
        return [] if part.begun or part.ends or is_early else [pending.popleft()]
    if attempts.singles:
        if part.begun:
            return []
        attempts.singles -= 1
        return [pending.popleft()]
    chunk = [pending.popleft()]
    while pending and len(chunk) < attempts.size:
        if pending[0].feed.id in attempts.owed or runs_alone(state, pending[0].feed, leads=leads, has_work=has_work):
            break
        chunk.append(pending.popleft())
    return chunk


def size_after(size: int, count: int, seconds: float) -> int:
    """Decide how many requests are given to the life at once, when `count` have taken so many seconds."""
    if seconds < PART / 4 and count >= size:
        return min(MOST_AT_ONCE, size * 2)
    return max(1, size // 2) if seconds > PART else size


def after_end(state: ReplicaState, part: BatchPart, failed: int | None, why: str, *, has_point: bool) -> str:
    """Decide what follows when the life has ended, or was left, in the middle of a part.

    Args:
        state: of the replica.
        part: that was in hand.
        failed: the request in whose turn it has ended; None if that was outside any turn.
        why: the life has come to rest.
        has_point: whether there is a point to go back to.
    """
    if why is ABANDONED:
        return GIVE_UP
    if state.is_stopping or state.is_over:
        return STOP
    if any(one.feed.id == failed and one.feed.kind == START for one in part.begun):
        return STOP
    return REWIND if state.has_access and (has_point or failed is None) else GO_ON
