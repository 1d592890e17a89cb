"""Hooks around the turns of a node, for tests: called before and after a turn, or instead of its handler.

Installed by exchanging one function of the run loop, `run_turns`, for one that runs the same turns singly. Without a
watcher the loop's own function stands there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..actors.kernel import loop as run_loop
from ..actors.kernel.cell import Cell
from ..actors.kernel.envelope import Handler, Table
from ..actors.kernel.loop import RunLoop, Suspended
from ..actors.kernel.message import Message, message_of
from .swaps import Swaps

Substitute = Callable[[Handler], Handler]
"""Makes what runs in a turn from what would have run."""


class TurnWatcher:
    """Hears of the turns of one node. Subclasses override what they need."""

    def begins(self, cell: Cell, item: Any) -> Substitute | None:
        """The turn of `item` is next; a substitute is run in place of its handler."""
        return None

    def ended(self, cell: Cell, item: Any) -> None:
        """The turn is over: its handler has returned or raised, also if it had to wait in between."""


class Tracer(TurnWatcher):
    """Notes (address, what was handled) of each turn."""

    def __init__(self, trace: list[tuple[str, str]]) -> None:
        self._trace = trace

    def begins(self, cell: Cell, item: Any) -> None:
        message = message_of(item)
        self._trace.append((cell.path, type(item if message is None else message).__name__))


class Watched:
    """The turns of one node under watch."""

    def __init__(self) -> None:
        self.watchers: list[TurnWatcher] = []
        self.substituting: list[TurnWatcher] = []  # those of them that want to hear before a turn

    def run(self, original: Callable[[Cell, int], int], cell: Cell, most: int) -> int:
        """As `run_turns`, one turn at a time."""
        queue = cell.queue
        if not queue:
            return original(cell, most)
        for _ in range(min(len(queue), most)):
            item = queue[0] if queue else None
            goes_on = self._run_substituted(original, cell, item) if self.substituting else original(cell, 1)
            turn = cell.more.turn if cell.more is not None else None
            if turn is None or turn.item is not item:  # Else it waits for something, and is over later.
                for watcher in self.watchers:
                    watcher.ended(cell, item)
            if not goes_on:
                return 0
        return 1

    def _run_substituted(self, original: Callable[[Cell, int], int], cell: Cell, item: Any) -> int:
        made = [made for watcher in self.substituting if (made := watcher.begins(cell, item)) is not None]
        if not made:
            return original(cell, 1)
        with Swaps() as swaps:
            # A bare message is looked up in its cell's table; what carries one looks it up in its actor's.
            owner: Any = cell if isinstance(item, Message) else cell.actor
            name = "table" if owner is cell else "_table"
            swaps.put(owner, name, SubstituteTable(getattr(owner, name), made))
            return original(cell, 1)

    def watch(self, watchers: list[TurnWatcher]) -> None:
        """Let these hear of the turns, and no others."""
        self.watchers = watchers
        self.substituting = [watcher for watcher in watchers if type(watcher).begins is not TurnWatcher.begins]


class SubstituteTable(Table):
    """A table for the length of one turn: the handlers of messages are substituted."""

    def __init__(self, table: Table, substitutes: list[Substitute]) -> None:
        super().__init__()
        self._table, self._substitutes = table, substitutes

    def __getitem__(self, kind: type) -> Handler:
        handler = self._table[kind]
        if issubclass(kind, Message):
            for substitute in self._substitutes:
                handler = substitute(handler)
        return handler

    def __contains__(self, kind: object) -> bool:
        return kind in self._table

    def knows(self, kind: type) -> bool:
        return self._table.knows(kind)


class Turns:
    """Stands in for `run_turns` while any node of this process is watched."""

    def __init__(self) -> None:
        self._original: Callable[[Cell, int], int] = run_loop.run_turns
        self._nodes: dict[RunLoop, Watched] = {}
        self._holds = 0
        self._swaps = Swaps()
        self._swaps.put(run_loop, "run_turns", self.run_turns)
        self._swaps.put(RunLoop, "turn_over", self._telling(RunLoop.turn_over))

    def run_turns(self, cell: Cell, most: int) -> int:
        """Run turns of a cell as its node wants it."""
        watched = self._nodes.get(cell.node)
        return self._original(cell, most) if watched is None else watched.run(self._original, cell, most)

    def _telling(self, over: Callable[[RunLoop, Suspended, BaseException | None], None]) -> Any:
        def turn_over(node: RunLoop, turn: Suspended, error: BaseException | None) -> None:
            item = turn.item
            over(node, turn, error)
            watched = self._nodes.get(node)
            if watched is not None and item is not None:
                for watcher in watched.watchers:
                    watcher.ended(turn.cell, item)

        return turn_over

    def add(self, node: RunLoop, watcher: TurnWatcher) -> None:
        """Let the watcher hear of this node's turns."""
        if node not in self._nodes:
            self._nodes[node] = Watched()
        watched = self._nodes[node]
        watched.watch([*watched.watchers, watcher])

    def remove(self, node: RunLoop, watcher: TurnWatcher) -> None:
        """Stop; after the last watcher the loop has its own function back."""
        watched = self._nodes.get(node)
        if watched is None:
            return
        watched.watch([other for other in watched.watchers if other is not watcher])
        if not watched.watchers:
            del self._nodes[node]
        self._close()

    def hold(self, change: int) -> None:
        """Stay while anybody holds this, also where no node is watched."""
        self._holds += change
        self._close()

    def _close(self) -> None:
        if not self._nodes and not self._holds:
            self._swaps.undo()

    @staticmethod
    def installed() -> Turns:
        """What stands in already, or a new one."""
        standing = getattr(run_loop.run_turns, "__self__", None)
        return standing if isinstance(standing, Turns) else Turns()


def watch_turns(node: RunLoop, watcher: TurnWatcher) -> Callable[[], None]:
    """Let `watcher` hear of the turns of a node. Returns what ends that."""
    turns = Turns.installed()
    turns.add(node, watcher)
    return lambda: turns.remove(node, watcher)
