"""What a recorded actor watches and is linked to: known to its home, so that the next root has it too.

Within one root, monitors and links stand at the cells. When the root was restarted they are tied anew, each as soon as
somebody lives at the other address again.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from ..actors.kernel import links

if TYPE_CHECKING:
    from ..actors.kernel.cell import Cell
    from .home.switch import Switch

Tie = tuple[str, str]
"""What ("monitor", "watch" or "link"), and the other address."""

UNDONE_BY = {"demonitor": "monitor", "unwatch": "watch", "unlink": "link"}


class Ties:
    """The monitors and links of one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._kept: dict[Tie, None] = {}
        self._untied: list[Tie] = []  # as read back from the store

    def turn(self, verb: str, path: str) -> None:
        """A turn has tied or untied something."""
        if verb in UNDONE_BY:
            self._kept.pop((UNDONE_BY[verb], path), None)
        else:
            self._kept[verb, path] = None

    def over(self, verb: str, path: str) -> None:
        """The actor is told of the other one's end, and that was the last of it."""
        self._kept.pop((verb, path), None)

    def has(self, verb: str, path: str) -> bool:
        """Whether there is such a tie, or will be when the other one is there."""
        return (verb, path) in self._kept

    def go_back(self, ties: list[Tie]) -> None:
        """These again, as a snapshot has them: what was tied since is undone, and what was untied comes back."""
        cell, node = self._home.cell, self._home.node
        undo = {verb: name for name, verb in UNDONE_BY.items()}
        for verb, path in self._kept:
            if cell is not None and (verb, path) not in ties and (verb, path) not in self._untied:
                connect(cell, node.cell_at(path), undo[verb])
        self._untied = [one for one in ties if one in self._untied or one not in self._kept]
        self._kept = dict.fromkeys(ties)

    def saved(self) -> list[Tie]:
        """All of them, as a snapshot has them."""
        return list(self._kept)

    def replace(self, ties: list[Tie]) -> None:
        """These, as a snapshot has them."""
        self._kept = dict.fromkeys(ties)

    def loaded(self) -> None:
        """All has been read back from the store: nothing of it is tied yet."""
        self._untied = list(self._kept)

    def tie(self) -> None:
        """The actor is live: tie what the last root had tied, now or when the other one is there."""
        untied, self._untied = self._untied, []
        node = self._home.node
        for verb, path in untied:
            other = node.find(path)
            if other is None or other.is_dead:
                node.awaited.setdefault(path, []).append(functools.partial(self._tie_soon, verb, path))
            else:
                self._tie(verb, path)

    def _tie_soon(self, verb: str, path: str) -> None:
        self._home.node.loop.call_soon(self._tie, verb, path)  # Whoever comes there is not started yet.

    def _tie(self, verb: str, path: str) -> None:
        home = self._home
        cell, other = home.cell, home.node.find(path)
        if cell is not None and other is not None and not cell.is_dead and (verb, path) in self._kept:
            connect(cell, other, verb)


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
