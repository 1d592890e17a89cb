"""The exhaustive search: one schedule of each kind, where two are of one kind if they differ only in the order of
steps that have nothing to do with each other.

Source: dynamic partial-order reduction: Flanagan, Godefroid, POPL 2005; with source sets and sleep sets: Abdulla,
Aronis, Jonsson, Sagonas, POPL 2014.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Final

from ..choices import Choices, Keys
from .footprints import NOTHING, Footprint, races
from .stepped import Stepped

SEED: Final = 0
"""Of all schedules of a search: what is drawn must be the same where two of them begin alike."""


class ChoicePoint:
    """A point of the search tree, from which one step was taken.

    Attributes:
        options: who could have the step.
        asleep: those that need not be tried here (any more), with what their steps touch.
        wanted: those that are to be tried.
        taken: who has the step in the present run, and `footprint` what it touches.
    """

    def __init__(self, options: tuple[Hashable, ...], asleep: dict[Hashable, Footprint], taken: Hashable) -> None:
        self.options, self.asleep, self.taken = options, asleep, taken
        self.wanted = [taken]
        self.footprint = NOTHING

    def want(self, initials: frozenset[Hashable]) -> None:
        """Have one of these tried here, if none is."""
        if initials.isdisjoint(self.wanted) and initials.isdisjoint(self.asleep):
            found = [name for name in self.options if name in initials]
            self.wanted += found[:1] or [name for name in self.options if name not in self.wanted]

    def advance(self) -> bool:
        """Go on to the next that is to be tried; False: there is none."""
        self.asleep[self.taken] = self.footprint
        left = [name for name in self.wanted if name not in self.asleep]
        if left:
            self.taken = left[0]
        return bool(left)


class Exhaustive:
    """Depth first through all schedules."""

    def __init__(self) -> None:
        self._path: list[ChoicePoint] = []
        self._is_over = False

    def choices(self, seed: int) -> Choices | None:
        return None if self._is_over else Explored(self._path)

    def learn(self, choices: Choices, trace: Sequence[tuple[str, str]]) -> None:
        assert isinstance(choices, Explored)
        path, steps = self._path, choices.steps_of_run()
        for point, step in zip(path, steps, strict=True):
            point.footprint = step.footprint
        for race in races(steps, choices.known - 1):
            path[race.first].want(race.initials)
        if choices.has_ended and path:  # Whoever could have gone on then may also come before.
            path[-1].wanted += [name for name in path[-1].options if name not in path[-1].wanted]
        while path and not path[-1].advance():
            path.pop()
        self._is_over = not path

    def covered(self, runs: int) -> str:
        """What has been tried, in words."""
        return (
            f"all schedules: {runs}, complete" if self._is_over else f"{runs} schedules were tried, and there are more"
        )


class Explored(Stepped):
    """One path of the search: repeated as far as it is known, then the first that does not sleep."""

    def __init__(self, path: list[ChoicePoint]) -> None:
        super().__init__(SEED)
        self.known = len(path)
        self._path = path

    def choose(self, count: int, keys: Keys) -> int:
        if self.is_over:
            return 0
        number = self.number + 1
        if number < self.known:
            taken = self._path[number].taken
            return self.options.index(taken) if taken in self.options else 0
        asleep = self._asleep(number)
        return next((index for index, name in enumerate(self.options) if name not in asleep), 0)

    def admit(self, owner: Hashable, options: tuple[Hashable, ...]) -> bool:
        number = self.number + 1
        if number >= self.known:
            asleep = self._asleep(number)
            if owner in asleep:  # All that could come now does so in another run.
                return False
            self._path.append(ChoicePoint(options, asleep, owner))
        return True

    def _asleep(self, number: int) -> dict[Hashable, Footprint]:
        """Whose order against the last step does not matter, of those that slept before it."""
        if not number:
            return {}
        last, touched = self._path[number - 1], self.touched()
        return {name: other for name, other in last.asleep.items() if name != last.taken and not touched.meets(other)}
