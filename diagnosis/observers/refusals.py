"""Whose refusals make the turns of others come to nothing."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Collection
from typing import NamedTuple

from ...actors.events import DeadLetter
from ...actors.kernel.message import Refusal
from ...supervision.intensity import recent_restarts


class _Refused(NamedTuple):
    """An actor was refused something: with what, by whom in the end, and when."""

    error: Refusal
    by: str
    when: float


@dataclasses.dataclass(frozen=True)
class Refusals:
    """Keeps who was refused what, and which turns have come to nothing by it.

    A refusal is an answer, and no fault. But where one who used to answer otherwise only refuses any more, and turns of
    those who were told something come to nothing by it, it is at fault, and not they. A refusal that an actor passes on
    is that of whom it had asked.

    Args:
        recent: seconds after a refusal in which it may end a turn.
        within: seconds for which such an end counts.
    """

    recent: float
    within: float
    last: dict[str, _Refused] = dataclasses.field(default_factory=dict[str, _Refused])
    """The newest refusal that each actor got."""
    ended: defaultdict[str, tuple[float, ...]] = dataclasses.field(default_factory=lambda: defaultdict(tuple))
    """When turns have come to nothing by refusals of each, since it has answered otherwise."""
    answering: set[str] = dataclasses.field(default_factory=set[str])
    """Who was seen to answer otherwise."""

    def take(self, asker: str | None, by: str, error: Refusal, now: float) -> None:
        """An ask was refused."""
        passed_on = self.last.get(by)
        if passed_on is not None and passed_on.error == error and now - passed_on.when <= self.recent:
            by = passed_on.by
        if asker is not None:
            self.last[asker] = _Refused(error, by, now)

    def take_end(self, whose: str, letter: DeadLetter, now: float) -> None:
        """Nobody handles a message that one was told: perhaps because its turn was refused what it needed."""
        refused = self.last.get(whose)
        if refused is not None and now - refused.when <= self.recent and letter.why == f"refused: {refused.error}":
            self.ended[refused.by] = (*self.ended[refused.by], now)

    def answers(self, component: str) -> None:
        """It has answered otherwise."""
        self.answering.add(component)
        self.ended.pop(component, None)

    def count(self, component: str, now: float) -> int:
        """Turns of others that came to nothing by its refusals of late; none if it was never seen to do otherwise."""
        if component not in self.ended or component not in self.answering:
            return 0
        self.ended[component] = recent_restarts(self.ended[component], now, self.within)
        return len(self.ended[component])

    def forget(self, names: Collection[str]) -> None:
        """What these have refused says nothing any more."""
        for name in names:
            self.ended.pop(name, None)
