"""Pages of last lines: what a question about them is answered with, and how one goes on from there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from ...actors.errors import SpecError
from ..history.pages import MOST_ON_PAGE, check_page, newest_of, oldest_of
from ..history.paths import matcher
from .line_memory import LEVELS, LineLevel, LineMemory, LoggedLine

PARTS: Final = "/ftm/"
"""What stands between the address of a protected actor and the names of its replicas."""


class LogPage(msgspec.Struct, frozen=True):
    """Last lines in the order in which they came.

    Attributes:
        lines: those that were asked for, oldest first.
        next: give this as `after` for the lines behind these, also for those that are still to come.
        dropped: lines between `after` (or the first of all) and `next` that had given way to newer ones before they
            were asked for, of any level. If the lines of many actors came in turn rather too many are counted.
    """

    lines: list[LoggedLine]
    next: int
    dropped: int = 0


class LogQuestion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question about last lines.

    Attributes:
        path: an address, or a pattern of addresses. The lines of its replicas are those of a protected actor.
        level: of the least grave lines that are meant.
        since: Unix time.
        after: only lines with larger numbers, the oldest of them first; None: the newest ones.
        limit: lines at most.
    """

    path: str = "**"
    level: LineLevel = "debug"
    since: float = 0.0
    after: int | None = None
    limit: int = MOST_ON_PAGE


def log_question(
    path: str = "**",
    *,
    level: str = "debug",
    since: float = 0.0,
    after: int | None = None,
    limit: int = MOST_ON_PAGE,
) -> LogQuestion:
    """A question about last lines, checked.

    Raises:
        SpecError: it cannot be asked so.
    """
    check_page("logs", after=after, limit=limit, since=since)
    known: list[LineLevel] = [one for one in LEVELS if one == level]
    if not known:
        raise SpecError("logs", f"level must be one of {', '.join(LEVELS)}, not {level!r}")
    matcher(path)
    return LogQuestion(path, known[0], float(since), after, limit)


def answer_lines(memory: LineMemory, asked: LogQuestion) -> LogPage:
    """The page that answers a question."""
    is_meant, least = _meant(asked.path), LEVELS.index(asked.level)
    number = asked.after or 0
    if number > memory.last:  # It is a number of the program before this one.
        number = 0
    found = (
        line for line in memory.after(number, is_meant) if line.at >= asked.since and LEVELS.index(line.level) >= least
    )
    if asked.after is None:
        lines, until = newest_of(found, asked.limit), memory.last
    else:
        lines, is_all = oldest_of(found, asked.limit)
        until = memory.last if is_all else lines[-1].number
    return LogPage(lines, until, memory.dropped(number, until, is_meant))


def _meant(path: str) -> Callable[[str], bool]:
    """A test for the addresses that a question is about; the replicas of an actor belong to it."""
    matches = matcher(path)
    return lambda address: matches(address) or (PARTS in address and matches(address.partition(PARTS)[0]))
