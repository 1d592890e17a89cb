"""Failover's hold on a protected actor, granted by the arbiter of the system (T63)."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from ...supervision.arbiter import Grant, Hand, InOtherHands, arbiter_of

if TYPE_CHECKING:
    from collections.abc import Generator

    from ...actors.kernel.cell import Cell


class FailoverHold:
    """Of one group. It is had at once, or not at all: a repair that is at it loses the actor, and is not waited for.

    It outlives the failover manager, as all does that is known of a group: its next life goes on with what it holds.
    """

    def __init__(self, cell: Cell) -> None:
        self._node, self._cell = cell.node, cell
        self._grant: Grant | None = None

    def take(self, why: str) -> bool:
        """Have the actor, until it is given back. False: another failover has it, of something above."""
        if self._grant is None:
            self._grant = self._claim(self._cell.path, why)
        return self._grant is not None

    def give_back(self) -> None:
        """The failover is over: others may have the actor."""
        grant, self._grant = self._grant, None
        if grant is not None:
            arbiter_of(self._node).release(grant)

    @contextlib.contextmanager
    def of(self, address: str, why: str) -> Generator[bool]:
        """One replica for a block; False: as `take`."""
        grant = self._claim(address, why)
        try:
            yield grant is not None
        finally:
            if grant is not None:
                arbiter_of(self._node).release(grant)

    def _claim(self, address: str, why: str) -> Grant | None:
        try:
            return arbiter_of(self._node).claim(address, Hand.FAILOVER, why, errand=self)
        except InOtherHands:
            return None
