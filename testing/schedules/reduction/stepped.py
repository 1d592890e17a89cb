"""The choices of a run whose steps are noted, with what each has touched."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterable
from typing import TYPE_CHECKING, Any

from ..choices import Choices, Keys
from .footprints import EVERYTHING, NOTHING, Footprint, NotedStep

if TYPE_CHECKING:
    from .watch import StepWatch


class Stepped(Choices):
    """Notes each step of a run, up to the end of the test.

    Attributes:
        noted: the steps, in order.
        number: of the present one; -1: there has been none.
        watch: tells of them.
        is_over: whether nothing is noted any more; `has_ended`: because the test has come to its end.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.watch: StepWatch | None = None
        self.noted: list[NotedStep] = []
        self.number = -1
        self.options: tuple[Hashable, ...] = ()  # who could have the coming step, if that is a choice
        self.is_over = self.has_ended = False
        self._ready: list[tuple[Hashable, ...]] = []  # who could have each step
        self._touched: Callable[[], Footprint] = lambda: NOTHING
        self._needs: set[int] = set()
        self._since = self._moment = 0
        self._lanes: dict[Hashable, list[tuple[int, int]]] = {}

    def turn(self, count: int, keys: Keys) -> int:
        if self.watch is not None and not self.is_over:
            self.options = _distinct(map(self.watch.name, keys()))
        return super().turn(count, keys)

    def draw(self, kind: str, count: int, proposed: int) -> int:
        if self.watch is not None:
            self.watch.write(("drawn", kind))
        return super().draw(kind, count, proposed)

    def end(self) -> None:
        """The test is over. What could have gone on then is cut off: its last step has to do with everything."""
        if not self.is_over and self.watch is not None:
            self.watch.write(EVERYTHING)
            self.has_ended = True
        self._stop()

    def _stop(self) -> None:
        self._close()
        self.is_over = True

    # -- what the watch tells -----------------------------------------------------------------------------------------

    def begin(self, owner: Hashable, touched: Callable[[], Footprint], enabled_by: set[int]) -> None:
        """The next step begins; `touched` says what it has touched so far."""
        if self.is_over:
            return
        self._close()
        options, self.options = self.options or (owner,), ()
        if not self.admit(owner, options):
            self._stop()
            return
        self.number += 1
        self._ready.append(options)
        self.noted.append(NotedStep(owner, NOTHING))
        self._touched, self._needs, self._since = touched, set(enabled_by), self._moment

    def admit(self, owner: Hashable, options: tuple[Hashable, ...]) -> bool:
        """Whether the run is still of interest when this step begins."""
        return True

    def keep_place(self, lane: Hashable, made: int) -> None:
        """The present step is that of a callback which keeps its place in a lane, since the step that has made it."""
        if not self.is_over:
            self._lanes.setdefault((lane, self._moment), []).append((made, self.number))

    def need(self, step: int) -> None:
        """The present step could not have come without that one."""
        self._needs.add(step)

    def was_ready(self, number: int, name: Hashable) -> bool:
        """Whether somebody could have had this step."""
        return name in self._ready[number]

    def end_moment(self) -> None:
        """Time passes: no step of before could come after one of those that follow."""
        self._moment = self.number + 1

    def touched(self) -> Footprint:
        """What the present step has touched so far."""
        return self._touched()

    def _close(self) -> None:
        if self.number >= 0 and not self.is_over:
            needs = frozenset(step for step in self._needs if 0 <= step < self.number)
            self.noted[-1] = NotedStep(self.noted[-1].owner, self._touched(), needs, self._since)

    def steps_of_run(self) -> list[NotedStep]:
        """The steps. Who schedules two callbacks of a lane says in which order they come: that matters if they meet."""
        steps = list(self.noted)
        for lane, callbacks in self._lanes.items():
            for (made, number), (later, other) in itertools.combinations(callbacks, 2):
                if min(made, later) >= 0 and steps[number].footprint.meets(steps[other].footprint):
                    for maker in (made, later):
                        reads, writes = steps[maker].footprint
                        steps[maker] = steps[maker]._replace(footprint=Footprint(reads, writes | {("lane", lane)}))
        return steps


def _distinct(names: Iterable[Hashable]) -> tuple[Hashable, ...]:
    found: dict[Hashable, None] = {}
    for name in names:
        while name in found:
            name = (name, "again")
        found[name] = None
    return tuple(found)
