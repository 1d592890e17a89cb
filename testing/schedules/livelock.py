"""Detects livelock: work that goes on for ever while virtual time stands still.

A round is over when all that waited at its beginning has had its turn: each message in a mailbox, each callback that
was due. What these send and schedule is of the next round. So there are as many rounds at one moment as the longest
chain of causes has links there: 50,000 messages in a mailbox are one round, and if each is passed on to a second actor,
two, in whatever order the two run; an actor that tells itself, and two that tell each other, take a round for each
turn. A burst ends after as many rounds as it is deep. What has not ended after many is taken to go on for ever.

That counts only if each round ends, which a schedule that holds somebody up may never let it do: in a round that has
become long, who waits since its beginning comes first.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Final

Waiting = Mapping[Hashable, int]
"""Who can go on now (an actor, a task, a timer, a lane of callbacks), and how much each has before it."""
LOOK_AGAIN: Final = 256
"""Steps after which is looked whether those who wait still can go on: who has ended or waits for time cannot."""


class Rounds:
    """Counts the rounds from here on, at one moment of virtual time.

    Args:
        most: rounds that are not too many.
        waiting: tells who can go on now.
    """

    def __init__(self, most: int, waiting: Callable[[], Waiting]) -> None:
        self._most, self._waiting = most, waiting
        self._count = self._steps = 0  # rounds, and steps of the one that runs
        self._begin()

    def _begin(self) -> None:
        self._left = dict(self._waiting())
        self._steps, self._most_steps = 0, sum(self._left.values()) + self._most

    @property
    def are_too_many(self) -> bool:
        """Whether it seems that time will never pass."""
        return self._count > self._most

    @property
    def is_late(self) -> bool:
        """Whether the round takes so long that it must be brought to its end."""
        return self._steps > self._most_steps

    def step(self, key: Hashable) -> None:
        """A turn of an actor begins, or a callback is called."""
        self._steps += 1
        left = self._left
        if key in left:
            left[key] -= 1
            if not left[key]:
                del left[key]
        if left and self._steps % LOOK_AGAIN == 0:
            now = self._waiting()
            self._left = left = {key: count for key, count in left.items() if key in now}
        if not left:
            self._count += 1
            self._begin()

    def first(self, keys: Iterable[Hashable]) -> int:
        """Which of these has waited since the round began; the first of all if none has."""
        return next((index for index, key in enumerate(keys) if key in self._left), 0)
