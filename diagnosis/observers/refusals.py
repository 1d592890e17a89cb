"""Whose refusals let others down: one who only refuses any more, so that turns of those who ask come to nothing."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Collection
from typing import NamedTuple

from ...actors.errors import type_name
from ...actors.events import ActorCrashed, DeadLetter
from ...actors.exit_reasons import Crash
from ...actors.kernel.message import Refusal


class _Refused(NamedTuple):
    """An actor was refused something: with what, by whom in the end, and when."""

    error: Refusal
    by: str
    when: float


class _Ended(NamedTuple):
    """A turn has ended by a refusal: whose, when, and whether it was a crash."""

    whose: str
    when: float
    is_crash: bool


@dataclasses.dataclass(frozen=True)
class Refusals:
    """Keeps who was refused what, and which turns have ended by it.

    A refusal is an answer, and no fault. But where one who used to answer only refuses any more, and turns of those who
    ask end by it, it is that one, and not they. As soon as it answers otherwise, their crashes are their own. A refusal
    that an actor passes on is that of whom it had asked.

    Args:
        recent: seconds for which a turn may end by a refusal.
        within: seconds for which the end of a turn counts.
    """

    recent: float
    within: float
    last: dict[str, _Refused] = dataclasses.field(default_factory=dict[str, _Refused])
    ended: defaultdict[str, list[_Ended]] = dataclasses.field(default_factory=lambda: defaultdict(list))
    answering: set[str] = dataclasses.field(default_factory=set[str])
    """Who was seen to answer otherwise."""

    def take(self, asker: str | None, by: str, error: Refusal, now: float) -> None:
        """An ask was refused."""
        passed_on = self.last.get(by)
        if passed_on is not None and passed_on.error == error and now - passed_on.when <= self.recent:
            by = passed_on.by
        if asker is not None:
            self.last[asker] = _Refused(error, by, now)

    def take_end(self, whose: str, event: ActorCrashed | DeadLetter, now: float) -> bool:
        """A turn has ended in an error. Returns whether that is laid to one who has refused."""
        refused = self.last.get(whose)
        if refused is None or now - refused.when > self.recent or refused.by not in self.answering:
            return False
        is_crash = isinstance(event, ActorCrashed)
        if is_crash:
            is_its_end = isinstance(event.reason, Crash) and event.reason.type_name == type_name(type(refused.error))
        else:
            is_its_end = event.why == f"refused: {refused.error}"
        if is_its_end:
            self.ended[refused.by].append(_Ended(whose, now, is_crash))
        return is_its_end

    def answers(self, component: str) -> list[tuple[str, float]]:
        """It has answered otherwise. Returns whose crashes were laid to it since, and are their own, and when."""
        self.answering.add(component)
        return [(one.whose, one.when) for one in self.ended.pop(component, ()) if one.is_crash]

    def ended_by(self, component: str, now: float) -> int:
        """How many turns of others have ended by its refusals of late."""
        if component not in self.ended:
            return 0
        self.ended[component] = [one for one in self.ended[component] if now - one.when <= self.within]
        return len(self.ended[component])

    def forget(self, names: Collection[str]) -> None:
        """What these have refused says nothing any more."""
        for name in names:
            self.ended.pop(name, None)
