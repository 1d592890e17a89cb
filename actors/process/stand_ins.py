"""Stand-ins at the root for the actors inside a process: one address each, so that they can be reached."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from ..exit_reasons import ExitReason
from ..kernel import lifecycle, links
from ..kernel.actor import Actor, Start
from ..kernel.bindings import claim
from ..kernel.cell import RUNNING, Cell, GivenName, Host
from ..kernel.codec import Parcel
from ..kernel.node import cell_kind
from .wire.frames import BadFrame
from .wire.peer import OutsideHost, Peer
from .wire.start_codec import loaded

if TYPE_CHECKING:
    from ..kernel.node import Node


class AboveStandIns(lifecycle.NearParent):
    """Above stand-ins: their supervisor is in the process, and has said whether it ended with them.

    Attributes:
        ended: those that have ended with their supervisor, which may be started again.
    """

    def __init__(self) -> None:
        self.ended = weakref.WeakSet[Cell]()

    def is_restarting(self, cell: Cell) -> bool:
        return cell in self.ended or super().is_restarting(cell)


class Inner:
    """Stand-ins below the address of a process's own actor. They end with the process."""

    def __init__(self, node: Node, peer: Peer) -> None:
        self._node = node
        self._host = OutsideHost(peer)
        self._host.parent = self._above = AboveStandIns()
        self._cells: dict[str, Cell] = {}

    def cells(self) -> Collection[Cell]:
        """All of them that are there."""
        return self._cells.values()

    def born(self, home: Cell, path: str, kind: str, life: int, bound: Mapping[str, str], last: ExitReason) -> None:
        """A life has begun at `path` below `home`; its bindings lead there, as its process says.

        `last`: why the life before it ended, if there was one.

        Raises:
            BadFrame: that address is not for this process to give.
        """
        cell = self._known(home, path, kind)
        is_new = cell.life != life
        if is_new and cell.life:
            lifecycle.tell_enders(cell.extra(), last)
        cell.life = life
        above = cell_kind(home)
        if above is None or not above._is_part:  # Who is protected is bound at its own address, not in its replicas.
            claim(cell, bound)
        if is_new and self._node.on_life is not None:
            self._node.on_life(cell)

    def named(self, home: Cell, path: str, kind: str, name: GivenName) -> None:
        """A life is about to begin at `path` below `home`, and is found by this name from its very start.

        Raises:
            BadFrame: that address is not for this process to give. StartFailed: another living actor has the name.
            SpecError: it is none.
        """
        cell = self._known(home, path, kind)
        lifecycle.free_names(cell)  # A life has one name by its spec, however often a start is tried.
        self._node.name_life(cell, name)

    def undone(self, path: str) -> None:
        """The life at an address is over, or could not be built, and others may follow."""
        cell = self._cells.get(path)
        if cell is not None:
            lifecycle.free_names(cell)

    def _known(self, home: Cell, path: str, kind: str) -> Cell:
        """The stand-in at an address below `home`, made now if there is none, with the class that lives there."""
        cell = self._cells.get(path)
        if cell is None:
            parent, name = self._place(home, path)
            self._free(home, path)
            cell = self._cells[path] = self._node.cell_below(parent, name, self._host)
            cell.state, cell.admit = RUNNING, self._admit
        know(cell, kind)
        return cell

    def homed(self, home: Cell, path: str, cell: Cell | None, host: Host) -> Cell:
        """An address below `home` whose own home is here: its cell outlives the process.

        Raises:
            BadFrame: that address is not for this process to give.
        """
        parent, name = self._place(home, path)
        if cell is None:
            cell = self._node.cell_below(parent, name, host)
        elif cell.parent is not parent:  # Those above it ended with their process, and are new.
            cell.parent = parent
            parent.children = {**(parent.children or {}), name: cell}
        self._cells[path] = cell
        return cell

    def readdressed(self, old: str, new: str) -> None:
        """The process's own actor has another address, and so have these."""
        self._cells = {new + path[len(old) :]: cell for path, cell in self._cells.items()}

    def adopt(self, path: str, cell: Cell) -> None:
        """An actor whose home is here has come to an address below."""
        self._cells[path] = cell

    def lost(self, path: str, cell: Cell) -> None:
        """The actor has left that address below; those here who are tied to it know it by its new one."""
        self._cells.pop(path, None)
        within, ties = set(self._cells.values()), cell.extra().ties
        for peer in within & ties.links.keys():
            peer.extra().ties.links[cell] = cell.path
        for watch in ties.monitors:
            if watch.watcher in within:
                watch.name = cell.path

    @staticmethod
    def _free(home: Cell, path: str) -> None:
        """Give up a life here that ended with the last process, before it had gone where its recipe says: there.

        Its supervisor may have been another one of that process, which is gone.
        """
        left = home.host.place.lived_at(path)
        if left is not None and left.host.parent.has_lost:
            left.host.parent.leaves(is_restarting=True)
            lifecycle.retire(left, "the process of its supervisor has ended")

    def lived_there(self, cell: Cell) -> Host:
        """What is sent to an address goes into the process from now on; returns its host."""
        cell.admit = self._admit
        return self._host

    def _place(self, home: Cell, path: str) -> tuple[Cell, str]:
        """The cell above an address, and its name there."""
        above, _, name = path.rpartition("/")
        parent = home if above == home.path else self._cells.get(above)
        if parent is None:
            raise BadFrame(f"{path} is not below {home.path}")
        return parent, name

    def _admit(self, cell: Cell, item: Any) -> None:
        """The mailbox of a stand-in: the class is known here, so it is known what it handles."""
        if type(item) not in cell.table and type(item) is not Parcel:
            cell.require(item)
        self._host.home.admit(cell, item)

    def gone(self, path: str, reason: ExitReason, *, with_parent: bool = False) -> None:
        """The address is free; `with_parent`: because its supervisor has ended."""
        cell = self._cells.pop(path, None)
        if cell is None:
            return
        cell.host.parent.leaves(is_restarting=with_parent)
        if with_parent:
            self._above.ended.add(cell)
        more = cell.extra()
        more.reason = reason
        for topic in list(more.belongings.topics):
            self._node.topics.unsubscribe(topic, cell)
        lifecycle.retire(cell, reason)
        links.announce(cell, reason, recovering=False)
        lifecycle.tell_enders(more, reason)

    def close(self, reason: ExitReason) -> None:
        """The process is gone: children go before their parents; who is homed here stays."""
        for path, cell in reversed(list(self._cells.items())):
            if cell.host is self._host:
                self.gone(path, reason)


def know(cell: Cell, kind: str) -> None:
    """Have a stand-in refuse what its class does not handle, if that is loaded here."""
    known = loaded(kind, Actor)
    if known is not None:
        cell.extra().start, cell.table = Start(known), known._table
