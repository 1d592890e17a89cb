"""Properties of an actor and of the process it lives in: memory, load, waiting messages, restarts (D25)."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Final

import msgspec
import psutil

from ...actors.control.orders import ObserveTurns as LookAt
from ...actors.control.orders import Status, status_of
from ...actors.control.orders_lane import ask_status, order
from ...actors.control.tracing import Statistics
from ...actors.errors import HoldfastError
from ...actors.kernel.cell import Cell
from ...actors.process.process_host import WorkerPlace
from ...actors.process.wire.peer import OutsideHost
from ..literals import Literal, atom_of
from ..messages import Grace
from .node_observer import at_root
from .observer import Manner, Observer
from .regression import Regression
from .verdicts import Filter, Limits

PATIENCE: Final = 1.0
"""Seconds an actor's process gets to answer; while it does not, its loop lags by these."""


class Property(enum.Enum):
    """The properties that can be measured of an actor and its process."""

    CPU = "cpu"
    """Percent of one core, of its process."""
    MEMORY = "memory"
    """Bytes of its process in memory."""
    DESCRIPTORS = "descriptors"
    """Open files of its process."""
    THREADS = "threads"
    """Threads of its process."""
    LOOP_LAG = "loop_lag"
    """Seconds by which the event loop of its process comes late."""
    MAILBOX = "mailbox"
    """Messages that wait for it."""
    WAITING = "waiting"
    """Seconds that its turn has taken so far, if it waits for something."""
    TURN = "turn"
    """Seconds of a turn, on average since the last look. Counting costs the actor a little per message."""
    RESTARTS = "restarts"
    """Restarts per minute, over the last minute."""
    GROWTH = "growth"
    """Bytes per second by which its process has grown over the last looks, by linear regression."""


OF_PROCESS: Final = frozenset(
    {Property.CPU, Property.MEMORY, Property.DESCRIPTORS, Property.THREADS, Property.GROWTH, Property.LOOP_LAG}
)
MINUTE: Final = 60.0
EARLY: Final = 0.001
"""Seconds by which a timer may come before its time."""


class Bound(msgspec.Struct, frozen=True):
    """While a property is within limits, the atom holds.

    Attributes:
        atom: such as `ok(matcher.memory)`.
        property: what is measured.
        limits: what is good.
        filter: makes a filter that the values go through.
    """

    atom: Literal | str
    property: Property
    limits: Limits
    filter: Callable[[], Filter] | None = None


class PropertyObserver(Observer):
    """Measures actors and their processes from outside. What cannot be measured, because it is not there, is unknown.

    Args:
        bounds: component to what is good of its properties; it may change.
        actors: component to address; it may change, and has all components with bounds that are there.
        growth_window: seconds over which `Property.GROWTH` is seen.
        manner: see `Observer`.
    """

    def __init__(
        self,
        bounds: Mapping[str, tuple[Bound, ...]],
        actors: Mapping[str, str],
        *,
        growth_window: float = 60.0,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(manner=manner)
        self._bounds, self._actors, self._growth_window = bounds, actors, growth_window
        self._meters: dict[str, _Meter] = {}
        self._restarts_of = set[Literal]()

    def on_start(self, restored: bool) -> None:
        """Begin. Raises SpecError in a process of its own."""
        at_root(self)
        super().on_start(restored)

    def spares(self, grace: Grace, about: Literal) -> bool:
        """How often others start it is just what is to be known."""
        return super().spares(grace, about) and not (grace.is_counted and about in self._restarts_of)

    def afresh(self, names: Collection[str]) -> None:
        """How one grew, and how often repair has restarted it, says nothing of after."""
        for meter in self._meters.values():
            if not meter.names.isdisjoint(names):
                meter.forget()

    async def look(self) -> None:
        """Measure all properties, and say which are within their bounds; all actors are looked at at the same time."""
        late = self.age % self.manner.every
        late = late if self.manner.every - late > EARLY else 0.0
        self._follow()
        meters, now = dict(self._meters), self.now  # They may change while actors are asked.
        asked = (meter.measure(self._cell(component), now, late) for component, meter in meters.items())
        for meter, values in zip(meters.values(), await asyncio.gather(*asked), strict=True):
            for atom, wanted, limits, smooth in meter.bounds:
                value = values.get(wanted)
                if value is not None and smooth is not None:
                    value = smooth(value)
                self.verdict(atom, None if value is None else limits.holds(value, self.said(atom)))

    def _follow(self) -> None:
        """Have a meter for each component with bounds."""
        for component in [name for name, meter in self._meters.items() if self._bounds.get(name) != meter.given]:
            for atom, _, _, _ in self._meters.pop(component).bounds:
                self.verdict(atom, None)
        for component in self._bounds.keys() - self._meters.keys():
            self._meters[component] = _Meter(self._bounds[component], self._growth_window)
        bounds = [bound for meter in self._meters.values() for bound in meter.bounds]
        self._restarts_of = {atom for atom, wanted, _, _ in bounds if wanted is Property.RESTARTS}

    def _cell(self, component: str) -> Cell | None:
        path = self._actors.get(component)
        return None if path is None else self.ctx._cell.node.find(path)


class _Meter:
    """Measures one actor, and remembers what it needs of earlier looks."""

    def __init__(self, given: tuple[Bound, ...], growth_window: float) -> None:
        self.given = given
        self.bounds = [
            (atom_of(one.atom), one.property, one.limits, one.filter() if one.filter is not None else None)
            for one in given
        ]
        self.names = {name for atom, _, _, _ in self.bounds for name in atom.args}
        self._wanted = {wanted for _, wanted, _, _ in self.bounds}
        self._process: psutil.Process | None = None
        self._counts: Statistics | None = None
        self._lives: deque[tuple[float, int]] = deque()
        self._lived: Cell | None = None
        self._growth = Regression(growth_window)

    def forget(self) -> None:
        """Somebody has acted upon it: count and look at its growth from now on."""
        self._growth.clear()
        self._lives.clear()

    async def measure(self, cell: Cell | None, now: float, late: float) -> dict[Property, float]:
        """All that is wanted, as far as it can be known; `late`: seconds by which this look comes late."""
        if cell is None:
            return {}
        values: dict[Property, float] = {Property.RESTARTS: self._restarts(cell, now)}
        status = await _status(cell, values, late)
        if status is not None and status.state in ("running", "suspended"):
            values |= {Property.MAILBOX: cell.host.backlog(cell), Property.WAITING: status.turn_seconds}
            if not OF_PROCESS.isdisjoint(self._wanted):
                values |= self._of_process(status.pid, now)
            if Property.TURN in self._wanted:
                values |= await self._turns(cell)
        return values

    def _restarts(self, cell: Cell, now: float) -> float:
        """Per minute; the first look only tells where to count from."""
        if cell is not self._lived:  # Another actor lives at the address: its lives are no restarts of the one before.
            self._lived = cell
            self._lives.clear()
        self._lives.append((now, cell.life))
        while len(self._lives) > 2 and self._lives[1][0] <= now - MINUTE:
            self._lives.popleft()
        return self._lives[-1][1] - self._lives[0][1]

    def _of_process(self, pid: int, now: float) -> dict[Property, float]:
        """What psutil says of it; nothing if it has ended meanwhile."""
        try:
            if self._process is None or self._process.pid != pid:
                self._process = psutil.Process(pid)
                self._growth = Regression(self._growth.window)
                self._process.cpu_percent(None)  # The first one has nothing to compare with.
                return {}
            with self._process.oneshot():
                memory = self._process.memory_info().rss
                values: dict[Property, float] = {
                    Property.CPU: self._process.cpu_percent(None),
                    Property.MEMORY: memory,
                    Property.THREADS: self._process.num_threads(),
                }
            if Property.DESCRIPTORS in self._wanted:
                values[Property.DESCRIPTORS] = self._process.num_fds()
        except psutil.Error:
            self._process = None
            return {}
        self._growth.add(now, memory)
        line = self._growth.fit() if self._growth.is_full else None
        return values if line is None else {**values, Property.GROWTH: line.slope}

    async def _turns(self, cell: Cell) -> dict[Property, float]:
        """The average turn since the last look; an actor that had none was not slow."""
        with contextlib.suppress(HoldfastError):
            before, self._counts = self._counts, await order(cell, LookAt(True, None), PATIENCE)
            now = self._counts
            if before is not None and now is not None and now.since == before.since and now.turns > before.turns:
                return {Property.TURN: (now.turn_seconds - before.turn_seconds) / (now.turns - before.turns)}
        return {}


async def _status(cell: Cell, values: dict[Property, float], late: float) -> Status | None:
    """Its status; how long the answer takes is how late its loop comes."""
    host = cell.host
    peer = host.peer if isinstance(host, OutsideHost) else None
    if isinstance(host.place, WorkerPlace):
        peer = host.place.process(cell)
        if peer is None:
            return None
    began = time.monotonic()
    if peer is None:
        await asyncio.sleep(0)
        values[Property.LOOP_LAG] = max(time.monotonic() - began, late)
        return status_of(cell)
    try:
        found: Status = await ask_status(peer, cell, PATIENCE)
    except HoldfastError:  # Its process has ended, or its loop does not come to it.
        values[Property.LOOP_LAG] = time.monotonic() - began
        return None
    values[Property.LOOP_LAG] = time.monotonic() - began
    return found
