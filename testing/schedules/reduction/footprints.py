"""Footprints: what one step of a run has read and changed. Two steps whose footprints do not meet may change places."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from typing import Final, NamedTuple

Token = Hashable
"""Something that steps share: the memory of an actor, the end of its mailbox, a future, a lane of the loop."""

EVERYTHING: Final = "everything"
"""Read by each step that does anything, and changed by those whose effects are not known."""
PROGRAM: Final = "the program"
"""The memory of the test and its tasks, and of actors that share some with it or with each other."""
LIBRARY: Final = "the library"
"""The memory of the library's own tasks: stores, journals, processes."""


class Footprint(NamedTuple):
    """What a step has touched."""

    reads: frozenset[Token] = frozenset()
    writes: frozenset[Token] = frozenset()

    def meets(self, other: Footprint) -> bool:
        """Whether the order of two steps with these footprints may make a difference."""
        return not (
            self.writes.isdisjoint(other.writes)
            and self.writes.isdisjoint(other.reads)
            and self.reads.isdisjoint(other.writes)
        )


NOTHING: Final = Footprint()


class NotedStep(NamedTuple):
    """One step of a run.

    Attributes:
        owner: whose step it is: an actor, a task, a timer, a lane.
        enabled_by: the numbers of the steps without which it could not have come.
        since: the number of the first step that could have changed places with it: all before have ended a moment.
    """

    owner: Hashable
    footprint: Footprint
    enabled_by: frozenset[int] = frozenset()
    since: int = 0


class Race(NamedTuple):
    """Two steps that could have come in the other order, with another outcome perhaps.

    Attributes:
        first, second: their numbers.
        initials: whose step can be taken in place of the first one, so that the second one comes before it.
    """

    first: int
    second: int
    initials: frozenset[Hashable]


class _Accesses:
    """Who has touched a token last."""

    __slots__ = ("readers", "writer")

    def __init__(self) -> None:
        self.writer = -1
        self.readers: list[int] = []


def races(steps: list[NotedStep], begin: int = 0) -> Iterator[Race]:
    """All pairs of steps that meet, with nothing between them that orders them; the second one from `begin` on.

    Source: source sets: Abdulla, Aronis, Jonsson, Sagonas, POPL 2014.

    >>> one, other = (NotedStep(owner, Footprint(writes=frozenset({"x"}))) for owner in "pq")
    >>> list(races([one, other]))
    [Race(first=0, second=1, initials=frozenset({'q'}))]
    """
    before: list[int] = []  # of each step: those that had to come before it, as bits
    accesses: dict[Token, _Accesses] = {}
    latest: dict[Hashable, int] = {}
    for number, step in enumerate(steps):
        ordered = (1 << step.since) - 1
        own = latest.get(step.owner)
        for earlier in (*step.enabled_by, *(() if own is None else (own,))):
            ordered |= before[earlier] | 1 << earlier
        latest[step.owner] = number
        for earlier in sorted(_met(step.footprint, accesses), reverse=True):
            if not ordered >> earlier & 1:
                if number >= begin:
                    yield Race(earlier, number, _initials(steps, before, earlier, number, ordered))
                ordered |= before[earlier] | 1 << earlier
        before.append(ordered)
        _note(number, step.footprint, accesses)


def _met(footprint: Footprint, accesses: dict[Token, _Accesses]) -> set[int]:
    """The latest steps that one with this footprint meets; those before have to do with it only through them."""
    found: set[int] = set()
    for token in footprint.reads:
        if token in accesses:
            found.add(accesses[token].writer)
    for token in footprint.writes:
        if token in accesses:
            found.update((accesses[token].writer, *accesses[token].readers))
    found.discard(-1)
    return found


def _note(number: int, footprint: Footprint, accesses: dict[Token, _Accesses]) -> None:
    for token in footprint.writes:
        access = accesses.setdefault(token, _Accesses())
        access.writer, access.readers = number, []
    for token in footprint.reads - footprint.writes:
        accesses.setdefault(token, _Accesses()).readers.append(number)


def _initials(steps: list[NotedStep], before: list[int], first: int, second: int, ordered: int) -> frozenset[Hashable]:
    """Whose step may come first among those that need not come behind the first of the two."""
    found: set[Hashable] = set()
    rest = 0  # those between the two that do not depend on the first
    for number in range(first + 1, second):
        if not before[number] >> first & 1:
            if not before[number] & rest:
                found.add(steps[number].owner)
            rest |= 1 << number
    if not ordered & rest:
        found.add(steps[second].owner)
    return frozenset(found)
