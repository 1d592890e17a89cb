"""Who of an earlier program does not live again, as far as that is known: recorded actors may still be tied to them.

A supervisor says, when it begins, which children it has or brings back. Whoever else was below it does not come by
itself, and an id that was made up is never made up again. Of an address whose supervisor has not begun, or which the
program starts by itself, nothing is known; nor of one at which something is recorded, for whoever is started there goes
on with that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..actors.kernel.links import MADE_UP_NAME
from ..actors.persistence import CHILDREN

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from ..actors.kernel.node import Node
    from .durable_links import DurableTies


class Absentees:
    """What the supervisors of one program have said of their children, and ties that wait for somebody to come.

    Args:
        node: of the program.
        noted: what the store has noted under a key.
        has_recorded: whether something is recorded at an address.
    """

    def __init__(self, node: Node, noted: Callable[[str], bytes | None], has_recorded: Callable[[str], bool]) -> None:
        self._node, self._noted, self._has_recorded = node, noted, has_recorded
        self._listed: dict[str, frozenset[str]] = {}
        self._waiting: dict[str, dict[DurableTies, None]] = {}

    def began(self, supervisor: str, listed: Collection[str]) -> None:
        """A supervisor begins with these children; who waits for another one below it hears that it does not come."""
        if supervisor == self._top:
            return  # Whatever the program starts is below this one.
        self._listed[supervisor] = frozenset(listed)
        for path in [one for one in self._waiting if one.startswith(f"{supervisor}/") and self.is_gone(one)]:
            for ties in self._waiting.pop(path):
                ties.end(path)

    @property
    def _top(self) -> str:
        return f"/{self._node.name}"

    def is_gone(self, path: str) -> bool:
        """Whether nobody lives at an address, and whoever has will not live there again."""
        top, find = self._top, self._node.find
        if not path.startswith(f"{top}/"):
            return False
        above, names = top, path[len(top) + 1 :].split("/")
        for index, name in enumerate(names):
            at = f"{above}/{name}"
            cell = find(at)
            if cell is None or cell.is_dead:
                listed = self._listed.get(above)
                if listed is None:
                    return any(one.startswith(MADE_UP_NAME) for one in names[index:])
                return name not in listed and not self._may_return(at)
            above = at
        return False

    def _may_return(self, path: str) -> bool:
        """Whether something is recorded there for whoever comes; not if its supervisor has noted that nobody will."""
        noted = self._noted(f"{CHILDREN}{path}")
        return bool(noted) or (noted is None and self._has_recorded(path))

    def wait(self, path: str, ties: DurableTies) -> None:
        """Ties to an address where nobody lives wait for somebody to come, or for the word that nobody will."""
        self._waiting.setdefault(path, {})[ties] = None

    def over(self, path: str, ties: DurableTies) -> None:
        """The ties wait for that address no more."""
        waiting = self._waiting.get(path, {})
        waiting.pop(ties, None)
        if not waiting:
            self._waiting.pop(path, None)

    def dismissed(self, path: str) -> None:
        """A supervisor is gone: what it has said of its children counts no more."""
        for one in [one for one in self._listed if one == path or one.startswith(f"{path}/")]:
            del self._listed[one]

    def rename(self, now: Callable[[str], str]) -> None:
        """Some actors have moved: `now` gives their addresses."""
        self._listed = {now(path): listed for path, listed in self._listed.items()}
        self._waiting = {now(path): waiting for path, waiting in self._waiting.items()}
