"""The monitors and links of a recorded actor, kept by its home so that the next root ties them again.

Within one root, monitors and links stand at the cells. When the root was restarted they are tied anew, each as soon as
somebody lives at the other address again.
"""

from __future__ import annotations

import functools
from collections import Counter
from typing import TYPE_CHECKING

from ..actors.kernel import links

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..actors.kernel.cell import Cell
    from .home.switch import Switch

Tie = tuple[str, str]
"""What ("monitor", "watch" or "link"), and the other address."""

UNDONE_BY = {"demonitor": "monitor", "unwatch": "watch", "unlink": "link"}


class DurableTies:
    """The monitors and links of one home. There may be several monitors of one actor, but one link."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._kept: Counter[Tie] = Counter()
        self._untied: Counter[Tie] = Counter()  # as read back from the store
        self._turn, self._before = -1, Counter[Tie]()  # the last turn that has changed them, and what there was then

    def turn(self, turn: int, verb: str, path: str) -> None:
        """A turn has tied or untied something."""
        if turn != self._turn:
            self._turn, self._before = turn, Counter(self._kept)
        if verb in UNDONE_BY:
            self._kept -= Counter({(UNDONE_BY[verb], path): 1})
        elif verb != "link" or not self.has(verb, path):
            self._kept[verb, path] += 1

    def over(self, verb: str, path: str) -> None:
        """One such tie is over: the actor is told of the other one's end."""
        gone = Counter({(verb, path): 1})
        self._kept, self._before = self._kept - gone, self._before - gone

    def has(self, verb: str, path: str) -> bool:
        """Whether there is such a tie, or will be when the other one is there."""
        return (verb, path) in self._kept

    def rename(self, now: Callable[[str], str]) -> None:
        """Some of the others have moved: `now` gives their addresses."""
        if self._kept or self._untied:
            self._kept, self._untied = _renamed(self._kept, now), _renamed(self._untied, now)

    def go_back(self, ties: list[Tie]) -> None:
        """These again, as a snapshot has them: what was tied since is undone, and what was untied comes back."""
        cell, node = self._home.cell, self._home.node
        undo = {verb: name for name, verb in UNDONE_BY.items()}
        before, self._kept = self._kept, _renamed(Counter(ties), self._home.homes.addresses.now)
        stand = before - self._untied
        for verb, path in (stand - self._kept).elements():
            if cell is not None:
                connect(cell, node.cell_at(path), undo[verb])
        self._untied = self._kept - stand

    def saved(self, turn: int) -> list[Tie]:
        """All of them, as a snapshot of the state after a turn has them: what a later one does is in the journal."""
        return list((self._before if self._turn > turn else self._kept).elements())

    def replace(self, ties: list[Tie]) -> None:
        """These, as a snapshot has them."""
        self._kept = Counter(ties)

    def untie(self) -> None:
        """Nothing is tied until somebody lives here: it was read back from the store, or the address is free."""
        if not self._kept and not self._untied:
            return
        for _, path in self._kept:
            self._home.homes.addresses.absentees.over(path, self)
        self._untied = Counter(self._kept)

    def tie(self) -> None:
        """The actor is live: tie what the last root had tied, now or when the other one is there.

        Whoever does not come back has ended: the actor is told so.
        """
        if not self._untied:
            return
        untied, self._untied = self._untied, Counter()
        node, absent = self._home.node, self._home.homes.addresses.absentees
        for verb, path in untied.elements():
            other = node.find(path)
            if other is None or other.is_dead:
                if absent.is_gone(path):
                    self._end(verb, path)
                    continue
                node.awaited.setdefault(path, []).append(functools.partial(self._tie_soon, verb, path))
                absent.wait(path, self)
            else:
                self._tie(verb, path)

    def end(self, path: str) -> None:
        """Nobody comes to an address: what waits for somebody there is over."""
        if not self._untied:  # Else it is told when it lives again.
            for verb, other in list(self._kept.elements()):
                if other == path:
                    self._end(verb, path)

    def _end(self, verb: str, path: str) -> None:
        cell = self._home.cell
        if cell is not None and not cell.is_dead and self.has(verb, path):
            connect(cell, self._home.node.nowhere(path), verb)  # As to any address where nobody lives.

    def _tie_soon(self, verb: str, path: str) -> None:
        self._home.node.loop.call_soon(self._tie, verb, path)  # Whoever comes there is not started yet.

    def _tie(self, verb: str, path: str) -> None:
        home = self._home
        cell, other = home.cell, home.node.find(path)
        home.homes.addresses.absentees.over(path, self)
        if cell is None or other is None or cell.is_dead:
            return
        if tied(cell, other, verb) < self._kept[verb, path]:  # Else it was undone while the other one was awaited.
            connect(cell, other, verb)


def _renamed(ties: Counter[Tie], now: Callable[[str], str]) -> Counter[Tie]:
    return Counter((verb, now(path)) for verb, path in ties.elements())


def tied(cell: Cell, other: Cell, verb: str) -> int:
    """How many ties of a kind there are now."""
    if verb == "link":
        return int(cell.more is not None and other in cell.more.ties.links)
    watches = () if other.more is None else other.more.ties.monitors
    return sum(one.watcher is cell and one.for_good is (verb == "watch") for one in watches)


def connect(cell: Cell, other: Cell, verb: str) -> None:
    """Tie or untie, as an ended turn wants it."""
    match verb:
        case "monitor" | "watch":
            links.monitor(cell, other, for_good=verb == "watch")
        case "demonitor" | "unwatch":
            links.demonitor(cell, other, for_good=verb == "unwatch")
        case "link":
            links.link(cell, other)
        case _:
            links.unlink(cell, other)
