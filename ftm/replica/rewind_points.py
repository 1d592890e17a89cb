"""Rewind points: states as bytes from which the protected actor's life begins, or to which it returns.

A replica has a point behind each part that it has handed over, and knows what was handed over since. All here is data
and decisions about it; the server (`protected_actor.py`) carries them out.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterable
from operator import is_
from typing import Final

import msgspec

from ...checkpoint.protocol import FAILED, Clock, TurnEnd
from ..bricks.brick_messages import Request, ServerState, StateDelta
from ..bricks.state_images import BLOCK, Misfit
from ..bricks.state_images import patch as make_patch

COMPACT_BYTES: Final = 64 * 1024
"""Deltas that are larger than the state they belong to, and than this, are replaced by a whole state."""
MOST_DELTAS: Final = 4096
"""So are more than these: whoever leads next has to apply them."""
MOST_TAIL: Final = 256
"""Requests after which a point is wanted also where outcomes come out the same each time."""
UNKNOWN: Final = -3
"""In place of the turn that a delta begins after."""


@dataclasses.dataclass(slots=True)
class RewindPoints:
    """The point that the replica can begin again at, the one before it, and what was handed over since."""

    point: ServerState | None = None
    marks: list[int] = dataclasses.field(default_factory=list)  # the turns that the point's deltas begin after
    delta_bytes: int = 0  # of the point's deltas
    names: set[str] | None = None  # the actor's variables at the point, if the state consists of them
    tail: list[tuple[Request, TurnEnd | None]] = dataclasses.field(default_factory=list)  # with the end if it failed
    previous: tuple[ServerState, list[Request]] | None = None  # before the last part, and that part
    given: ServerState | None = None  # the point that another replica was told last
    untraced: int = -2  # hooks have changed the state of this turn: from it, or an earlier one, nothing leads on

    @property
    def turn(self) -> int:
        """The turn of the point; -1 without one."""
        return -1 if self.point is None else self.point.turn

    def install(self, point: ServerState | None) -> None:
        """Have another state as the only point: nothing that is known leads to it."""
        self.go_back_to(point)
        self.previous = self.names = None

    def go_back_to(self, point: ServerState | None) -> None:
        """Have this point again; what was handed over since it has not happened."""
        self.point, self.tail = point, []
        deltas = [] if point is None else point.deltas
        self.marks, self.delta_bytes = [UNKNOWN] * len(deltas), sum(map(len, deltas))

    def go_on_to(self, point: ServerState) -> None:
        """Have the state behind what was handed over: a whole one, or the last one with one more delta."""
        if point.deltas:
            self.marks.append(self.turn)
            self.delta_bytes += len(point.deltas[-1])
        else:
            self.marks, self.delta_bytes = [], 0
        self.point, self.tail = point, []

    def stand_changed(self, point: ServerState) -> None:
        """Have a state that differs from the last one though no turn was run: nobody else knows what led to it."""
        self.go_on_to(point)
        self.untraced = point.turn

    def skip_to(self, turn: int) -> None:
        """Count these turns as used, though they have left nothing."""
        if self.point is not None:
            self.stay(msgspec.structs.replace(self.point, turn=turn))

    def stay(self, point: ServerState) -> None:
        """Have the same state behind turns that have left nothing; no difference leads to it."""
        self.point, self.tail = point, []
        self.marks = [UNKNOWN] * len(point.deltas)

    def keep_tail(self, requests: list[Request], ends: list[TurnEnd]) -> None:
        """Remember requests that are handed over: a life that begins at the point handles them again."""
        failed = {end.id: end for end in ends if end.status == FAILED}
        self.tail += [(one, failed.get(one.feed.id)) for one in requests]


def checksum(parts: Iterable[bytes]) -> int:
    """Return the checksum of bytes, one behind the other."""
    found = 0
    for part in parts:
        found = zlib.crc32(part, found)
    return found


def is_blank(point: ServerState) -> bool:
    """Whether a point only says how far turns were counted before this life: there is no state to go back to."""
    return not point.data.size


def stands_at(points: RewindPoints, turn: int, *, live: bool) -> bool:
    """Whether the point is the state after this turn."""
    point = points.point
    return point is not None and point.turn == turn and point.live == live and not points.tail and not is_blank(point)


def needs_point(points: RewindPoints, *, is_lazy: bool, live: bool) -> bool:
    """Whether the state is to be captured behind the part that has just been handed over.

    Where outcomes come out the same each time (`is_lazy`), what was handed over since the point can as well be handled
    again, as long as that is little.
    """
    point = points.point
    return not is_lazy or point is None or len(points.tail) >= MOST_TAIL or point.live != live


def takes_delta(points: RewindPoints) -> bool:
    """Whether what has changed is kept on top of the point; else all of the state is taken."""
    point = points.point
    if point is None or is_blank(point) or point.stash_ids:
        return False
    return len(point.deltas) < MOST_DELTAS and points.delta_bytes <= max(COMPACT_BYTES, point.data.size)


def before_turn(points: RewindPoints, number: int, turn: int) -> tuple[ServerState, list[Request]] | None:
    """Find a state before this turn, and the requests from there up to this one; None if that is not known any more."""
    kept = [(points.point, [one for one, _ in points.tail])]
    if points.previous is not None:
        kept.append(points.previous)
    for before, requests in kept:
        numbers = [one.feed.id for one in requests]
        if before is not None and before.turn < turn and number in numbers and not is_blank(before):
            return before, requests[: numbers.index(number) + 1]
    return None


def change_since(points: RewindPoints, turn: int) -> StateDelta | None:
    """Find what leads to the point from the one after an earlier turn; None if all of the point is no more than that.

    It leads on from the point that another replica was given last, or from the one before the last part.
    """
    point = points.point
    assert point is not None
    if turn <= points.untraced:
        return None
    patch, deltas = None, point.deltas
    timers: dict[str, Clock] | None = point.timers
    at = _place_of(points, turn, point)
    if at is not None:
        deltas = point.deltas[at:]
    else:
        before = None if points.previous is None else points.previous[0]
        base = next((one for one in (points.given, before) if one is not None and one.turn == turn), None)
        if base is None:
            return None
        timers = None if base.timers is point.timers else point.timers
        if base.data is point.data and _begins_with(point.deltas, base.deltas):  # It was taken back meanwhile.
            deltas = point.deltas[len(base.deltas) :]
        elif point.data.size <= BLOCK:
            return None
        else:
            patch = make_patch(base.data, point.data)
    return StateDelta(
        point.turn, turn, patch, deltas, checksum(deltas), point.stash, point.returned, point.live, point.stash_ids,
        point.traps, point.absent, timers,
    )  # fmt: skip


def _place_of(points: RewindPoints, turn: int, point: ServerState) -> int | None:
    """Find the first of the point's deltas that this turn has not got, if only deltas are missing there."""
    marks = points.marks
    if turn == point.turn:
        return len(point.deltas)
    if marks and marks[-1] == turn:
        return len(marks) - 1
    return marks.index(turn) if turn in marks else None


def _begins_with(parts: list[bytes], first: list[bytes]) -> bool:
    return len(first) <= len(parts) and all(map(is_, first, parts))


def led_to(point: ServerState | None, state: ServerState | StateDelta) -> ServerState:
    """Work out the state that another replica has said; the point that is here stays as it is.

    Raises:
        Misfit, DamagedValue: these are differences to something that is not here, or it has come damaged.
    """
    if isinstance(state, ServerState):
        state.data.check()
        return state
    if point is None or point.turn != state.base:
        raise Misfit(f"it is to turn {state.base}, and turn {-1 if point is None else point.turn} is here")
    if checksum(state.deltas) != state.check:
        raise Misfit("its deltas have come damaged")
    data, deltas = point.data, [*point.deltas, *state.deltas]
    if state.patch is not None:
        data, deltas = state.patch.applied(point.data), state.deltas
    return ServerState(
        state.turn, data, deltas, state.stash, state.returned, state.live, state.stash_ids, state.traps, state.absent,
        timers=point.timers if state.timers is None else state.timers,
    )  # fmt: skip
