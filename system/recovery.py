"""The supervisor `/<system>/recovery` and the recovery parts below it: there from the first recorded child on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..actors.errors import NameTaken
from ..actors.kernel.actor import Start, start
from ..actors.kernel.cell import RUNNING, Cell
from ..checkpoint.recovery.part_list import PARTS
from ..supervision.spec import Flags, child
from ..supervision.supervisor import Supervisor

if TYPE_CHECKING:
    from ..actors.kernel.node import Node
    from ..checkpoint.home.homes import Homes

NAMES = ("recovery", "$recovery")
"""What the supervisor is called; the second, if the program has a child of the first name."""
FIRST_DELAY, LONGEST_DELAY = 0.05, 5.0
"""Seconds until it is started again when its parts were restarted too often; doubled each time."""


class RecoverySupervisor(Supervisor):
    """The supervisor of the recovery parts: no transaction changes it, or what is below it."""


class RecoveryTree:
    """Keeps the recovery parts alive. They are no children of the program: however often they end, it goes on."""

    def __init__(self, node: Node, homes: Homes) -> None:
        self._node, self._homes = node, homes
        self._delay = FIRST_DELAY
        self._born = 0.0

    def begin_with_first_home(self) -> None:
        """Start the supervisor as soon as a recorded actor has a home."""
        self._homes.on_first = self.begin

    def begin(self) -> None:
        """Start the supervisor, unless the system is stopping."""
        node = self._node
        if node.root is None or node.root.state is not RUNNING:
            return
        children = tuple(child(name, start(kind, self._homes)) for name, kind in PARTS)
        recipe = Start(RecoverySupervisor, (Flags(intensity=10, period=1.0), children))
        self._born = node.loop.time()
        cell = self._spawn(recipe)
        cell.ended().add_done_callback(lambda _: self._ended(cell))

    def _spawn(self, recipe: Start[RecoverySupervisor]) -> Cell:
        for name in NAMES[:-1]:
            try:
                return self._node.spawn(recipe, name)
            except NameTaken:
                continue
        return self._node.spawn(recipe, NAMES[-1])

    def _ended(self, cell: Cell) -> None:
        """Its parts were restarted too often, or somebody has stopped it."""
        loop = self._node.loop
        if loop.time() - self._born > LONGEST_DELAY:
            self._delay = FIRST_DELAY
        delay, self._delay = self._delay, min(self._delay * 2, LONGEST_DELAY)
        if self._node.root is not None and self._node.root.state is RUNNING:
            loop.call_later(delay, self.begin)
