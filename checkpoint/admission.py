"""An admission on its way into the journal: a message from outside counts when it is as safe as it has to be."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..actors.errors import HoldfastError

if TYPE_CHECKING:
    from .inputs import Input
    from .journal import Entry
    from .switch import Switch


class Admission:
    """One input that stands alone in its submission."""

    __slots__ = ("_accepted", "_home", "_source", "entries")

    def __init__(self, home: Switch, source: Input, entry: Entry) -> None:
        self._home, self._source = home, source
        self.entries = ((home.path, entry),)
        self._accepted: asyncio.Future[None] | None = None

    def accepted(self) -> asyncio.Future[None]:
        """For a sender that waits until it counts."""
        self._accepted = self._home.node.loop.create_future()
        return self._accepted

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._source.positions.append(positions[0])

    def safe(self) -> None:
        """It counts, and is fed."""
        self._home.admitted(self._source)
        if self._accepted is not None and not self._accepted.done():
            self._accepted.set_result(None)

    def refused(self, error: HoldfastError) -> bool:
        """It was not written: nobody has heard of it. What comes from the runtime itself waits."""
        if not self._home.take_back(self._source, error, told=self._accepted is not None):
            return False
        if self._accepted is not None and not self._accepted.done():
            self._accepted.set_exception(error)
            self._accepted.exception()  # The sender may have gone.
        return True
