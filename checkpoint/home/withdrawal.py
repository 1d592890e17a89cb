"""Withdraws what asks have brought whose time was over before their turns began: no life and no program handles it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from ...actors.errors import HoldfastError

if TYPE_CHECKING:
    from ..inputs import Input
    from ..journal import Entry
    from .switch import Switch

PATIENCE: Final = 1.0
"""Seconds that an ask whose time is over waits for the store; then nobody can say whether the next program knows."""


class Withdrawal:
    """One of them, on its way to the store; `then` hears once whether it will last."""

    weight = 1
    __slots__ = ("_home", "_positions", "_source", "_then", "_timer")

    def __init__(self, home: Switch, source: Input, then: Callable[[bool], None]) -> None:
        self._home, self._source = home, source
        self._then: Callable[[bool], None] | None = then
        if source.positions is None:
            source.positions = []
        self._positions = source.positions
        self._timer: asyncio.TimerHandle = home.node.loop.call_later(PATIENCE, self._tell, False)

    @property
    def entries(self) -> Sequence[tuple[str, Entry]]:
        """What the next program reads."""
        return ((self._home.path, ("late", self._source.id)),)

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._positions += positions

    def safe(self) -> None:
        """It lasts."""
        self._tell(True)

    def refused(self, error: HoldfastError) -> bool:
        """It has happened: it waits."""
        return False

    def abandoned(self, error: HoldfastError) -> None:
        """The next program will not know."""
        self._tell(False)

    def _tell(self, lasts: bool) -> None:
        self._timer.cancel()
        then, self._then = self._then, None
        if then is not None:
            then(lasts)


def withdraw(home: Switch, source: Input, then: Callable[[bool], None]) -> None:
    """Have an input never begun that no life has begun; `then` hears, within a second, whether that will last."""
    commits = home.journal.commits
    source.is_late = True
    if not home.journal.durable:
        then(True)  # Nothing of it outlives this process.
    elif commits.blocked is not None or commits.stopped is not None:
        then(False)
    else:
        home.outputs.rows.close()
        home.journal.submit(Withdrawal(home, source, then))
