"""The actors inside a process besides its own, as the root knows them: an address each, so that they can be reached."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .. import links, lives
from ..actor import Actor, Start
from ..cell import RUNNING, Cell
from ..codec import Parcel
from ..exits import ExitReason
from .connection import BadFrame
from .recipe import loaded
from .relay import OutsideHost, Peer

if TYPE_CHECKING:
    from ..node import Node


class Inner:
    """Stand-ins below the address of a process's own actor. They end with the process."""

    def __init__(self, node: Node, peer: Peer) -> None:
        self._node = node
        self._host = OutsideHost(peer)
        self._cells: dict[str, Cell] = {}

    def born(self, home: Cell, path: str, kind: str, life: int) -> None:
        """A life has begun at `path` below `home`.

        Raises:
            BadFrame: that address is not for this process to give.
        """
        cell = self._cells.get(path)
        if cell is None:
            above, _, name = path.rpartition("/")
            parent = home if above == home.path else self._cells.get(above)
            if parent is None:
                raise BadFrame(f"{path} is not below {home.path}")
            cell = self._cells[path] = self._node.cell_below(parent, name, self._host)
            cell.state, cell.admit = RUNNING, self._admit
        cell.life = life
        known = loaded(kind, Actor)
        if known is not None:
            cell.extra().start, cell.table = Start(known), known._table

    def _admit(self, cell: Cell, item: Any) -> None:
        """The mailbox of a stand-in: the class is known here, so it is known what it handles."""
        if type(item) not in cell.table and type(item) is not Parcel:
            cell.require(item)
        self._host.admit(cell, item)

    def gone(self, path: str, reason: ExitReason) -> None:
        """The address is free."""
        cell = self._cells.pop(path, None)
        if cell is None:
            return
        more = cell.extra()
        more.reason = reason
        for topic in list(more.topics):
            self._node.topics.unsubscribe(topic, cell)
        lives.retire(cell, reason)
        links.announce(cell, reason, recovering=False)
        lives.tell_enders(more, reason)

    def close(self, reason: ExitReason) -> None:
        """The process is gone: children go before their parents."""
        for path in reversed(list(self._cells)):
            self.gone(path, reason)
