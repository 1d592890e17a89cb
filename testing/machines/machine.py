"""A stateful machine over a running system: rules ask, tell, crash and pass time, and Hypothesis draws the schedule.

Hypothesis calls rules one after the other, and each is synchronous; the system lives on between them in a loop of the
machine, on a virtual clock. A rule does not wait until the system has done what it was told to: how far it goes on
before the next rule is drawn, and so is who is held up meanwhile.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Coroutine, Mapping
from typing import Any, ClassVar, TypeVar

try:
    from hypothesis import note
    from hypothesis.control import current_build_context, currently_in_test_context
    from hypothesis.errors import HypothesisException
    from hypothesis.stateful import RuleBasedStateMachine, rule
except ImportError as error:
    raise ImportError(
        "holdfast.testing.ActorMachine needs the package hypothesis: pip install 'holdfast[machines]'"
    ) from error

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.message import Message
from ...actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef
from ...supervision.spec import ChildSpec
from ..barrier import idle
from ..charts.causes import leading
from ..charts.chart_recorder import Recorder
from ..charts.chart_text import as_text as chart_as_text
from ..clock import advance
from ..faults import Faults, Strikes
from ..guard.loop_leaks import LoopLeaks
from ..guarded import GuardedSystem, UnexpectedEnd
from ..histories.checker import linearizable
from ..histories.history import History, Model
from ..latencies import Said
from ..schedules.bound_names import names_of
from ..schedules.choices import ROUNDS, Choices, Production, as_text, from_text, repeated, require_fit
from ..schedules.control import ControlledLoop
from ..schedules.processes import SimulatedWorker
from ..schedules.time_limits import is_of_time_limit
from ..schedules.world import World
from ..simulation import Simulation
from ..wanted import running
from .drawn import PAUSES, Drawn
from .shrink_time import ShrinkTime

A = TypeVar("A", bound=Actor)
R = TypeVar("R")
T = TypeVar("T")

OPTIONS: Mapping[str, Any] = {"intensity": 100}
"""Crashes are what a machine does: those of its rules do not end the tree, but an actor that crashes for ever does."""
MEANT_FOR_SUBCLASSES = frozenset({"set_up", "teardown", "model", "options", "latency", "shrink_seconds"})


class ActorMachine(RuleBasedStateMachine):
    """A Hypothesis state machine over a system of actors. Subclass it: start actors in `set_up`, and write rules.

    `Machine.TestCase` is what pytest runs. At the end of each example all asks are waited for; then the system ends,
    and the example fails if there was a crash or a dead letter that was not expected, or a task is left, or if the
    history of all that was asked and told by the machine is not linearizable by `model`.

    What an example does is decided by Hypothesis alone: the rules, the schedule, the seed of random numbers, of faults
    and latencies. The note of a failure has the schedule, which `Machine(schedule="...")` repeats outside of
    Hypothesis, with the rules that Hypothesis has printed, and a chart of the turns.

    Attributes:
        model: what the history has to obey; None: it is not judged.
        options: for ActorSystem. By default its root allows 100 restarts within its period.
        latency: as `simulate` takes it.
        shrink_seconds: real seconds, >= 0, for which Hypothesis looks for a simpler example when one has failed.
            What is shown says if that was cut short.
        system: the running system; `system.expect_crashes()` and the like say what is meant to happen.
        history: of all that was asked and told through the machine.
        faults: what `inject` injects.
    """

    model: ClassVar[Model[Any] | None] = None
    options: ClassVar[Mapping[str, Any]] = {}
    latency: ClassVar[Said] = 0.0
    shrink_seconds: ClassVar[float] = 30.0

    _shrinking: ClassVar[ShrinkTime] = ShrinkTime()

    system: GuardedSystem
    history: History
    faults: Faults

    def __init__(self, schedule: str | None = None) -> None:
        super().__init__()
        self._is_drawn, self._schedule = schedule is None and currently_in_test_context(), schedule
        choices = self._choices_of(schedule)
        self.history = History()
        self._options: dict[str, Any] = {"seed": choices.seed, **OPTIONS, **running.get().options, **self.options}
        self._simulation = Simulation(choices, type(self).latency)
        self.faults = self._simulation.faults
        self._recorder = Recorder() if self._is_drawn and current_build_context().is_final else None
        self._lanes: list[asyncio.Future[Any]] = []
        self._asked: list[asyncio.Future[Any]] = []
        self._handled = sys.exc_info()[1]  # by whoever makes this machine: no failure of it
        self._runner = asyncio.Runner(loop_factory=ControlledLoop)
        loop = self._runner.get_loop()
        assert isinstance(loop, ControlledLoop)
        self._loop = loop
        self._world = self._simulation.world = World(choices.seed, loop, names_of(type(self)))
        self._leaks: LoopLeaks
        self.run(self._begin())
        try:
            self.set_up()
        except BaseException:
            self._end()
            raise

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in vars(cls):
            if not name.startswith("_") and name in vars(ActorMachine) and name not in MEANT_FOR_SUBCLASSES:
                raise TypeError(f"{cls.__name__}.{name} would hide ActorMachine.{name}: give it another name")
        if not cls.shrink_seconds >= 0:
            raise ValueError(f"{cls.__name__}.shrink_seconds must be >= 0 seconds, not {cls.shrink_seconds!r}")

    def _choices_of(self, schedule: str | None) -> Choices:
        if schedule is not None:
            return repeated(*from_text(schedule))
        return Drawn(current_build_context().data) if self._is_drawn else Production(0)

    async def _begin(self) -> None:
        wanted = running.get()
        self._leaks = LoopLeaks(wanted.leaks)
        await self._simulation.begin(self._options, self._recorder)
        self.system = self._simulation.system
        wanted.tell(self.system)

    def set_up(self) -> None:
        """Start what the rules work with. A subclass says it here, and not in `__init__`: what fails is cleaned up."""

    # -- what rules do ----------------------------------------------------------------------------------------------

    def run(self, coro: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the loop of the system, and return what it returns. The system goes on meanwhile."""
        try:
            if isinstance(self._simulation.choices, Drawn):
                self._simulation.choices.begin()
        except BaseException:  # Hypothesis ends the example: it has drawn too much.
            coro.close()
            raise
        with self._world:
            return self._runner.run(coro)

    def start(self, spec: ChildSpec[A]) -> ActorRef[A]:
        """Start a child of the root of this example's system, as `system.start` does."""
        return self.run(self.system.start(spec))

    def spawn(self, start: Start[A], name: str | None = None) -> ActorRef[A]:
        """Start an actor that nobody restarts, as `system.spawn` does."""

        async def spawned() -> ActorRef[A]:
            return self.system.spawn(start, name)

        return self.run(spawned())

    def ask(
        self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT, *, client: str | None = None
    ) -> asyncio.Future[R]:
        """Ask, and let the system go on for as long as is drawn: there may be a reply then, or none yet.

        Returns:
            The future of the reply, for `wait`. What it raises is no failure by itself: the history knows of it.
        """
        rounds = self._drawn_rounds()

        async def asks() -> asyncio.Future[R]:
            asked = self.history.ask(ref, message, timeout, client=client or self._lane())
            self._asked.append(asked)
            if client is None:
                self._enter_lane(asked)
            await self._go_on(rounds)
            return asked

        return self.run(asks())

    def tell(self, ref: ActorRef[Any], message: Message[Any], *, client: str | None = None) -> None:
        """Tell, and let the system go on. The history has it as an operation that takes effect some time, or never."""
        rounds = self._drawn_rounds()

        async def tells() -> None:
            self.history.tell(ref, message, client=client or self._lane())
            await self._go_on(rounds)

        self.run(tells())

    def wait(self, asked: asyncio.Future[R]) -> R:
        """Let the system go on, and time pass, until an ask has its outcome.

        Returns:
            The reply.

        Raises:
            what the ask raises.
        """

        async def outcome() -> R:
            return await asked

        return self.run(outcome())

    def crash_actor(self, ref: ActorRef[Any]) -> None:
        """End this life of an actor at once, in the middle of whatever it does, and let the system go on."""
        rounds = self._drawn_rounds()

        async def crashes() -> None:
            ref.kill()
            await self._go_on(rounds)

        self.run(crashes())

    def kill_process(self, ref: ActorRef[Any]) -> bool:
        """SIGKILL for the process of an actor; the crash is expected. Returns False if it has none at the moment."""
        rounds = self._drawn_rounds()

        async def kills() -> bool:
            worker = self.system._workers.of(ref._cell)
            if not isinstance(worker, SimulatedWorker) or worker.process.is_dead:
                return False
            self._simulation.kill_process(ref)
            self.system.expect_crashes(1)
            await self._go_on(rounds)
            return True

        return self.run(kills())

    def crash_root(self, *, power: bool = False) -> None:
        """Crash the root as `simulation.crash_root` does: the rule gives the new `system` its tree."""
        self.system = self.run(self._simulation.crash_root(power=power))

    def inject(self, ref: ActorRef[Any], *, at: str, **options: Any) -> Strikes:
        """Faults at a point of an actor, as `faults.on` takes them, from now to the end of the example."""

        async def injects() -> Strikes:
            return await self.faults.on(ref, at=at, **options).__aenter__()

        return self.run(injects())

    def advance(self, seconds: float) -> None:
        """Let so many seconds pass on the virtual clock, and everything happen that falls due in them."""
        self.run(advance(seconds))

    def idle(self) -> None:
        """Let the system go on until nothing can happen without more time."""
        self.run(idle(self.system))

    @rule()
    def settle(self) -> None:
        """A rule of every machine: nothing new comes until the system is idle."""
        self.idle()

    def _drawn_rounds(self) -> int | None:
        """How long the system goes on after this step."""
        return PAUSES[self._simulation.choices.draw(ROUNDS, len(PAUSES), 0)]

    async def _go_on(self, rounds: int | None) -> None:
        if rounds is None:
            await idle(self.system)
            return
        for _ in range(rounds):
            await asyncio.sleep(0)

    def _lane(self) -> str:
        """The name of a client that waits for nothing now."""
        return f"client {self._free_lane() + 1}"

    def _free_lane(self) -> int:
        return next((number for number, asked in enumerate(self._lanes) if asked.done()), len(self._lanes))

    def _enter_lane(self, asked: asyncio.Future[Any]) -> None:
        self._lanes[(lane := self._free_lane()) : lane + 1] = [asked]

    # -- the end ----------------------------------------------------------------------------------------------------

    def teardown(self) -> None:
        """End the system, and judge the example. A subclass that overrides it calls it at its end."""
        failure = sys.exc_info()[1]
        has_failed = failure is not None and failure is not self._handled
        try:
            if not has_failed:
                self.run(self._outcomes())
        except BaseException:
            has_failed = True
            raise
        finally:
            problems = self._end()
            if has_failed:
                self._note(sys.exc_info()[1] or failure)
        try:
            if problems and not has_failed:
                raise UnexpectedEnd(tuple(problems))
            if self.model is not None and not has_failed:
                linearizable(self.history, self.model).verify()
            if self._schedule is not None and not has_failed:
                require_fit(self._schedule, self._simulation.choices)
        except BaseException as error:
            self._note(error)
            raise

    async def _outcomes(self) -> None:
        """Wait for all asks: each ends by its deadline."""
        if self._asked:
            await asyncio.wait(self._asked)
        await idle(self.system)

    def _end(self) -> list[str]:
        """End the system and the loop. Returns what went wrong and was not expected."""
        self._simulation.choices.end()
        try:
            problems = self.run(self._shut_down())
        finally:
            self._simulation.remove()
            with self._world:
                self._runner.close()
        for asked in self._asked:
            if asked.done() and not asked.cancelled():
                asked.exception()  # The history knows of it; nobody else has to ask for it.
        return problems

    async def _shut_down(self) -> list[str]:
        problems: list[str] = []
        self._simulation.faults.end()
        self._simulation.stop_recording()
        try:
            await self._simulation.end()
        except HoldfastError as error:  # The tree has failed.
            problems.append(str(error))
        try:
            return [*problems, *self._simulation.problems(), *await self._leaks.told()]
        finally:
            self._leaks.close()

    def _note(self, failure: BaseException | None) -> None:
        """Print how the example went, if it is the one that Hypothesis shows."""
        if self._recorder is None or failure is None:
            if self._is_drawn and _is_failure(failure):
                self._shrinking.begin(self.shrink_seconds)
            return
        if self._shrinking.end():
            note(f"shrinking was cut short after {self.shrink_seconds:g} s (`shrink_seconds`)")
        text = as_text(self._simulation.choices.seed, self._simulation.choices.kept())
        note(f'repeat it outside of Hypothesis with {type(self).__name__}(schedule="{text}")')
        chart = chart_as_text(leading(self._recorder, failure), self._recorder.rows)
        if chart:
            note(chart)


def _is_failure(error: BaseException | None) -> bool:
    """Whether an example has failed: Hypothesis ends one that it does not want by an error, too."""
    return isinstance(error, Exception) and not isinstance(error, HypothesisException) and not is_of_time_limit(error)
