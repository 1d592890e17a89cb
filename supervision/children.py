"""A child as its supervisor sees it, and the items through which a supervisor talks to itself."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from ..actors.errors import NoSuchActor, StartFailed, type_name
from ..actors.events import ChildStopped
from ..actors.exit_reasons import ExitReason
from ..actors.kernel.cell import Cell
from ..actors.kernel.envelope import Item
from ..actors.persistence import is_in_vain
from .admin import ChildInfo
from .spec import ChildSpec

# What a child may be in, as `WhichChildren` tells it.
STOPPED = "stopped"
STARTING = "starting"
UP = "running"
RESTARTING = "restarting"
RECOVERING = "recovering"
STOPPING = "stopping"
WITH_SUPERVISOR = "its supervisor has ended"
"""Why a child has ended, in the words of `ChildStopped`, that was stopped by its supervisor at its own end."""


@dataclasses.dataclass(slots=True, eq=False)
class Child:
    """A child as its supervisor sees it."""

    spec: ChildSpec
    cell: Cell | None = None
    state: str = STOPPED
    ignored_life: int = 0  # the end of this life is known already: its start failed, or we stopped it
    attempts: int = 0  # restarts in a row without a healthy life
    restarts: tuple[float, ...] = ()  # its own recent ones, in seconds of the loop's clock without those in `away`
    away: float = 0.0  # seconds that its restarts have taken so far
    up_since: float = 0.0
    due: ExitReason | None = None  # why it is restarted, if it waits for that; None: it does not wait
    hurried: int = 0  # for which move of its supervisor it did not wait to the end
    retry: int = 0  # the number of the retry that counts; stale ones are dropped
    up: asyncio.Future[None] | None = None  # a start that is waited for outside our turn; None once it is known or void
    row: StartRow | None = None  # those that are started one after another, and it is one of them
    candidate: int = 0  # as whose candidate it was started; 0: it is none
    comes: bool = False  # it has its address, and is bound when its first life there begins
    noted: Any = None  # what its supervisor's journal says of it, if that is known
    awaited: str = ""  # the address that its start waits for, because its spec binds it to that
    waits_apart: bool = False  # and nobody waits for its start

    @property
    def is_running(self) -> bool:
        """Whether a life is lived there now, or is being brought back."""
        return self.state in (UP, RECOVERING)

    @property
    def in_vain(self) -> str:
        """Why the restart for which it waits will fail as the last one did, in words; "" if that is not known."""
        why = str(self.due) if self.state == RESTARTING and self.due is not None else ""
        return why if is_in_vain(why) else ""

    def info(self, above: str) -> ChildInfo:
        """Describe the child as `WhichChildren` tells of it."""
        return ChildInfo(self.spec.id, self.state, f"{above}/{self.spec.id}", self.spec.is_supervisor)

    def overview(self) -> dict[str, Any]:
        """Describe the child as `get_state` of its supervisor shows it; restarts count at its present address."""
        kind, lives = type_name(self.spec.start.kind), 0 if self.cell is None else self.cell.life
        said = {"kind": kind, "state": self.state, "restart": self.spec.restart, "restarts": max(0, lives - 1)}
        return said | ({"awaited": self.awaited} if self.awaited else {})


def complete(own: Cell, spec: ChildSpec) -> ChildSpec:
    """A child's spec with what is said of it elsewhere. Raises SpecError: the two do not go together."""
    completed: ChildSpec = own.node.ports.complete(spec, f"{own.path}/{spec.id}")
    return completed


def new_cell(own: Cell, one: Child) -> Cell:
    """An address below a supervisor's, for the lives of a child, which is bound as its spec says.

    Raises:
        StartFailed: a binding points nowhere. NameTaken: somebody else lives there.
    """
    one.spec = complete(own, one.spec)
    targets = _targets(own, one.spec)  # Before there is a cell: a child that cannot start leaves no name taken.
    cell = _cell_of(own, one.spec)
    _bind(cell, targets)
    return cell


def expect(own: Cell, one: Child) -> None:
    """Make the address of a child that is to come back: it is found there from now on, and what is sent to it waits.

    Raises:
        SpecError: its spec does not go with what is said of it elsewhere. NameTaken: somebody else lives there.
    """
    one.spec = complete(own, one.spec)
    cell = one.cell = _cell_of(own, one.spec)
    cell.table, one.comes = one.spec.start.kind._table, True
    cell.host.home.expect(cell)


def bind_expected(own: Cell, one: Child, cell: Cell) -> None:
    """Bind a child that was expected, for its first life begins; what was bound meanwhile stays so.

    Raises:
        StartFailed: a binding points nowhere.
    """
    targets = _targets(own, one.spec)
    known = cell.extra().bindings if cell.extra().has_more else {}
    _bind(cell, {port: target for port, target in targets.items() if port not in known})
    one.comes = False


def _targets(own: Cell, spec: ChildSpec) -> dict[str, Cell]:
    """Where the bindings of a child lead. Raises StartFailed: one of them leads nowhere."""
    node, targets = own.node, dict[str, Cell]()
    for port, path in spec.bindings.items():
        target = node.cell_at(path) if port in spec.late else node.find(path)
        if target is None:
            missing = NoSuchActor(path)
            raise StartFailed(f"{own.path}/{spec.id}", f"binding {port!r}: {missing}") from missing
        targets[port] = target
    return targets


def _cell_of(own: Cell, spec: ChildSpec) -> Cell:
    node = own.node
    cell = node.cell_below(own, spec.id, node.ports.host_for(spec))
    cell.spec = spec
    cell.extra().start = spec.start
    if spec.mailbox is not None:
        node.bound(cell, spec.mailbox)
    return cell


def _bind(cell: Cell, targets: Mapping[str, Cell]) -> None:
    is_claimed = cell.node.ports.uplink is not None  # The root has not bound it, though it may be named in a recipe.
    for port, target in targets.items():
        cell.node.bind(cell, port, target, is_claimed=is_claimed)


def tell_stopped(cell: Cell, by: str, because: str) -> None:
    """Tell that a life has ended because it was called for; see `ChildStopped`."""
    node = cell.node
    if node.events.has_listeners:
        node.emit(ChildStopped(cell.path, cell.life, cell.extra().reason, by, because))


class StartRow:
    """Children that are started one after another. Each is in one row at most: who is stopped meanwhile is in none."""

    __slots__ = ("_waiting", "current")

    def __init__(self, children: Iterable[Child], state: str) -> None:
        self._waiting = deque(children)
        self.current: Child | None = None  # whose turn it is; the others wait
        for one in self._waiting:
            one.state, one.row = state, self

    def next(self) -> Child | None:
        """The next one that is to be started."""
        while self._waiting:
            one = self._waiting.popleft()
            if one.row is self:
                return one
        return None

    def leave(self) -> None:
        """Those that wait are not started."""
        while (one := self.next()) is not None:
            one.state, one.row = STOPPED, None


LOOKS = 4
"""How often the progress of a start is looked at within its time."""


def begin_start(cell: Cell, seconds: float) -> Callable[[], None]:
    """In an actor process, see to it that it ends if a start blocks it for longer; what is returned voids that."""
    return cell.node.begin_limit(f"{cell.path} had {seconds:g} s to start", seconds)


class StartLimit:
    """The time that a start may take. A child that is brought back has it anew with all that it has handled again."""

    __slots__ = ("_cell", "_end", "_reached", "_since", "_timer", "is_over", "seconds")

    def __init__(self, one: Child) -> None:
        assert one.cell is not None
        self._cell, self.seconds = one.cell, one.spec.start_timeout or "infinity"
        self.is_over = False
        self._timer: asyncio.TimerHandle | None = None
        self._end: Callable[[], None] | None = None
        self._reached, self._since = one.cell.host.progress(one.cell), one.cell.node.loop.time()
        if not isinstance(self.seconds, str):
            self._begin(self.seconds)
            self._wait(self.seconds)

    def _begin(self, seconds: float) -> None:
        if self._end is not None:
            self._end()
        self._end = begin_start(self._cell, seconds)

    def _wait(self, seconds: float) -> None:
        cell = self._cell
        loop = cell.node.loop
        left = self._since + seconds - loop.time()
        if left <= 0:
            self.is_over = True
            cell.kill()
            return
        if self._reached is not None:
            left = min(left, seconds / LOOKS)
        self._timer = loop.call_later(left, self._look, seconds)

    def _look(self, seconds: float) -> None:
        reached = self._cell.host.progress(self._cell)
        if reached != self._reached:
            self._reached, self._since = reached, self._cell.node.loop.time()
            self._begin(seconds)
        self._wait(seconds)

    def close(self) -> None:
        """Count the time no more, because the start is over."""
        if self._timer is not None:
            self._timer.cancel()
        if self._end is not None:
            self._end()

    @property
    def told(self) -> str:
        """What is said of a start that took too long."""
        what = "did not start" if self._reached is None else "came no step further"
        return f"it {what} within {self.seconds:g} s (start_timeout)"


class RestartAgain(Item):
    """A restart that is due: after a failed attempt, or a back-off. Other requests are served before it."""

    __slots__ = ("child", "number", "reason")

    def __init__(self, child: Child, number: int, reason: ExitReason) -> None:
        self.child, self.number, self.reason = child, number, reason

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        actor._retry(item.child, item.number, item.reason)
        return None


class StartNow(RestartAgain):
    """A child that waits for its restart is started now, as its spec says. That is by order, so it does not count."""

    __slots__ = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        actor._start_now(item.child, item.number)
        return None
