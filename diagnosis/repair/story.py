"""The story of a case: each notice of repair as one plain sentence, with its time."""

from __future__ import annotations

from ...actors.kernel.message import Message
from . import notices as say
from .notices import Story, StoryEntry

MOST_CASES = 50
"""Cases that are remembered."""
MOST_ENTRIES = 200
"""Sentences of one case."""


class Stories:
    """What was told of each of the last cases."""

    def __init__(self) -> None:
        self._cases: dict[int, list[StoryEntry]] = {}

    def add(self, case: int, entry: StoryEntry) -> None:
        """One more sentence; of a long case the first and the newest are kept."""
        entries = self._cases.setdefault(case, [])
        entries.append(entry)
        if len(entries) > MOST_ENTRIES:
            del entries[1]
        if len(self._cases) > MOST_CASES:
            del self._cases[next(iter(self._cases))]

    def told(self) -> tuple[Story, ...]:
        """All of them, the oldest case first."""
        return tuple(Story(case, tuple(entries)) for case, entries in self._cases.items())


def sentence(notice: Message) -> str:
    """A notice in plain words; empty if it is not for people.

    >>> sentence(say.Held(3, "the observations are contradictory"))
    'Repair waits: the observations are contradictory.'
    """
    match notice:
        case say.RepairBegan(_, bad, symptoms):
            return f"{_names(bad)} {_is(bad)} suspected, because {_names(map(str, symptoms))} was observed."
        case say.Planned(_, bad, stages, _, is_dry):
            steps = ", then ".join(_names(map(str, stage)) for stage in stages)
            return f"For {_names(bad)} repair {'would do' if is_dry else 'will do'} {steps}."
        case say.ApprovalWanted(case, steps, reason, seconds):
            what = _names(map(str, steps))
            return f"{what} waits {seconds:g} s for `holdfast repair approve {case}` or `deny {case}` ({reason})."
        case say.ActionBegan(_, step):
            return f"{step} has begun."
        case say.ActionEnded(_, step, outcome, why):
            return f"{step} {outcome}: {why}." if why else f"{step} is {outcome}."
        case say.Undone(_, step, why):
            return f"{step} was undone: {why}."
        case say.Held(_, why):
            return f"Repair waits: {why}."
        case say.Repaired(_, actions, seconds):
            by = f" by {_names(map(str, actions))}" if actions else " by themselves"
            return f"The symptoms went{by} within {seconds:.1f} s."
        case say.AdviceScored(_, verdict, seconds):
            saved = f", which came {seconds:.1f} s before somebody did it" if seconds else ""
            return f"The fault has gone; the advice was {verdict}{saved}."
        case say.GaveUp(_, components, _, why, _, _, plan):
            whom = _names(components) if components else "the fault"
            tried = f" A person should try: {'; '.join(plan)}." if plan else ""
            return f"Repair has given up {whom}: {why}.{tried}"
        case _:
            return ""


def about(notice: Message) -> tuple[str, ...]:
    """The components that a notice is about; none: it is about the case."""
    match notice:
        case say.RepairBegan(_, bad) | say.Planned(_, bad):
            return bad
        case say.ActionBegan(_, step) | say.ActionEnded(_, step) | say.Undone(_, step):
            return step.args[:1]
        case say.ApprovalWanted(_, steps) | say.Repaired(_, steps):
            return tuple(dict.fromkeys(name for step in steps for name in step.args[:1]))
        case say.GaveUp(_, components):
            return components
        case _:
            return ()


def _names(names: object) -> str:
    words = [str(one) for one in names]  # type: ignore[attr-defined]  # any iterable of names
    return " and ".join((", ".join(words[:-1]), words[-1])) if len(words) > 1 else "".join(words) or "nothing"


def _is(names: tuple[str, ...]) -> str:
    return "is" if len(names) == 1 else "are"
