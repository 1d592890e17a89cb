"""Deterministic simulation: one seed decides everything in which two runs of a test can differ.

Which actor has the next turn, which task of the program goes on, which of two timers at one moment fires first, which
faults strike and how late what is late comes, `random`, `uuid` and the time: see `schedules`. A failure is repeated,
shrunk, and shown.

Source: the simulation testing of FoundationDB (Zhou et al. 2021, section 4); controlled schedules: Coyote, Shuttle.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import inspect
import os
import random
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Collection, Coroutine, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Final
from unittest import SkipTest

from ..actors.errors import HoldfastError, SpecError
from ..actors.kernel.envelope import Ask
from ..actors.kernel.node import Node
from ..actors.kernel.ref import ActorRef, current
from ..actors.process import worker_node
from .charts.causes import leading
from .charts.chart_html import as_html as chart_as_html
from .charts.chart_recorder import Recorder
from .charts.chart_text import as_text as chart_as_text
from .clock import TICKS
from .faults import Faults
from .fleet.guarded_fleet import GuardedFleet
from .guard.leaks import Leaks
from .guard.loop_leaks import LoopLeaks
from .guarded import GuardedSystem, UnexpectedEnd
from .latencies import Latencies, Latency, LateReplies, Said, What, said_latencies
from .library_code import is_file_of_library
from .schedules.bound_names import BoundNames, names_of
from .schedules.choices import (
    MOMENT,
    TURN,
    Choices,
    NotRepeatable,
    Taken,
    Translated,
    as_text,
    from_text,
    repeated,
    require_fit,
    size,
)
from .schedules.control import Control, ControlledLoop
from .schedules.disk import PATH, NoRootToKill, SimulatedDisk
from .schedules.hash_seeds import (
    RANDOM,
    PassesElsewhere,
    before_command,
    hash_seed_in_words,
    here,
    parted,
    passes_elsewhere,
    require_hash_seed,
    with_hash_seed,
)
from .schedules.places import Root, inside
from .schedules.processes import no_limits
from .schedules.shrinking import FailedRun, shrink
from .schedules.strategies import DEPTH, mixed
from .schedules.strategies import strategy as strategy_of
from .schedules.time_limits import TimeLimit, is_of_time_limit
from .schedules.turn_log import Handled, HandledValues, TurnLog, parting
from .schedules.world import World
from .swaps import Swaps
from .turns import Tracer, watch_turns
from .wanted import SystemsWanted, running

SEED = "HOLDFAST_SEED"
"""The environment variable that picks one seed for every simulated test of a run."""
LOOKS = 10
"""In every so manieth run each message is looked at."""
TWICE = {"ci": 10, "nightly": 1}
"""By profile: every so manieth run is made twice, to see whether its choices repeat it. The first one is, and each that
fails."""
REAL_RUNS = 3
"""How often a test is run on a real loop, if nothing else is said."""
NIGHTLY = 25
"""So many times as many seeds are tried under the profile `nightly`."""


class NotExhausted(UserWarning):
    """An exhaustive search has ended before it had tried every schedule."""


OF_STORE: Final[tuple[What, ...]] = ("reads", "writes", "syncs")
"""What takes time only in a simulated store."""
Test = Callable[..., Coroutine[Any, Any, None]]


class Simulation:
    """One run of a system under a seed.

    Attributes:
        seed: what decides.
        trace: (address, what was handled) of each turn, in the order in which they began. Before an address in a fleet
            stands the name of the program: `program 1:/bank/ledger`.
        choices: what was chosen.
        faults: those of the seed.
        disk: the simulated store, which outlives the root; None: there is none.
        world: what the program asks the world for, in this run; None: the real one.
        is_real: whether it is none, but a run on a real loop (`--holdfast-real`).
    """

    is_real = False

    def __init__(self, choices: Choices, latency: Said = 0.0, sync: Latency = 0.0) -> None:
        self.seed, self._latencies = choices.seed, Latencies(choices, said_latencies(latency, sync))
        self.disk: SimulatedDisk | None = None
        self._store: object = None
        self._roots: list[Root] = []  # each after the first has succeeded one that was killed
        self._life = contextlib.AsyncExitStack()  # of the system that lives
        self._fleet: GuardedFleet | None = None
        self._make: Callable[[], GuardedSystem] = GuardedSystem
        self._test: asyncio.Task[Any] | None = None
        self._draw = random.Random(f"moments {choices.seed}")
        self.choices = choices
        self.trace: list[tuple[str, str]] = []
        self.faults = Faults(choices.seed, choices)
        self.world: World | None = None
        self._control: Control | None = None  # There is none before the system has been started.
        self._log = TurnLog(self.trace)
        self._over: int | None = None  # after so many turns
        self._ends: list[Callable[[], None]] = []
        self._surroundings = contextlib.ExitStack()

    def enter(self, loop: asyncio.AbstractEventLoop, names: BoundNames) -> None:
        """From here to `remove` the world is the seed's, also what a program has of it by these names."""
        assert isinstance(loop, ControlledLoop)
        self.world = self._surroundings.enter_context(World(self.seed, loop, names))

    @property
    def escaped(self) -> tuple[str, ...]:
        """List what the run has used that no seed decides."""
        return () if self.world is None else tuple(self.world.escaped)

    @property
    def system(self) -> GuardedSystem:
        """The system that the test has."""
        return self._roots[-1].system

    @property
    def fleet(self) -> GuardedFleet:
        """The fleet that the test has."""
        assert self._fleet is not None
        return self._fleet

    async def begin(
        self,
        options: dict[str, Any],
        recorder: Recorder | None = None,
        *,
        looks: bool = True,
        notes: bool = False,
        own: Collection[str] = ("system",),
    ) -> None:
        """Start what the test has, of `system` and `fleet`, or a system if it has neither; then the seed decides."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, ControlledLoop)
        has_fleet = "fleet" in own
        if has_fleet and "system" not in own and options.get("store") is not None:
            raise SpecError("simulate", "store= is of the system of the test; that of a fleet are its own servers")
        self._store = options.get("store")  # The marker of the test may name it, too.
        if self._store == PATH:
            self.disk = SimulatedDisk(loop.hold_up)
        elif said := next((what for what in OF_STORE if what in self._latencies), None):
            raise SpecError("simulate", f"{said} of the simulated store would take time: give store={PATH!r}")

        def make() -> GuardedSystem:
            if self.disk is not None:
                options["store"] = self.disk.open()
            return GuardedSystem(**options)

        self._make, self._test, self._looks = make, asyncio.current_task(), looks
        loop.latencies = self._latencies
        if "replies" in self._latencies:
            loop.late_replies = LateReplies(loop, self._latencies.of("replies"))
        swaps = self._surroundings.enter_context(Swaps())
        swaps.put(worker_node, "_apply", no_limits)

        def watch(node: Node, name: str) -> None:
            if recorder is not None:
                recorder.call(node, name)
                self._ends.append(watch_turns(node, recorder))

        root = None if has_fleet and "system" not in own else await self._start()
        node = None if root is None else root.system._node
        if recorder is not None:
            self._ends.append(recorder.listen())
        if notes:
            values = self._log.values = HandledValues(self._log)
            swaps.put(Ask, "answer", values.answering(Ask.answer))
        if loop.late_replies is not None:
            swaps.put(Ask, "answer", loop.late_replies.delaying(Ask.answer))
        self._control = Control(self.choices, self._log, node, loop, on_node=watch)
        if has_fleet:
            self._fleet = GuardedFleet(self.choices, loop, options, self._look_at)

    def _look_at(self, system: GuardedSystem) -> None:
        """Look at the messages of a system, or not."""
        if not self._looks:
            system.look_away()
        elif self.world is not None:
            system.read_along(self.world.look_for_addresses)

    async def _start(self) -> Root:
        """Start the next system, all of whose callbacks are marked as its root's."""
        root = Root(self._make())
        mark = inside.set(root)
        self._roots.append(root)
        try:
            await self._life.enter_async_context(root.system)
        except BaseException:
            self._roots.remove(root)
            _kill(root)  # What was begun of it must not go on.
            raise
        finally:
            inside.reset(mark)
        root.is_up = True
        root.system._body = self._test
        self._look_at(root.system)
        return root

    def told_of_its_end(self) -> None:
        """The test has heard that its time is over, if it is: what follows may go on to the end of its system."""
        loop = asyncio.get_running_loop()
        if isinstance(loop, ControlledLoop):
            loop.end_by(None)

    async def end(self, kind: Any = None, error: Any = None, trace: Any = None) -> None:
        """End the fleet, and the system that lives."""
        try:
            if self._fleet is not None:
                await self._fleet.close()
        finally:
            await self._life.__aexit__(kind, error, trace)

    def problems(self) -> list[str]:
        """List what happened and was not expected, as texts."""
        return [problem for system in self._systems() for problem in system.problems()]

    def asks(self) -> dict[asyncio.Future[Any], tuple[str, object]]:
        """List what was asked in the run, and of whom."""
        return {future: asked for system in self._systems() for future, asked in system.asks.items()}

    @property
    def are_exceptions_expected(self) -> bool:
        """Say whether exceptions may go unseen."""
        return any(system.are_exceptions_expected for system in self._systems())

    def _systems(self) -> list[GuardedSystem]:
        """All that there have been."""
        return [*(root.system for root in self._roots), *(() if self._fleet is None else self._fleet.systems)]

    async def moment(self, turns: int = 100) -> None:
        """Wait for a drawn number of turns of actors, and no longer than until nothing else can happen."""
        if turns < 1:
            raise ValueError(f"moment takes one turn or more, not {turns!r}")
        number = self.choices.draw(MOMENT, turns + 1, self._draw.randint(0, turns))
        if number:
            loop = asyncio.get_running_loop()
            assert isinstance(loop, ControlledLoop)
            moment: asyncio.Future[None] = loop.create_future()
            self._log.await_turns(number, moment)
            loop.rests(moment)
            await moment

    async def crash_root(self, *, power: bool = False) -> GuardedSystem:
        """SIGKILL for the process in which the system lives, at this very moment; then it is started again.

        Nothing of it runs again, and its actors' processes end with it. What it had written is in its store. The test,
        its clients, lives on: what they wait for there (asks, sends, starts) fails with AskFailed. Refs, probes and
        faults of the killed one are of no use any more. What a test expects (`expect_crashes`) holds for both.

        Args:
            power: a power cut. What was not synced is lost too, from some write on, which is drawn.

        Returns:
            The new system, with the same options, to which the program gives its tree. With `store="simulated"` it
            finds what the killed one has left; without a store, nothing.

        Raises:
            NoRootToKill: it has another store, which cannot be left so; or an actor calls; or it is being started
                again since it was killed.
        """
        if self._store not in (None, "memory", PATH):
            raise NoRootToKill(f"its store is {self._store!r}, which the killed root would still hold: take {PATH!r}")
        if current.get(None) is not None or inside.get() is not None:
            raise NoRootToKill("an actor cannot do it, only the test")
        if not self._roots:
            raise NoRootToKill("the test has no system of its own: kill a program of its fleet (fleet.kill)")
        before = self._roots[-1]
        if not before.is_up:
            raise NoRootToKill("it was killed, and is being started again")
        if not before.is_dead:  # Else the start of its successor was given up, and this is another attempt.
            self._life.pop_all()
            _kill(before)
        if self.disk is not None and power:
            self.disk.cut_power(self.choices)
        root = await self._start()
        root.system.succeed(before.system)
        return root.system

    def kill_process(self, ref: ActorRef[Any]) -> None:
        """SIGKILL for the process of an actor, at this very moment.

        Raises:
            SpecError: it has none now.
        """
        node = ref._cell.node
        systems = [*(() if self._fleet is None else self._fleet.systems), *(root.system for root in self._roots[-1:])]
        pools = [system._workers for system in systems if system._running is node]
        worker = pools[0].of(ref._cell) if pools else None
        if worker is None:
            above = ref._cell.parent
            while above is not None and not any(pool.of(above) for pool in pools):
                above = above.parent
            instead = "" if above is None else f": kill that of {above.path}, in which it lives"
            raise SpecError(ref.path, f"it has no process of its own{instead}")
        worker.forked.kill()

    @property
    def handled(self) -> list[Handled]:
        """The values of messages and replies, in order, if they were noted."""
        return [] if self._log.values is None else self._log.values.handled

    def extent(self) -> tuple[int, int]:
        """Return how many turns the test has had before it was over, and of how many actors."""
        turns = self.trace[: self._over]
        return len(turns), len({path for path, _ in turns})

    def stop_recording(self) -> None:
        """Record no more for the chart: the test is over, and how its actors end is none of it."""
        self._over = len(self.trace) if self._over is None else self._over
        while self._ends:
            self._ends.pop()()

    def remove(self) -> None:
        """Leave the system as it was."""
        if self._control is not None:
            self._control.remove()
        self.stop_recording()
        self._surroundings.close()


class RealRun(Simulation):
    """A simulated test on a real loop, with real processes: `pytest --holdfast-real`. Its seed decides only
    its faults."""

    is_real = True

    def enter(self, loop: asyncio.AbstractEventLoop, names: BoundNames) -> None:
        """The world stays as it is."""

    async def begin(
        self,
        options: dict[str, Any],
        recorder: Recorder | None = None,
        *,
        looks: bool = True,
        notes: bool = False,
        own: Collection[str] = ("system",),
    ) -> None:
        if "fleet" in own:
            raise SkipTest("a fleet of a test is always simulated: without --holdfast-real")
        if options.get("store") == PATH:
            folder = self._surroundings.enter_context(tempfile.TemporaryDirectory(prefix="holdfast-"))
            options["store"] = f"sqlite:{Path(folder, 'app.db')}"
        system = await self._life.enter_async_context(GuardedSystem(**options))
        self._roots.append(Root(system))
        self._ends.append(watch_turns(system._node, Tracer(self.trace)))

    async def moment(self, turns: int = 100) -> None:
        """Wait for a drawn number of ticks of the loop."""
        for _ in range(self._draw.randint(0, turns)):
            await asyncio.sleep(0)

    async def crash_root(self, *, power: bool = False) -> GuardedSystem:
        raise SkipTest(
            "the root of a real run is the process of the test, which cannot be killed: without --holdfast-real"
        )


def _kill(root: Root) -> None:
    """SIGKILL for the program of a root, whose system may only have begun."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, ControlledLoop)
    root.halt(loop)
    root.bury()


@dataclasses.dataclass(frozen=True)
class SimulationSettings:
    """What is said of a simulated test beside the test itself: as the arguments of `simulate`, which are refused here.

    Raises:
        SpecError, ValueError: one of them is wrong.
    """

    seeds: int = 1
    seed: int | None = None
    replay: str | None = None
    strategy: str = "mixed"
    depth: int = DEPTH
    holds: int | None = None
    latency: Said = 0.0
    sync: Latency = 0.0
    ticks: int = TICKS
    options: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ValueError(f"simulate takes one seed or more, not seeds={self.seeds}")
        if self.ticks < 1:
            raise ValueError(f"simulate takes one tick or more, not ticks={self.ticks}")
        strategy_of(self.strategy, self.depth, self.holds)
        said_latencies(self.latency, self.sync)
        if self.replay is not None:
            from_text(parted(self.replay)[0])

    def said(self, wanted: SystemsWanted, seeds: int | None = None) -> range | str:
        """The seeds to try, or the schedule to repeat. The command line and the environment have the last word."""
        file: str | None = wanted.option("replay")
        if file:
            return Path(file).read_text(encoding="utf-8").strip()
        if self.replay is not None:
            return self.replay
        chosen = wanted.option("seed")
        said = os.environ.get(SEED, "") if chosen is None else str(chosen)
        try:
            seed = int(said) if said else self.seed
        except ValueError:
            raise SpecError("simulate", f"{SEED} must be a number, not {said!r}") from None
        if seed is not None:
            return range(seed, seed + 1)
        count = seeds or self.seeds
        return range(int(wanted.option("seeds") or count * (NIGHTLY if wanted.option("profile") == "nightly" else 1)))

    def decorate(self, test: Test) -> Callable[..., None]:
        """What pytest calls in place of the test.

        Raises:
            TypeError: it is no `async def`.
        """
        if not inspect.iscoroutinefunction(test):
            raise TypeError(f"@simulate takes an `async def` test, not {test!r}")
        wanted = inspect.signature(test).parameters
        own = {name for name in ("system", "fleet", "faults", "simulation") if name in wanted}
        if "fleet" in own and self.strategy == "exhaustive":
            raise SpecError("simulate", "strategy='exhaustive' is for actors of one system, and the test has a fleet")
        signature = inspect.Signature([parameter for name, parameter in wanted.items() if name not in own])

        @functools.wraps(test)
        def run(*args: Any, **fixtures: Any) -> None:
            __tracebackhide__ = True
            given = signature.bind(*args, **fixtures).arguments  # By name: ours may stand in front of them.
            try:
                self._run_all(functools.partial(test, **given), own)
            except BaseException as error:
                raise error.with_traceback(_of_the_test(error))  # noqa: B904  # It is the same error.

        run.__signature__ = signature  # type: ignore[attr-defined]  # what pytest looks for fixtures in
        del run.__wrapped__  # else pytest-asyncio and checkers see the async function
        return run

    def _run_all(self, test: Test, own: set[str]) -> None:
        leaks = Leaks(running.get().leaks)
        try:
            if running.get().option("real"):
                run_real(test, own, self.options, self.said(running.get(), REAL_RUNS))
            else:
                ScheduleSearch(test, own, self).run()
        finally:
            leaks.close()
        if left := leaks.outside():
            raise UnexpectedEnd(tuple(left))


def simulate(
    test: Test | None = None,
    *,
    seeds: int = 200,
    seed: int | None = None,
    replay: str | None = None,
    strategy: str = "mixed",
    depth: int = DEPTH,
    holds: int | None = None,
    latency: Said = 0.0,
    sync: Latency = 0.0,
    ticks: int = TICKS,
    **options: Any,
) -> Any:
    """Run an async test under many schedules, each on a virtual clock with a system of its own.

    The test takes `system` (a running GuardedSystem), or `fleet` (a GuardedFleet: programs on simulated servers), or
    both, and, if it names them, `faults` (the seed's `Faults`) and `simulation`. Whatever else it takes are fixtures;
    they are made once, for all seeds, and must not be async. What the marker `holdfast` says holds for each seed.
    `@given` may stand above: each example runs under all seeds.

    A test is run more often than there are seeds: some runs are made twice, and a failing one is repeated while it is
    shrunk. What it leaves in its surroundings must not change the next run.

    Args:
        test: the test; `@simulate` alone takes the defaults.
        seeds: how many schedules at most: 0, 1, ..., seeds - 1. The option --holdfast-seeds says it for all tests,
            and the profile `nightly` multiplies it by 25.
        seed: only this one. The option --holdfast-seed or the environment variable HOLDFAST_SEED says the same, for
            all tests.
        replay: only this schedule, as a failure has printed it. The option --holdfast-replay FILE says the same.
        strategy: mixed, random, pct, exhaustive, coverage.
        depth: of PCT: how many events have to come in one order for the bug to show.
        holds: of `exhaustive`: every schedule in which at most so many times somebody is held up until nobody else
            could run, fewest first; None: every schedule. What it has covered is printed.
        latency: seconds that what an actor's process and the root write to each other takes: a number, (least,
            longest), a distribution of `holdfast.testing.latencies`, or a function that draws them from a
            `random.Random`. `{"starts": ..., "reads": ...}`: each by what takes it: frames, starts, reads, writes,
            syncs, replies, timers.
        sync: as `latency={"syncs": ...}`: seconds that a sync of the simulated store takes.
        ticks: at one moment of virtual time, after which the run is taken to go on there for ever (`NotIdle`). In a
            tick everything that waited at its beginning has its turn: a burst takes as many as it is deep.
        options: for ActorSystem. `store="simulated"`: a store in memory, which outlives the root (`crash_root`).

    Raises:
        whatever the test raises, with a note that shows the run and says how to repeat it. NotRepeatable: two runs with
        the same choices differ. UnfitSchedule: a run that was to be repeated passes, and is another. SpecError,
        ValueError, TypeError: the arguments are wrong.
    """
    settings = SimulationSettings(seeds, seed, replay, strategy, depth, holds, latency, sync, ticks, options)
    return settings.decorate if test is None else settings.decorate(test)


class ScheduleSearch:
    """The runs of one test, one schedule after the other, until one fails.

    Args:
        test: what is run; `own` are those of its parameters that come from here.
        settings: the strategy, the options of its systems, and so on.

    Attributes:
        runs: how many schedules have been tried.
        is_complete: whether there is no other schedule.
        covered: what has been tried, in words, once an exhaustive search has ended.
    """

    def __init__(self, test: Test, own: Iterable[str], settings: SimulationSettings) -> None:
        self.runs = 0
        self.is_complete = False
        self.covered = ""
        self._test, self._own, self._settings = test, set(own), settings
        self._strategy, self._named = (
            strategy_of(settings.strategy, settings.depth, settings.holds),
            settings.strategy,
        )
        self._wanted = running.get()
        self._failures = self._wanted.failures()
        self._twice: int = self._wanted.option("twice") or TWICE[self._wanted.option("profile") or "ci"]

    def run(self) -> None:
        """Try the schedules that are asked for; those that have failed the last time come first.

        Raises:
            as `simulate`.
        """
        said = self._settings.said(self._wanted)
        if isinstance(said, str):
            schedule, found = parted(said)
            require_hash_seed(said, self._command())
            simulation = self._try(repeated(*from_text(schedule)))
            self._forget(said)
            require_fit(schedule, simulation.choices)
            if found == RANDOM:
                warnings.warn(passes_elsewhere(said), PassesElsewhere, stacklevel=3)
            return
        passed = self._try_kept() if self._settings.seed is None and len(said) > 1 else []
        self._search(said)
        for told in passed:  # Now: where a warning is an error, the seeds have been tried all the same.
            warnings.warn(told, PassesElsewhere, stacklevel=3)

    def _try_kept(self) -> list[str]:
        """Try what has failed before. Returns what is to be told of schedules that pass only now, or only here."""
        told: list[str] = []
        if self._failures is None:
            return told
        for text in self._failures.texts():
            schedule, found = parted(text)
            self._try(repeated(*from_text(schedule)))
            if found in (None, RANDOM, here()):
                self._failures.drop(text)
            if found == RANDOM or found not in (None, here()):
                told.append(passes_elsewhere(text, self._command()))
        return told

    def _command(self) -> str:
        """What runs this test again, as it was run."""
        file = self._wanted.option("replay")
        option = f"--holdfast-replay {file} " if file else ""
        return f"pytest {option}'{self._wanted.nodeid}'" if self._wanted.nodeid else "the program again"

    def _search(self, said: range) -> None:
        """Try one seed after the other."""
        for number in said:
            if self._named == "pct" and len(said) == 1 and number:
                self._learn(self._run(strategy_of("pct").choices(0) or Choices(0)))
            choices = self._strategy.choices(number)
            if choices is None:
                break
            self.runs += 1
            looks, is_twice = number % LOOKS == 0, number % self._twice == 0
            simulation = self._try(choices, looks=looks, notes=is_twice)
            self._learn(simulation)
            if is_twice:
                self._check_repeats(simulation, looks=looks)
        if self._named == "exhaustive":
            self.is_complete, self.covered = self._strategy.choices(0) is None, self._strategy.covered(self.runs)
            if self.is_complete:
                print(self.covered)
            else:
                bound = "give" if self._settings.holds is None else "lower"
                text = f"{self.covered}: raise seeds=, {bound} holds=, or make the system smaller"
                warnings.warn(text, NotExhausted, stacklevel=3)

    def _learn(self, simulation: Simulation) -> None:
        self._strategy.learn(simulation.choices, simulation.trace)

    def _forget(self, text: str) -> None:
        if self._failures is not None:
            self._failures.drop(text)

    def _run(
        self, choices: Choices, recorder: Recorder | None = None, *, looks: bool = True, notes: bool = False
    ) -> Simulation:
        said = self._settings
        return run_schedule(
            self._test,
            choices,
            self._own,
            said.options,
            recorder,
            looks=looks,
            notes=notes,
            latency=said.latency,
            sync=said.sync,
            ticks=said.ticks,
        )

    def _try(self, choices: Choices, *, looks: bool = True, notes: bool = False) -> Simulation:
        """One run; a failure is explained.

        Raises:
            whatever the test raises.
        """
        try:
            return self._run(choices, looks=looks, notes=notes)
        except BaseException as error:
            if is_of_time_limit(error):
                error.add_note(
                    f"its time was over in the run of seed {choices.seed}, which is neither made again nor shrunk"
                )
            if not _is_failure(error):
                raise
            failure = error
        try:
            explained = self._explained(failure)
        except BaseException as error:
            if not is_of_time_limit(error):
                raise
            failure.add_note(f"the time of the test was over before this failure, of seed {choices.seed}, was shrunk")
            explained = failure
        raise explained

    def _explained(self, failure: BaseException) -> BaseException:
        """The failure of the shortest schedule that shows it, with a note; or that it cannot be repeated."""
        first: Simulation = failure.__simulation__  # type: ignore[attr-defined]
        seed, kind = first.seed, _kind(failure)

        def fails(taken: Taken) -> FailedRun | None:
            try:
                self._run(repeated(seed, taken))
            except BaseException as error:
                if not _is_failure(error):
                    raise
                again: Simulation = error.__simulation__  # type: ignore[attr-defined]
                return FailedRun(again.choices.kept(), *again.extent()) if _kind(error) == kind else None
            return None

        taken = first.choices.kept()
        recorder = Recorder()
        if fails(taken) is None:
            again, more = self._failed(seed, taken, recorder), self._failed(seed, taken)
            found = _difference(first, again) or _difference(again, more)
            difference = found or f"the run of seed {seed} fails only sometimes"
            note = "\n".join([_head(seed, None, self._is_of_seed()), *hash_seed_in_words(), str(difference)])
            for line in (note, *self._record(failure, as_text(seed, taken), recorder, note)):
                failure.add_note(line)
            return failure
        if not _in_hypothesis():  # It shrinks what it has given, and calls again for each.
            taken = shrink(self._translated(seed, taken), fails)
        recorder = Recorder()
        try:
            self._run(repeated(seed, taken), recorder)
        except BaseException as error:
            if not _is_failure(error):
                raise
            shown = error if _kind(error) == kind else failure
        else:
            shown = failure
        last: Simulation = shown.__simulation__  # type: ignore[attr-defined]
        shown.add_note(self._note(shown, last, taken, recorder))
        return shown

    def _failed(self, seed: int, taken: Taken, recorder: Recorder | None = None) -> Simulation:
        """The run of this schedule, with the values of what is handled, whether it fails or not."""
        try:
            return self._run(repeated(seed, taken), recorder, notes=True)
        except BaseException as error:
            if not _is_failure(error):
                raise
            made: Simulation = error.__simulation__  # type: ignore[attr-defined]
            return made

    def _translated(self, seed: int, taken: Taken) -> Taken:
        """The same run, kept by who is held up in it."""
        if TURN not in taken:
            return taken
        choices = Translated(seed, taken)
        try:
            self._run(choices)
        except BaseException as error:
            if not _is_failure(error):
                raise
        return choices.kept()

    def _is_of_seed(self) -> bool:
        return self._named in ("mixed", "random", "pct")

    def _note(self, failure: BaseException, simulation: Simulation, taken: Taken, recorder: Recorder) -> str:
        seed, text = simulation.seed, as_text(simulation.seed, taken)
        lines = [_head(seed, text, self._is_of_seed()), *hash_seed_in_words()]
        count = size(taken)
        lines.append(
            f"shrunk to {count} choice{'' if count == 1 else 's'} other than production's order"
            if count
            else "it needs no choice: the order of production shows it"
        )
        lines += [f"struck: {strike}" for strike in simulation.faults.strikes]
        lines += [f"not the seed's: {what}" for what in simulation.escaped]
        chart = chart_as_text(leading(recorder, failure), recorder.rows)
        if chart:
            lines.append(chart)
        if self._failures is not None:
            self._failures.add(with_hash_seed(text))
        return "\n".join([*lines, *self._record(failure, text, recorder, "\n".join(lines))])

    def _record(self, failure: BaseException, text: str, recorder: Recorder, note: str) -> list[str]:
        """Write what there is of a failure into files, if there is a folder for them; returns lines that name them."""
        folder = None if self._failures is None else self._failures.folder()
        return [] if folder is None else _written(folder, failure, text, recorder, note, self._wanted.nodeid)

    def _check_repeats(self, simulation: Simulation, *, looks: bool) -> None:
        """Make a run again by its choices.

        Raises:
            NotRepeatable: it went another way.
        """
        try:
            again = self._run(repeated(simulation.seed, simulation.choices.kept()), looks=looks, notes=True)
        except BaseException as error:
            if not _is_failure(error):
                raise
            again = error.__simulation__  # type: ignore[attr-defined]
            difference = _difference(simulation, again)
            if difference is None:
                error.add_note(f"the run of seed {simulation.seed} has passed, and failed when it was repeated")
                raise
            raise difference from error
        difference = _difference(simulation, again)
        if difference is not None:
            raise difference


def _written(folder: Path, failure: BaseException, text: str, recorder: Recorder, note: str, nodeid: str) -> list[str]:
    """Write the schedule, the chart, and what failed with all turns as text beside each other, and say where."""
    folder.mkdir(parents=True, exist_ok=True)
    turns = [f"{row.at:.6f}\t{row.source or '-'}\t{row.name}\t{row.what}\t{row.change}" for row in recorder.rows]
    said = [
        nodeid,
        *traceback.format_exception_only(failure),
        note,
        "",
        "seconds\tsender\tactor\tmessage\tchange",
        *turns,
    ]
    (folder / "failure.txt").write_text("\n".join(said) + "\n", encoding="utf-8")
    schedule, chart = folder / "schedule.txt", folder / "chart.html"
    schedule.write_text(with_hash_seed(text) + "\n", encoding="utf-8")
    page = chart_as_html(leading(recorder, failure), recorder.rows, nodeid, note)
    chart.write_text(page, encoding="utf-8")
    return [
        f"all of it as a chart: {chart}",
        f"repeat it: {before_command()}pytest --holdfast-replay {schedule} '{nodeid}'",
    ]


def _head(seed: int, text: str | None, is_of_seed: bool) -> str:
    parts = [f"@simulate(seed={seed}) or {SEED}={seed}"] if is_of_seed else []
    if text is not None:
        parts.append(f'@simulate(replay="{text}")')
    return f"seed={seed}: repeat it with {', or '.join(parts)}"


def _is_failure(error: BaseException) -> bool:
    """Whether it is the outcome of a run, and not the wish to end the test."""
    pytest = sys.modules.get("pytest")
    failed = (Exception,) if pytest is None else (Exception, pytest.fail.Exception)
    return isinstance(error, failed) and hasattr(error, "__simulation__") and not is_of_time_limit(error)


def _kind(error: BaseException) -> tuple[object, ...]:
    """What makes two failures the same: the type, and the line of the test that raised."""
    trace, last = error.__traceback__, ("", 0)
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not is_file_of_library(file):
            last = file, trace.tb_lineno
        trace = trace.tb_next
    return type(error), *last


def _of_the_test(error: BaseException) -> TracebackType | None:
    """The traceback from the test's own frame on, without those that lead there; whole if it is not in there."""
    trace = error.__traceback__
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith(_ASYNCIO) and not is_file_of_library(file):
            return trace
        trace = trace.tb_next
    return None if isinstance(error, HoldfastError) else error.__traceback__


_ASYNCIO = os.path.join(os.path.dirname(asyncio.__file__), "")


def _difference(first: Simulation, again: Simulation) -> NotRepeatable | None:
    """Where two runs by the same choices went different ways; None: nowhere."""
    escaped = tuple(dict.fromkeys([*first.escaped, *again.escaped]))
    parts = parting(first.handled, again.handled)
    if parts is not None and parts[0].is_same_kind(parts[1]):
        where, one, other = parts[0].differs(parts[1])
        return NotRepeatable(first.seed, parts[0].turn, one, other, escaped, f"{where} of {parts[0]}")
    ended = ("", "the end of the run")
    for number in range(max(len(first.trace), len(again.trace))):
        turn = first.trace[number] if number < len(first.trace) else ended
        then = again.trace[number] if number < len(again.trace) else ended
        if turn != then:
            return NotRepeatable(first.seed, number + 1, " ".join(turn).strip(), " ".join(then).strip(), escaped)
    return None if parts is None else NotRepeatable(first.seed, parts[0].turn, str(parts[0]), str(parts[1]), escaped)


def _in_hypothesis() -> bool:
    hypothesis = sys.modules.get("hypothesis")
    return hypothesis is not None and bool(hypothesis.currently_in_test_context())


def run_seed(test: Test, seed: int, own: Iterable[str], options: dict[str, Any]) -> Simulation:
    """One run under the schedule that `mixed` has for a seed. Returns what happened.

    Raises:
        whatever the test raises.
    """
    return run_schedule(test, mixed(seed), set(own), options)


def run_schedule(
    test: Test,
    choices: Choices,
    own: set[str],
    options: dict[str, Any],
    recorder: Recorder | None = None,
    *,
    looks: bool = True,
    notes: bool = False,
    latency: Said = 0.0,
    sync: Latency = 0.0,
    ticks: int = TICKS,
) -> Simulation:
    """One run under one schedule. Returns what happened.

    Args:
        recorder: draws up what happens.
        latency, sync, ticks: as `simulate` says.
        looks: whether each message is looked at, as `GuardedSystem` does: that takes most of the time of a run.
        notes: whether the values of messages and replies are noted, to be compared with those of another run.

    Raises:
        whatever the test raises; `error.__simulation__` is the run.
    """
    simulation = Simulation(choices, latency, sync)
    try:
        with asyncio.Runner(loop_factory=functools.partial(ControlledLoop, ticks=ticks)) as runner:
            loop = runner.get_loop()
            assert isinstance(loop, ControlledLoop)
            with TimeLimit(loop):
                runner.run(_run(test, simulation, own, options, recorder, looks, notes))
    except BaseException as error:
        error.__simulation__ = simulation  # type: ignore[attr-defined]
        raise
    finally:
        simulation.remove()  # Also if the loop has given up in the end of the run: the next one has a world of its own.
    return simulation


def run_real(test: Test, own: set[str], options: dict[str, Any], seeds: range | str) -> None:
    """Runs on a real loop, with real processes.

    Raises:
        whatever the test raises, with a note.
    """
    for seed in (from_text(parted(seeds)[0])[0],) if isinstance(seeds, str) else seeds:
        simulation = RealRun(Choices(seed))
        try:
            with asyncio.Runner() as runner:
                runner.run(_run(test, simulation, own, options, None, looks=True, notes=False))
        except Exception as error:
            error.add_note(
                f"seed={seed}, on a real loop (--holdfast-real): its faults are the seed's, and nothing else"
            )
            raise


async def _run(
    test: Any,
    simulation: Simulation,
    own: set[str],
    options: dict[str, Any],
    recorder: Recorder | None,
    looks: bool,
    notes: bool,
) -> None:
    wanted, faults = running.get(), simulation.faults
    leaks, unseen = LoopLeaks(wanted.leaks), list[str]()
    options = {"seed": simulation.seed, **wanted.options, **options}
    simulation.enter(asyncio.get_running_loop(), names_of(test))
    try:
        try:
            await simulation.begin(options, recorder, looks=looks, notes=notes, own=own)
            given: dict[str, Any] = {"faults": faults, "simulation": simulation}
            if "fleet" in own:
                given["fleet"] = simulation.fleet
                wanted.tell(simulation.fleet.expected)
            if "system" in own or "fleet" not in own:
                given["system"] = simulation.system
                wanted.tell(simulation.system)
            try:
                try:
                    await test(**{name: given[name] for name in own})
                    unseen = leaks.unseen(simulation.asks())
                finally:
                    faults.end()
                    simulation.stop_recording()
                    simulation.choices.end()
            except BaseException:
                simulation.told_of_its_end()
                await simulation.end(*sys.exc_info())
                raise
            await simulation.end()
        finally:
            simulation.remove()  # The end of the actors is still the seed's.
        leaks.forget(simulation.asks())
        problems = [
            *simulation.problems(),
            *([] if wanted.exceptions or simulation.are_exceptions_expected else unseen),
            *await leaks.told(),
        ]
    finally:
        leaks.close()
    if problems:
        raise UnexpectedEnd(tuple(problems))
