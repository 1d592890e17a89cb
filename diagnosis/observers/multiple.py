"""Several topics at once: traffic that another message triggers, or that is due while a condition holds (D21)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from typing import Any, Final

from ..literals import Literal, atom_of
from .observer import Manner, Observer

PENDING: Final = 10_000
"""Triggers that wait for their effect at most; of more, the oldest are left out."""


def _always(message: Any) -> bool:
    return True


class TriggeredObserver(Observer):
    """After a message on one topic, one must come on another: then the atom holds. Without triggers it is unknown.

    Args:
        trigger, effect: the topics; not the same one.
        atom: what is said.
        within: seconds from the trigger to its effect.
        when: which messages are triggers; all unless given.
        key: makes what trigger and effect have in common, such as an order's number; by default each effect stands for
            the oldest trigger.
        manner: see `Observer`.
    """

    def __init__(
        self,
        trigger: str,
        effect: str,
        atom: Literal | str,
        *,
        within: float,
        when: Callable[[Any], bool] = _always,
        key: Callable[[Any], Any] | None = None,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(trigger, effect, manner=manner)
        if trigger == effect or not within > 0:
            raise ValueError(f"{trigger} must not trigger itself, and within {within!r} be > 0")
        self._trigger, self._atom, self._within = trigger, atom_of(atom), within
        self._when, self._key = when, key
        self._pending: deque[tuple[float, Any]] = deque(maxlen=PENDING)
        self._last: float | None = None

    def hear(self, topic: str, message: Any) -> None:
        """A trigger waits for its effect."""
        key = None if self._key is None else self._key(message)
        if topic == self._trigger:
            if self._when(message):
                self._pending.append((self.now, key))
        else:
            self._come(key)

    def afresh(self, names: Collection[str]) -> None:
        """Nobody answers triggers from before."""
        self._pending.clear()
        self._last = None

    def _come(self, key: Any) -> None:
        waiting = next((one for one in self._pending if one[1] == key), None)
        if waiting is not None:
            self._pending.remove(waiting)
            self._judge(self.now - waiting[0] <= self._within)

    def look(self) -> None:
        """Those that have waited too long."""
        while self._pending and self.now - self._pending[0][0] > self._within:
            self._pending.popleft()
            self._judge(False)
        if self._last is not None and self.now - self._last > self.manner.time_to_live:
            self.verdict(self._atom, None)
            self._last = None

    def _judge(self, is_good: bool) -> None:
        self._last = self.now
        self.verdict(self._atom, is_good)


class ConditionedObserver(Observer):
    """While a condition holds, messages must come; else the atom is unknown.

    Args:
        condition: the topic whose newest message says whether the condition holds.
        topic: what must come meanwhile.
        atom: what is said.
        holds: whether it does, by a message of `condition`.
        within: seconds between two messages of `topic` at most.
        manner: see `Observer`.
    """

    def __init__(
        self,
        condition: str,
        topic: str,
        atom: Literal | str,
        *,
        holds: Callable[[Any], bool],
        within: float,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(condition, topic, manner=manner)
        if condition == topic or not within > 0:
            raise ValueError(f"{topic} must not be its own condition, and within {within!r} be > 0")
        self._condition, self._atom, self._holds, self._within = condition, atom_of(atom), holds, within
        self._since: float | None = None
        self._last = float("-inf")

    def hear(self, topic: str, message: Any) -> None:
        """The condition, or what is due under it."""
        if topic != self._condition:
            self._last = self.now
        elif not self._holds(message):
            self._since = None
            self.verdict(self._atom, None)
        elif self._since is None:
            self._since = self.now

    def afresh(self, names: Collection[str]) -> None:
        """Count the time in which messages are due from now on."""
        if self._since is not None:
            self._since, self._last = self.now, float("-inf")

    def look(self) -> None:
        """Say whether a message is overdue."""
        if self._since is None:
            return
        if self._last >= self._since and self.now - self._last <= self._within:
            self.verdict(self._atom, True)
        elif self.now - max(self._last, self._since) > self._within:
            self.verdict(self._atom, False)
