"""Deterministic simulation: one seed decides the order in which ready actors run and which faults strike.

A run is exact for actors in this process: on the virtual clock, one turn at a time, the next actor drawn by the seed.
The same seed gives the same run; a failure names the seed that repeats it.

Source: the simulation testing of FoundationDB (Zhou et al. 2021, section 4) and of Turmoil and madsim (Rust).
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import os
import random
from collections import deque
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from ..actors.kernel import loop as run_loop
from ..actors.kernel.cell import NEXT_URGENT, Cell
from ..actors.kernel.message import message_of
from ..checkpoint.life.recorded_inbox import Fed
from .clock import virtual
from .faults import Faults
from .guarded import GuardedSystem, UnexpectedEnd
from .leaks import Leaks, TaskLeaks
from .swaps import Swaps
from .turns import TurnWatcher, watch_turns
from .wanted import running

SEED = "HOLDFAST_SEED"
"""The environment variable that picks one seed for every simulated test of a run."""
EPOCH = 1_700_000_000.0
"""Unix time at which each simulated run begins."""
SHOWN = 20
"""Turns before a failure that are told."""


class SeededQueue(deque[Cell]):
    """The run queue: whoever is ready is drawn by the seed."""

    def __init__(self, cells: Iterable[Cell], draw: random.Random) -> None:
        super().__init__(cells)
        self._draw = draw

    def popleft(self) -> Cell:
        if len(self) > 1:
            self.rotate(-self._draw.randrange(len(self)))
        return super().popleft()


class Simulation(TurnWatcher):
    """One run of a system under a seed.

    Attributes:
        seed: what decides.
        trace: (address, what was handled) of each turn, in the order in which they began.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.trace: list[tuple[str, str]] = []
        self._draw = random.Random(seed)
        self._swaps = Swaps()
        self._ticks = 0.0
        self._unwatch: Callable[[], None] | None = None

    def install(self, system: GuardedSystem) -> None:
        """From here on the seed decides. On a loop with a virtual clock, or the run is not exact."""
        node = system.node
        self._swaps.put(node, "ready", SeededQueue(node.ready, self._draw))
        self._swaps.put(node, "most", 1)
        self._swaps.put(node, "stride", run_loop.STRIDE)
        self._swaps.put(node, "wall", lambda: EPOCH + node.loop.time())
        self._swaps.put(run_loop, "MOST", 1)  # One turn, and the next actor is drawn.
        self._swaps.put(run_loop, "clock", self._clock)
        self._unwatch = watch_turns(node, self)

    def remove(self) -> None:
        """Leave the system as it was."""
        self._swaps.undo()
        if self._unwatch is not None:
            self._unwatch()

    def _clock(self) -> float:
        """The run loop's measure of its slices: how long they are is the seed's, too, and not the machine's."""
        self._ticks += run_loop.SLICE * self._draw.random()
        return self._ticks

    def begins(self, cell: Cell, item: Any) -> None:
        self.trace.append((cell.path, _told(cell, item)))


def _told(cell: Cell, item: Any) -> str:
    """What a turn handles, in a word or two."""
    if item is NEXT_URGENT:
        commands = cell.more.urgent if cell.more is not None else None
        item = commands[0] if commands else item
    elif isinstance(item, Fed):
        feed = item.feed
        return feed.name.rpartition(":")[2] or feed.kind
    message = message_of(item)
    return type(item if message is None else message).__name__


def simulate(
    test: Callable[..., Coroutine[Any, Any, None]] | None = None,
    *,
    seeds: int = 200,
    seed: int | None = None,
    **options: Any,
) -> Any:
    """Run an async test under many seeds, each on a virtual clock with a system of its own.

    The test takes `system` (a running GuardedSystem) and, if it names them, `faults` (the seed's `Faults`) and
    `simulation`. Whatever else it takes are fixtures; they are made once, for all seeds, and must not be async. What
    the marker `holdfast` says holds for each seed. `@given` may stand above: each example runs under all seeds.

    Args:
        test: the test; `@simulate` alone takes the defaults.
        seeds: how many: 0, 1, ..., seeds - 1.
        seed: only this one. The environment variable HOLDFAST_SEED says the same, for all tests.
        options: for ActorSystem.

    Raises:
        whatever the test raises, with a note that names the seed.
    """
    if test is None:
        return functools.partial(simulate, seeds=seeds, seed=seed, **options)
    if seeds < 1:
        raise ValueError(f"simulate takes one seed or more, not seeds={seeds}")
    if not inspect.iscoroutinefunction(test):
        raise TypeError(f"@simulate takes an `async def` test, not {test!r}")
    wanted = inspect.signature(test).parameters
    own = {name for name in ("system", "faults", "simulation") if name in wanted}

    signature = inspect.Signature([parameter for name, parameter in wanted.items() if name not in own])

    @functools.wraps(test)
    def run(*args: Any, **fixtures: Any) -> None:
        given = signature.bind(*args, **fixtures).arguments  # By name: ours may stand in front of them.
        leaks = None if running.get().leaks else Leaks()
        for chosen in _seeds(seeds, seed):
            run_seed(functools.partial(test, **given), chosen, own, options)
        left = [] if leaks is None else leaks.outside()
        if left:
            raise UnexpectedEnd(tuple(left))

    run.__signature__ = signature  # type: ignore[attr-defined]  # what pytest looks for fixtures in
    del run.__wrapped__  # else pytest-asyncio and checkers see the async function
    return run


def _seeds(count: int, chosen: int | None) -> Iterable[int]:
    said = os.environ.get(SEED, "")
    if said:
        return [int(said)]
    return range(count) if chosen is None else [chosen]


def run_seed(
    test: Callable[..., Coroutine[Any, Any, None]], seed: int, own: Iterable[str], options: dict[str, Any]
) -> Simulation:
    """One run. Returns what happened.

    Raises:
        whatever the test raises, with a note that names the seed and shows the last turns.
    """
    simulation = Simulation(seed)
    faults = Faults(seed)
    try:
        with asyncio.Runner(loop_factory=virtual) as runner:
            runner.run(_run(test, simulation, faults, set(own), options))
    except BaseException as error:
        if not isinstance(error, KeyboardInterrupt):
            error.add_note(_note(simulation, faults))
        raise
    return simulation


async def _run(test: Any, simulation: Simulation, faults: Faults, own: set[str], options: dict[str, Any]) -> None:
    wanted, leaks = running.get(), TaskLeaks()
    options = {"seed": simulation.seed, **wanted.options, **options}
    system = GuardedSystem(**options)
    try:
        async with system:
            wanted.tell(system)
            simulation.install(system)
            given = {"system": system, "faults": faults, "simulation": simulation}
            try:
                await test(**{name: given[name] for name in own})
            finally:
                faults.end()
    finally:
        simulation.remove()  # The end of the actors is still the seed's.
    problems = [*system.problems(), *([] if wanted.leaks else await leaks.told())]
    if problems:
        raise UnexpectedEnd(tuple(problems))


def _note(simulation: Simulation, faults: Faults) -> str:
    seed, turns = simulation.seed, simulation.trace[-SHOWN:]
    lines = [f"seed={seed}: repeat it with @simulate(seed={seed}) or {SEED}={seed}"]
    lines += [f"struck: {strike}" for strike in faults.strikes]
    if turns:
        lines.append(f"the last {len(turns)} of {len(simulation.trace)} turns:")
        lines += [f"  {path}: {what}" for path, what in turns]
    return "\n".join(lines)
