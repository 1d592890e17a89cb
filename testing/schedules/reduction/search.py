"""The exhaustive search: one schedule of each kind, where two are of one kind if they differ only in the order of
steps that have nothing to do with each other.

Source: dynamic partial-order reduction: Flanagan, Godefroid, POPL 2005; with source sets and sleep sets: Abdulla,
Aronis, Jonsson, Sagonas, POPL 2014.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Final

from ..choices import Choices, Keys
from .footprints import NOTHING, Footprint, Step, races

if TYPE_CHECKING:
    from .watch import Watch


SEED: Final = 0
"""Of all schedules of a search: what is drawn must be the same where two of them begin alike."""


class Point:
    """A point of the search tree, from which one step was taken.

    Attributes:
        options: who could have the step.
        asleep: those that need not be tried here (any more), with what their steps touch.
        wanted: those that are to be tried.
        taken: who has the step in the present run.
    """

    def __init__(self, options: tuple[Hashable, ...], asleep: dict[Hashable, Footprint], taken: Hashable) -> None:
        self.options, self.asleep, self.taken = options, asleep, taken
        self.wanted = [taken]
        self.step = Step(taken, NOTHING)

    def want(self, initials: frozenset[Hashable]) -> None:
        """Have one of these tried here, if none is."""
        if initials.isdisjoint(self.wanted) and initials.isdisjoint(self.asleep):
            found = [name for name in self.options if name in initials]
            self.wanted += found[:1] or [name for name in self.options if name not in self.wanted]

    def advance(self) -> bool:
        """Go on to the next that is to be tried; False: there is none."""
        self.asleep[self.taken] = self.step.footprint
        left = [name for name in self.wanted if name not in self.asleep]
        if left:
            self.taken = left[0]
        return bool(left)


class Exhaustive:
    """Depth first through all schedules."""

    def __init__(self) -> None:
        self.path: list[Point] = []
        self._is_over = False
        self.cut = 0

    def choices(self, seed: int) -> Choices | None:
        return None if self._is_over else Explored(SEED, self.path)

    def learn(self, choices: Choices, trace: Sequence[tuple[str, str]]) -> None:
        assert isinstance(choices, Explored)
        choices.end()
        self.cut += choices.is_redundant
        path = self.path
        choices.order_lanes()
        for race in races([point.step for point in path], choices.known - 1):
            path[race.first].want(race.initials)
        while path and not path[-1].advance():
            path.pop()
        self._is_over = not path


class Explored(Choices):
    """One path of the search: repeated as far as it is known, then the first that does not sleep."""

    def __init__(self, seed: int, path: list[Point]) -> None:
        super().__init__(seed)
        self.watch: Watch | None = None
        self.known = len(path)
        self.number = -1
        self.is_redundant = False
        self._path = path
        self._options: tuple[Hashable, ...] = ()
        self._touched: Callable[[], Footprint] = lambda: NOTHING
        self._needs: set[int] = set()
        self._since = self._moment = 0
        self._is_over = False
        self._lanes: dict[Hashable, list[tuple[int, int]]] = {}

    def choose(self, count: int, keys: Keys) -> int:
        if self._is_over:
            return 0
        assert self.watch is not None
        options = self._options = _distinct(map(self.watch.name, keys()))
        number = self.number + 1
        if number < self.known:
            taken = self._path[number].taken
            return options.index(taken) if taken in options else 0
        asleep = self._asleep(number)
        for index, name in enumerate(options):
            if name not in asleep:
                return index
        self.is_redundant = True
        self.end()
        return 0

    def _asleep(self, number: int) -> dict[Hashable, Footprint]:
        """Whose order against the last step does not matter, of those that slept before it."""
        if not number:
            return {}
        last, touched = self._path[number - 1], self._touched()
        return {name: other for name, other in last.asleep.items() if name != last.taken and not touched.meets(other)}

    def begin(self, owner: Hashable, touched: Callable[[], Footprint], enabled_by: set[int]) -> None:
        """The next step begins; `touched` says what the present one has touched."""
        if self._is_over:
            return
        self._close()
        options, self._options = self._options or (owner,), ()
        number = self.number + 1
        if number >= self.known:
            asleep = self._asleep(number)
            if owner in asleep:  # It was no choice, and need not come again.
                self.is_redundant = True
                self.end()
                return
            self._path.append(Point(options, asleep, owner))
        self.number = number
        self._touched, self._needs, self._since = touched, set(enabled_by), self._moment

    def keep_place(self, lane: Hashable, made: int) -> None:
        """The present step is that of a callback which keeps its place in a lane, since the step that has made it."""
        self._lanes.setdefault((lane, self._moment), []).append((made, self.number))

    def order_lanes(self) -> None:
        """Who schedules two callbacks of a lane says in which order they come: that matters if they meet."""
        path = self._path
        for lane, callbacks in self._lanes.items():
            for (made, number), (later, other) in itertools.combinations(callbacks, 2):
                if min(made, later) >= 0 and path[number].step.footprint.meets(path[other].step.footprint):
                    for maker in (made, later):
                        step = path[maker].step
                        footprint = Footprint(step.footprint.reads, step.footprint.writes | {("lane", lane)})
                        path[maker].step = step._replace(footprint=footprint)

    def needs(self, step: int) -> None:
        """The present step could not have come without that one."""
        self._needs.add(step)

    def was_ready(self, number: int, name: Hashable) -> bool:
        """Whether somebody could have had this step."""
        return name in self._path[number].options

    def end_moment(self) -> None:
        """Time passes: no step of before could come after one of those that follow."""
        self._moment = self.number + 1

    def draw(self, kind: str, count: int, proposed: int) -> int:
        if self.watch is not None:
            self.watch.write(("drawn", kind))
        return super().draw(kind, count, proposed)

    def end(self) -> None:
        self._close()
        self._is_over = True

    def _close(self) -> None:
        if self.number >= 0 and not self._is_over:
            point = self._path[self.number]
            needs = frozenset(step for step in self._needs if 0 <= step < self.number)
            point.step = Step(point.taken, self._touched(), needs, self._since)


def _distinct(names: object) -> tuple[Hashable, ...]:
    found: dict[Hashable, None] = {}
    for name in names:  # type: ignore[attr-defined]
        while name in found:
            name = (name, "again")
        found[name] = None
    return tuple(found)
