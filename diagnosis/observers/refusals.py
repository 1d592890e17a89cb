"""Whose refusals make the turns of others come to nothing."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Collection
from typing import Final, NamedTuple

from ...actors.events import REFUSED, DeadLetter
from ...actors.kernel.message import Refusal
from ...supervision.intensity import recent_restarts

ENOUGH: Final = 20
"""Looks at which an actor must have answered otherwise before its refusals say anything."""
LEAST: Final = 10
"""Refusals in a row that say nothing, whatever was usual."""
LONGER: Final = 4
"""Times the longest row of refusals that has ended, after which one is too long."""
TURNS: Final = 3
"""Turns of others that have come to nothing within `WITHIN` seconds."""
WITHIN: Final = 10.0


class _Refused(NamedTuple):
    """An actor was refused something: with what, by whom in the end, and when."""

    error: Refusal
    by: str
    when: float


@dataclasses.dataclass(slots=True)
class _Record:
    """What one actor has answered."""

    run: int = 0
    """Times that it has refused since it answered otherwise."""
    longest: int = 0
    """Most times that it has ever refused before it answered otherwise."""
    others: int = 0
    """Looks at which it had answered otherwise."""
    ended: tuple[float, ...] = ()
    """When turns of others have come to nothing by its refusals, in this run."""


class Refusals:
    """Keeps who was refused what, and which turns have come to nothing by it.

    A refusal is an answer, and no fault. But where one only refuses any more, four times as often as it ever did before
    it answered otherwise, and turns of those who were told something come to nothing by it, it is at fault, and not
    they. A refusal that an actor passes on is that of whom it had asked.

    Args:
        recent: seconds after a refusal in which it may end a turn.
    """

    def __init__(self, recent: float) -> None:
        self._recent = recent
        self._last: dict[str, _Refused] = {}  # the newest refusal that each actor got
        self._records = defaultdict[str, _Record](_Record)

    def take(self, asker: str | None, by: str, error: Refusal, now: float) -> None:
        """An ask was refused: by whom it was answered, or by whoever refused that one the same."""
        passed_on = self._last.get(by)
        if passed_on is not None and passed_on.error == error and now - passed_on.when <= self._recent:
            by = passed_on.by
        else:
            self._records[by].run += 1
        if asker is not None:
            self._last[asker] = _Refused(error, by, now)

    def take_end(self, whose: str, letter: DeadLetter, now: float) -> None:
        """Nobody handles a message that one was told: perhaps because its turn was refused what it needed."""
        refused = self._last.get(whose)
        if refused is not None and now - refused.when <= self._recent and letter.why == f"{REFUSED}{refused.error}":
            record = self._records[refused.by]
            record.ended = (*recent_restarts(record.ended, now, WITHIN), now)

    def answers(self, component: str) -> None:
        """A component has answered something other than a refusal."""
        record = self._records[component]
        record.others += 1
        record.longest, record.run, record.ended = max(record.longest, record.run), 0, ()

    def lets_down(self, component: str, now: float) -> bool:
        """Whether it only refuses any more, and turns of others come to nothing by that."""
        record = self._records.get(component)
        if record is None or record.others < ENOUGH or record.run <= max(LEAST, LONGER * record.longest):
            return False
        return len(recent_restarts(record.ended, now, WITHIN)) >= TURNS

    def forget(self, names: Collection[str]) -> None:
        """What these have refused says nothing any more."""
        for record in (record for name, record in self._records.items() if name in names):
            record.run, record.ended = 0, ()
