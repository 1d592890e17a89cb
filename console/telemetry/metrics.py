"""Metrics of a running system, for `prometheus_client`: read at each scrape, free between two of them.

It needs the extra `metrics`: `pip install 'holdfast[metrics]'`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import dataclasses
import os
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from importlib.util import find_spec
from time import perf_counter
from typing import Any

if find_spec("prometheus_client") is None:
    raise ImportError(
        "holdfast.console.telemetry.metrics needs the package prometheus_client: pip install 'holdfast[metrics]'"
    )

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from ...actors.control.tracing import TURN_BOUNDS, Statistics, tap_of
from ...actors.errors import HoldfastError
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef
from ...checkpoint.store_tools.store_counts import files_of
from ...system.controls import has_process
from ...system.system import ActorSystem
from .families import Filled
from .series import Labels, Spread
from .store_times import time_store
from .survey import Survey, survey
from .tally import Tally
from .usage import usage_of

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

STORE = (0.00002, 0.00005, 0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5, 1.0, 5.0)
"""Upper bounds in seconds for what a store does: an append takes some ten microseconds, a sync some milliseconds."""
OPERATIONS = ("append", "sync", "cut", "load")
PATIENCE = 1.0
"""Seconds within which the process of an actor has to tell its statistics."""


@dataclasses.dataclass(slots=True)
class _Look:
    """What was read on the event loop for one scrape."""

    survey: Survey
    counted: dict[str, Statistics]
    pids: dict[int, str]
    late_replies: int
    dead_letters: int
    lag: float


class Metrics(Collector):
    """A collector of the metrics of one running system: `registry.register(Metrics(system))`.

    Counters of events begin when it is made, inside of the system's `async with`. It may be scraped from any thread;
    the event loop then reads what there is, a millisecond at a time, and is not held up. On the loop's own thread,
    where nothing can be waited for, a scrape gets what the one before has asked for; `asgi` has no such delay.

    Each system needs a registry of its own: `register` raises ValueError for a second `Metrics`, whose families have
    the same names.

    Args:
        system: that runs.
        addresses: whose mailboxes are told one by one; the others are added up by class.
        most: how many supervisors, processes, classes, counted actors and types of errors are told apart, each; what
            comes later is added up as "other".
        timeout: seconds that a scrape waits for the event loop. Then it gets what was read last.
    """

    def __init__(
        self,
        system: ActorSystem,
        *,
        addresses: Iterable[str | ActorRef[Any]] = (),
        most: int = 100,
        timeout: float = 5.0,
    ) -> None:
        self._system, self._timeout, self._most = system, timeout, most
        self._chosen = tuple(one if isinstance(one, str) else one.path for one in addresses)
        self._processes, self._classes = Labels(most, self._chosen), Labels(most)
        self._tally = Tally(most)
        self._store = {operation: Spread(STORE) for operation in OPERATIONS}
        self._last: _Look | None = None
        self._next: asyncio.Task[None] | None = None
        node = system._node
        node.events.add_sink(self._tally)
        time_store(system._homes.journal.engine, lambda operation, seconds: self._store[operation].add(seconds))

    # -- what prometheus_client calls -------------------------------------------------------------------------------

    def describe(self) -> Iterable[Metric]:
        """The families without values: registering needs no look at the system."""
        return Filled().all()

    def collect(self) -> Iterable[Metric]:
        """The families with their values."""
        return self._filled(self._look()).all()

    def asgi(self, registry: CollectorRegistry | None = None) -> Callable[[Scope, Receive, Send], Awaitable[None]]:
        """An ASGI app to be mounted, `app.mount("/metrics", metrics.asgi())`: it writes in a thread, not on the loop.

        Args:
            registry: what it serves; left out, this collector alone.
        """
        served: Collector = self if registry is None else registry

        async def app(scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] != "http":
                raise HoldfastError(f"metrics are served over http, not over {scope['type']}")
            accepted = [value.decode("latin-1") for name, value in scope["headers"] if name.lower() == b"accept"]
            encode, kind = choose_encoder(",".join(accepted))
            body = await asyncio.to_thread(encode, served)
            headers = [(b"content-type", kind.encode())]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": body})

        return app

    # -- reading ----------------------------------------------------------------------------------------------------

    def _look(self) -> _Look | None:
        """What there is now, or was at the last look; None before there was any."""
        node = self._system._node
        if node.is_own_thread():
            if self._next is None and node.loop.is_running():
                self._next = node.loop.create_task(self._read_next(), name="holdfast metrics")
            return self._last
        if not node.loop.is_closed():
            asked = asyncio.run_coroutine_threadsafe(self._read(perf_counter()), node.loop)
            try:
                return asked.result(self._timeout)
            except (concurrent.futures.TimeoutError, concurrent.futures.CancelledError):
                asked.cancel()  # The loop is held by somebody, or has ended.
        return self._last

    async def _read_next(self) -> None:
        try:
            await self._read(perf_counter())
        finally:
            self._next = None

    async def _read(self, asked: float) -> _Look:
        lag = perf_counter() - asked
        system = self._system
        node, numbers = system._node, system._node.numbers
        assert node.root is not None
        found = await survey(node.root, system._homes, self._classes, self._chosen)
        counted = {cell.path: counts for cell in found.watched[: self._most] if (counts := await self._counts(cell))}
        pids = system._workers.pids
        look = self._last = _Look(found, counted, pids, numbers.late_replies, numbers.dead_letters, lag)
        return look

    async def _counts(self, cell: Cell) -> Statistics | None:
        """What an actor has counted; None if its process does not say in time."""
        if not has_process(cell):
            return tap_of(cell).counts()
        try:
            return await self._system.statistics(cell.ref, timeout=PATIENCE)
        except HoldfastError:
            return None

    # -- filling in -------------------------------------------------------------------------------------------------

    def _filled(self, look: _Look | None) -> Filled:
        from ... import __version__  # it is the package's own, and the package imports nothing of this room

        out = Filled()
        out.put("holdfast_info", 1, __version__, self._system.name)
        self._fill_events(out)
        self._fill_store(out)
        if look is not None:
            _fill_look(out, look)
            self._fill_processes(out, look)
        return out

    def _fill_events(self, out: Filled) -> None:
        tally = self._tally
        out.put_all("holdfast_events_total", tally.events.values())
        out.put_all("holdfast_crashes_total", tally.crashes.values())
        out.put_all("holdfast_restarts_total", tally.restarts.values())
        out.put_all("holdfast_refused_total", tally.refused.values())
        out.put("holdfast_slow_turn_max_seconds", tally.longest_slow_turn)
        out.spread("holdfast_recovery_seconds", tally.recoveries)
        out.put_all("holdfast_recovery_phase_seconds_total", tally.phases.values())
        out.put("holdfast_replayed_turns_total", tally.replayed)
        out.spread("holdfast_snapshot_pause_seconds", tally.pauses)
        out.put("holdfast_snapshot_bytes_total", tally.snapshot_bytes)
        out.put("holdfast_snapshot_written_bytes_total", tally.written_bytes)
        out.spread("holdfast_failover_seconds", tally.failovers)

    def _fill_store(self, out: Filled) -> None:
        out.put("holdfast_store_state", self._tally.store)
        file = self._system._homes.journal.engine.file
        if file is not None:
            base = os.path.basename(file.path)
            for name, size in files_of(file.path).items():
                out.put("holdfast_store_bytes", size, name.removeprefix(base).lstrip("-") or "database")
        for operation, seconds in self._store.items():
            out.spread("holdfast_store_seconds", seconds, operation)

    def _fill_processes(self, out: Filled, look: _Look) -> None:
        used, count = usage_of(f"/{self._system.name}", look.pids, self._processes)
        out.put("holdfast_processes", count)
        for label, usage in used.items():
            out.put("holdfast_process_resident_memory_bytes", usage.resident_bytes, label)
            out.put("holdfast_process_cpu_seconds_total", usage.cpu_seconds, label)


def _fill_look(out: Filled, look: _Look) -> None:
    found = look.survey
    out.put_all("holdfast_actors", found.actors)
    for kind, queued in found.queued.items():
        out.put("holdfast_mailbox_messages", queued.total, kind)
        out.put("holdfast_mailbox_longest_messages", queued.longest, kind)
    for address, count in found.of_address.items():
        out.put("holdfast_actor_mailbox_messages", count, address)
    for address, counts in look.counted.items():
        out.put("holdfast_actor_messages_total", counts.messages_in, address, "in")
        out.put("holdfast_actor_messages_total", counts.messages_out, address, "out")
        out.spread("holdfast_actor_turn_seconds", Spread(TURN_BOUNDS, counts.turn_times, counts.turn_seconds), address)
        out.put("holdfast_actor_longest_turn_seconds", counts.longest_turn, address)
    out.put("holdfast_asks_outstanding", found.asks)
    out.put("holdfast_late_replies_total", look.late_replies)
    out.put("holdfast_dead_letters_total", look.dead_letters)
    out.put_all("holdfast_no_room_total", found.no_room)
    out.put("holdfast_quarantined_messages", found.quarantined)
    out.put("holdfast_recorded_actors", found.recorded)
    out.put("holdfast_journal_bytes", found.journal_bytes)
    out.put("holdfast_journal_open_messages", found.journal_inputs)
    for (stack, is_whole), count in found.protected.items():
        out.put("holdfast_protected_actors", count, stack, str(is_whole).lower())
    out.put("holdfast_loop_lag_seconds", look.lag)
    out.put("holdfast_scrape_seconds", found.seconds)
    out.put("holdfast_scrape_slice_seconds", found.longest_slice)
