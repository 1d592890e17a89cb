"""Children that are bound to somebody who is not there yet: they wait, and circles are found.

Whoever waits keeps those waiting that are started behind it. If that leads back to itself, nobody in the circle can be
up before another one is: it is told as an error, which names them all. Who comes back with a dynamic supervisor waits
apart: it was there before, so whoever it is bound to is to come, and nobody waits for it meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

from ..actors.errors import NoSuchActor, StartFailed
from ..actors.kernel.cell import DOWN, GONE, Cell
from ..actors.kernel.node import Node
from .children import STOPPED, STOPPING, Child

if TYPE_CHECKING:
    from .spec import ChildSpec

LOOK_AGAIN = 0.02
"""Seconds between two looks at whether somebody is there."""
EACH_LOOK = 1e-4
"""More seconds between two looks for each address that is looked at."""
TELL_AFTER = 5.0
"""Seconds after which it is told that children that come back wait for somebody."""
Listed = Callable[[Cell], Mapping[str, Child] | None]
"""The children of a supervisor that lives in this process; None if there is none at a cell."""


def not_there(node: Node, listed: Listed, path: str, spec: ChildSpec) -> str:
    """The first address outside its own that a child needs to start, and where nobody lives; "" if there is none."""
    needed = (to for to in _bound_to(spec) if not to.startswith(f"{path}/"))
    return next((to for to in needed if not lives(node, listed, to)), "")


def lives(node: Node, listed: Listed, path: str) -> bool:
    """Whether somebody lives at an address, or is being started there by its supervisor."""
    cell = node.find(path)
    if cell is None or cell.is_dead:
        return False
    siblings = None if cell.parent is None or cell.life else listed(cell.parent)
    one = None if siblings is None else siblings.get(cell.name)
    return one is None or not one.comes  # Who only comes has its address, and perhaps waits itself.


def tell_wait(supervisor: Cell) -> None:
    """Have the root know that children of a supervisor begin to wait for somebody to whom they are bound."""
    uplink = supervisor.node.ports.uplink
    if uplink is None:
        supervisor.node.supervised.waiting.add(supervisor)
    else:
        uplink.command(supervisor, "waits", {})


def _bound_to(spec: ChildSpec) -> Iterator[str]:
    """Where a child has to be bound before it can start, and those that its recipe starts below it."""
    yield from (to for port, to in spec.bindings.items() if port not in spec.late)
    if spec.is_supervisor and not spec.start.kind._is_dynamic:  # What a dynamic one starts waits apart.
        for one in spec.below():
            if one.autostart:
                yield from _bound_to(one)


class AwaitedStart(NamedTuple):
    """A child that waits, and the address that it waits for."""

    who: str
    target: str


class Prospects:
    """Who is about to be started in this process, and who stands in front of whom.

    Args:
        node: of this process.
        listed: how the children of a supervisor are found.
    """

    def __init__(self, node: Node, listed: Listed) -> None:
        self._node, self._listed = node, listed

    def missing(self, who: str, one: Child) -> str:
        """The first address that a child is bound to and where nobody lives yet, but will; "" if there is none.

        Raises:
            StartFailed: nobody is about to come there, or not before this child is up.
        """
        node = self._node
        for port, path in one.spec.bindings.items():
            if port in one.spec.late or lives(node, self._listed, path):
                continue
            one.awaited = path
            circle = self._circle(AwaitedStart(who, path))
            if circle is None:
                raise StartFailed(who, f"binding {port!r}: {NoSuchActor(path)}")
            if len(circle) == 1:
                late = "yet, because it is started after this child: put it, or its supervisor, first in the list"
                raise StartFailed(who, f"binding {port!r}: {NoSuchActor(path)} {late}")
            if circle:
                chain = ", ".join(f"{wait.who} waits for {wait.target}" for wait in circle)
                raise StartFailed(who, f"binding {port!r}: nobody of these can begin before another one: {chain}")
            return path
        return ""

    def _circle(self, first: AwaitedStart) -> list[AwaitedStart] | None:
        """Those who keep each other, and at last `first`, waiting; none if that is nobody. None: nobody will come."""
        if self._in_front(first.target) is None:
            return None
        trails, seen = [[first]], set[AwaitedStart]()
        while trails:
            trail = trails.pop()
            if trail[-1] in seen:
                continue
            seen.add(trail[-1])
            for wait in self._in_front(trail[-1].target) or ():
                if wait == first:
                    return trail
                trails.append([*trail, wait])
        return []

    def _in_front(self, path: str) -> list[AwaitedStart] | None:
        """Who waits, and has to be up before somebody comes to live at an address. None: nobody will come."""
        at = self._node.root
        if at is None or not path.startswith(f"{at.path}/"):
            return None
        names = path[len(at.path) + 1 :].split("/")
        while names:
            children = self._listed(at)
            if children is None:  # It is between two lives, or lives in another process.
                return [] if at.state is DOWN or _is_named(at, names) else None
            one = children.get(names[0])
            if one is None or (one.row is None and one.state in (STOPPED, STOPPING)):
                return None
            if one.row is not None and one.row.current is not one:
                current = one.row.current
                return [] if current is None else list(self._waiting(f"{at.path}/{current.spec.id}", current))
            if one.awaited:
                return [AwaitedStart(f"{at.path}/{one.spec.id}", one.awaited)]
            if one.cell is None or one.cell.state is GONE:
                return []
            at = one.cell
            del names[0]
        return []

    def _waiting(self, path: str, one: Child) -> Iterator[AwaitedStart]:
        """A child that waits and keeps others waiting, or those below it that do."""
        if one.awaited:
            if not one.waits_apart:
                yield AwaitedStart(path, one.awaited)
        elif one.cell is not None:
            for name, below in (self._listed(one.cell) or {}).items():
                yield from self._waiting(f"{path}/{name}", below)


def _is_named(supervisor: Cell, names: list[str]) -> bool:
    """Whether the recipe of a supervisor names such a descendant."""
    from .respec import spec_below  # It knows the supervisor, which asks here.

    start = supervisor.more.start if supervisor.more is not None else None
    return start is not None and spec_below(start, names) is not None
