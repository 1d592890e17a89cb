"""The check of an upgrade, for one address: do its recorded turns go with new code as they went before?

From each kept snapshot on, a life of the new code handles the recorded turns again, up to the next snapshot or to the
end. Replies and outputs are compared turn by turn, states at each snapshot, and turn by turn where the store has their
digests (`check_replay`).
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Final, Literal

from ...actors.errors import DIVERGES, HoldfastError, ReplayDiverged, StartFailed
from ...actors.kernel.actor import Actor
from ..home.homes import Homes
from ..inputs import spread
from ..journal import Entry
from ..protocol import Feed
from ..snapshot.snapshot_record import Meta
from .kept_lives import KeptLife, kept_lives, lives_of, state_differences
from .rerun import LifeEnded, NotRecorded, Recipe, Rerun

Verdict = Literal["fine", "ended", "differs", "refused", "missing", "unchecked"]
DIFFERENT: Final = ("differs", "refused", "missing")
"""The verdicts that say that the new code does not go on as the old one would."""


@dataclasses.dataclass(frozen=True, slots=True)
class AddressCheck:
    """What became of the recorded turns of one address.

    Attributes:
        address: whose.
        verdict: "fine"; "ended": its supervisor does not bring it back, and it was not checked; "differs": a turn, or a
            state, is not what it was; "refused": the new code would not be started on what is recorded, or could not
            handle what waits; "missing": the new program has no such address; "unchecked": it could not be found out.
        turns: so many were handled again, as before.
        turn: the first one that differs; -1: none, or it is no matter of a turn.
        message: the type of its message, or the kind of its input.
        problem: in words; "" if there is none.
        note: what else is worth knowing.
    """

    address: str
    verdict: Verdict
    turns: int = 0
    turn: int = -1
    message: str = ""
    problem: str = ""
    note: str = ""

    @property
    def is_fine(self) -> bool:
        """Say whether nothing is known against the new code at this address, and nothing was left to be checked."""
        return self.verdict in ("fine", "ended")


async def check_address(
    homes: Homes, path: str, recipe: Recipe, on_turn: Callable[[int, Feed], None] = lambda turn, feed: None
) -> AddressCheck:
    """Have new code handle again what is recorded of an address, and compare.

    Args:
        homes: of a copy of the store, by themselves (`apart`).
        path: the address.
        recipe: how the new program starts the actor there.
        on_turn: is told of each turn that begins.
    """
    try:
        lives = kept_lives(homes, path)
    except HoldfastError as error:
        return AddressCheck(path, "unchecked", problem=str(error))
    lives, replaced = lives_of(lives, recipe.start.kind)
    if not recipe.method.replays:
        lives = lives[-1:]
    check = _Checking(homes, path, recipe, on_turn)
    for number, life in enumerate(lives):
        following = lives[number + 1] if number + 1 < len(lives) else None
        found = await check.from_snapshot(life, following)
        if found is not None:
            return found
    return AddressCheck(path, "fine", check.turns, note="; ".join(filter(None, (replaced, check.note))))


def _has_digest(entry: Entry) -> bool:
    """Whether an entry says what state a turn has left."""
    match entry:
        case ("end", _, _, _, _, digest, *_) | ("in", _, _, _, _, _, _, _, _, _, digest, *_):
            return bool(digest)
        case _:
            return False


class _Checking:
    def __init__(self, homes: Homes, path: str, recipe: Recipe, on_turn: Callable[[int, Feed], None]) -> None:
        self._homes, self._path, self._recipe, self._on_turn = homes, path, recipe, on_turn
        self.turns = 0
        self.note = "" if recipe.method.replays else f"{recipe.method.name} handles nothing again"

    async def from_snapshot(self, life: KeptLife, following: KeptLife | None) -> AddressCheck | None:
        """Check the turns behind one snapshot, up to the following one; None: all is fine."""
        self.note = life.saved.passed_over or self.note
        recipe = self._recipe
        has_digests = any(_has_digest(one) for _, entry in life.saved.entries for one in spread(entry))
        if recipe.method.replays and has_digests != recipe.method.check_replay:
            recipe = recipe._replace(method=dataclasses.replace(recipe.method, check_replay=has_digests))
        try:
            rerun = Rerun(self._homes, self._path, recipe, life.saved, self._on_turn)
        except HoldfastError as error:
            return AddressCheck(self._path, "unchecked", problem=str(error))
        before = self.turns
        try:
            return await self._lived(rerun, following)
        except StartFailed as error:
            return AddressCheck(self._path, "refused", self.turns, problem=error.reason)
        except NotRecorded as error:
            return AddressCheck(self._path, "unchecked", self.turns, problem=str(error))
        except ReplayDiverged as error:
            return self._differs(rerun, before, _said(error))
        except LifeEnded as error:
            if rerun.turn < 0:
                return AddressCheck(self._path, "refused", self.turns, problem=error.why)
            return self._differs(rerun, before, error.why)
        finally:
            with contextlib.suppress(TimeoutError):
                await rerun.close()

    def _differs(self, rerun: Rerun, before: int, problem: str) -> AddressCheck:
        feed = rerun.feed
        message = "" if feed is None else feed.name or feed.kind
        turns = before + sum(number < rerun.turn for number, _ in rerun.turns)
        return AddressCheck(self._path, "differs", turns, rerun.turn, message, problem)

    async def _lived(self, rerun: Rerun, following: KeptLife | None) -> AddressCheck | None:
        rerun.begin()
        if self._recipe.method.replays:
            meta = None if following is None else following.meta
            turns = [one for one in rerun.turns if meta is None or one[0] <= meta.turn]
            await rerun.live(turns)
            self.turns += len(turns)
            if meta is not None:
                return self._compare(rerun, meta)
            if await rerun.live_begun():
                self.note = f"turn {rerun.turn} has no end, and is checked as far as it had come"
        problem = rerun.unreadable()
        return AddressCheck(self._path, "refused", self.turns, problem=problem) if problem else None

    def _compare(self, rerun: Rerun, following: Meta) -> AddressCheck | None:
        """Compare the state with that of the following snapshot, to which the turns led."""
        if following.is_replaced or following.base != following.turn or not following.state:
            return None  # It was put in place from outside, or turns were undone: these do not lead to it.
        if type(rerun.actor).on_recovered is not Actor.on_recovered:
            self.note = "its states are not compared: on_recovered may have changed them, and is not called here"
            return None
        try:
            found = state_differences(rerun.actor, following.state)
        except HoldfastError as error:
            found = [f"it cannot be compared: {error}"]
        if not found:
            return None
        problem = f"the state after it is not that of the snapshot: {'; '.join(found)}"
        return dataclasses.replace(self._differs(rerun, self.turns, problem), turns=self.turns, turn=following.turn)


def _said(error: ReplayDiverged) -> str:
    """What a replayed turn has done, without whose and which one it was."""
    cause = error.cause.removesuffix(f"; {DIVERGES}").removesuffix(f" ({DIVERGES})")
    if cause:
        return cause.replace("before the crash", "before")
    return f"output {error.output}" + (f" ({error.what})" if error.what else "") + " is not what it was before"
