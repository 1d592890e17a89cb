"""Pages of the history: what a question about past events is answered with, and how one goes on from there."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import SpecError
from .past_event import PastEvent
from .paths import matcher
from .ring import N

if TYPE_CHECKING:
    from .recorder import HistoryRecorder

MOST_ON_PAGE = 1_000
"""Events on one page, at most."""
PAGE_BYTES = 2 * 1024 * 1024
"""Bytes that the events of a page may have together, about; a single larger one is given all the same."""


class HistoryPage(msgspec.Struct, frozen=True):
    """Past events in the order in which they were told.

    Attributes:
        events: those that were asked for, oldest first.
        next: give this as `after` for the events behind these, also for those that are still to come.
        oldest: the smallest number of an event that is still kept; 0 if there is none.
        dropped: events that were dropped since the system started, because there were too many.
    """

    events: list[PastEvent]
    next: int
    oldest: int = 0
    dropped: int = 0


class HistoryQuestion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question about past events.

    Attributes:
        path: an address, or a pattern of addresses, as `paths.py` has it.
        kinds: classes of events by name; empty: all.
        since, until: Unix times.
        after: only events with larger numbers, the oldest of them first; None: the newest ones.
        limit: events at most.
    """

    path: str = "**"
    kinds: tuple[str, ...] = ()
    since: float = 0.0
    until: float = float("inf")
    after: int | None = None
    limit: int = MOST_ON_PAGE


def question(
    path: str = "**",
    *,
    kinds: Sequence[str] = (),
    since: float = 0.0,
    until: float = float("inf"),
    after: int | None = None,
    limit: int = MOST_ON_PAGE,
) -> HistoryQuestion:
    """A question, checked.

    Raises:
        SpecError: it cannot be asked so.
    """
    if isinstance(kinds, str) or not all(isinstance(kind, str) for kind in kinds):
        raise SpecError("history", f"kinds must be names of events, such as ['ActorCrashed'], not {kinds!r}")
    check_page("history", after=after, limit=limit, since=since, until=until)
    matcher(path)
    return HistoryQuestion(path, tuple(kinds), float(since), float(until), after, limit)


def check_page(where: str, *, after: object, limit: object, **times: object) -> None:
    """Check what every question for a page has: where it begins, how much is on it, and from which time that is.

    Raises:
        SpecError: a value is of the wrong type, or out of range.
    """
    if isinstance(limit, bool) or not isinstance(limit, int) or not 1 <= limit <= MOST_ON_PAGE:
        raise SpecError(where, f"limit must be an int from 1 to {MOST_ON_PAGE}, not {limit!r}")
    if after is not None and (isinstance(after, bool) or not isinstance(after, int)):
        raise SpecError(where, f"after must be a number from a page's `next`, not {after!r}")
    for name, value in times.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value:
            raise SpecError(where, f"{name} must be a Unix time, not {value!r}")


def answer(recorder: HistoryRecorder, asked: HistoryQuestion) -> HistoryPage:
    """The page that answers a question."""
    is_meant, kinds = matcher(asked.path), frozenset(asked.kinds)
    number = -1 if asked.after is None else asked.after
    found = (
        event
        for event in recorder.after(number)
        if (not kinds or event.kind in kinds) and asked.since <= event.at <= asked.until and is_meant(event.address)
    )
    if asked.after is None:
        return HistoryPage(newest_of(found, asked.limit), recorder.last, recorder.oldest, recorder.dropped)
    events, is_all = oldest_of(found, asked.limit)
    return HistoryPage(events, recorder.last if is_all else events[-1].number, recorder.oldest, recorder.dropped)


def newest_of(found: Iterable[N], limit: int) -> list[N]:
    """The last `limit` of them, as far as a page has room for these."""
    kept: deque[N] = deque(found, maxlen=limit)
    size = sum(event.size_bytes for event in kept)
    while size > PAGE_BYTES and len(kept) > 1:
        size -= kept.popleft().size_bytes
    return list(kept)


def oldest_of(found: Iterable[N], limit: int) -> tuple[list[N], bool]:
    """The first `limit` of them, as far as a page has room for these, and whether there are no others."""
    kept: list[N] = []
    size = 0
    for event in found:
        size += event.size_bytes
        if len(kept) == limit or (kept and size > PAGE_BYTES):
            return kept, False
        kept.append(event)
    return kept, True
