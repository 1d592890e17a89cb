"""A system under guard: at its end the test hears of everything unexpected that went wrong."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, TypeGuard

from ..actors.errors import HoldfastError
from ..actors.events import ActorCrashed, DeadLetter, Event, HookFailed, LifeAbandoned, ProcessDied
from ..actors.exit_reasons import Exited, ForkServerDied, Hung, OutOfMemory, Signal, TrustBreach
from ..actors.kernel.address_host import AddressHost
from ..actors.kernel.envelope import message_in
from ..actors.kernel.node import Node
from ..actors.process.worker_pool import Workers
from ..supervision.spec import ChildSpec
from ..system.system import ActorSystem
from .clock import RealTimeNeeded, VirtualClockLoop
from .guard.leaks import Leaks
from .guard.sends import Reads, SendChecks

if TYPE_CHECKING:
    from .schedules.control import ControlledLoop

CRASHES = (ActorCrashed, HookFailed, LifeAbandoned)
DEATHS = (Signal, ForkServerDied, Exited, OutOfMemory, Hung, TrustBreach)
SHOWN = 20
"""Problems of one kind that are told in full."""


class Expected:
    """How often something may happen: never, any number of times, or exactly so often."""

    def __init__(self) -> None:
        self.any = False
        self.count = 0

    def expect(self, count: int | None) -> None:
        """Any number if `count` is None."""
        if count is None:
            self.any = True
        else:
            self.count += count

    def problem(self, what: str, happened: list[Event]) -> str | None:
        """What is wrong, as text; None if nothing is."""
        if self.any or len(happened) == self.count:
            return None
        hint = f"actor_system.expect_{what.replace(' ', '_')}()"
        lines = [f"  {describe(event)}" for event in happened[:SHOWN]]
        if len(happened) > SHOWN:
            lines.append(f"  ... and {len(happened) - SHOWN} more")
        expected = f"{self.count} expected" if self.count else f"none expected; if they are meant to be: {hint}"
        return "\n".join([f"{len(happened)} {what} ({expected})", *lines])


class UnexpectedEnd(HoldfastError, AssertionError, text="{problems:\n}"):
    """A guarded system saw what its test did not expect; each problem is a text."""

    problems: tuple[str, ...]


def is_controlled(loop: asyncio.AbstractEventLoop) -> TypeGuard[ControlledLoop]:
    """Whether a run is simulated in this loop."""
    if not isinstance(loop, VirtualClockLoop):
        return False
    from .schedules.control import ControlledLoop  # It takes long to import, and few tests simulate.

    return isinstance(loop, ControlledLoop)


class GuardedSystem(ActorSystem):
    """An ActorSystem for tests. It notes crashes and dead letters, and checks what is sent.

    Args:
        as `ActorSystem`; but it does not log, and its actors' random numbers are the same each time.

    `verify` (after the end) raises what was not expected.
    """

    def __init__(self, name: str = "app", *, log: bool = False, seed: int | None = 1, **options: Any) -> None:
        super().__init__(name, log=log, seed=seed, **options)
        self.crashes: list[Event] = []
        self.letters: list[Event] = []
        self._expected_crashes, self._expected_letters = Expected(), Expected()
        self._checks: SendChecks | None = None
        self._ends = False
        self.are_exceptions_expected = False

    async def __aenter__(self) -> GuardedSystem:
        await super().__aenter__()
        self._node.events.add_sink(self._note)
        self._checks = SendChecks(self._node)
        return self

    def _make_pool(self, node: Node) -> Workers:
        loop = asyncio.get_running_loop()
        if is_controlled(loop):
            from .schedules.processes import SimulatedWorkers

            return SimulatedWorkers(node, loop)
        return super()._make_pool(node)

    def _host_for(self, spec: ChildSpec) -> AddressHost:
        loop = self._node.loop
        if spec.isolation == "process" and isinstance(loop, VirtualClockLoop) and not is_controlled(loop):
            raise RealTimeNeeded(f"{spec.id!r} with isolation='process'")
        return super()._host_for(spec)

    async def shutdown(self) -> None:
        # What is still queued when the test is over was never waited for: its end is no news.
        if not self._ends and self._checks is not None:
            self._checks.last_look()
        self._ends = True
        try:
            await super().shutdown()
        finally:
            if self._checks is not None:
                self._checks.close()

    def expect_dead_letters(self, count: int | None = None) -> None:
        """Dead letters (refused tells among them) are part of this test: exactly `count` more, or any number."""
        self._expected_letters.expect(count)

    def expect_crashes(self, count: int | None = None) -> None:
        """Crashes of actors and deaths of their processes are part of this test: exactly `count` more, or any number.

        A process that is killed from outside is one, too; `ref.kill()` is not.
        """
        self._expected_crashes.expect(count)

    def expect_sends(self) -> None:
        """Do not complain of messages that are mutated after they were sent."""
        if self._checks is not None:
            self._checks.is_expected = True

    def succeed(self, before: GuardedSystem) -> None:
        """Go on for a system whose root was killed: what the test expects holds on, and what it has seen counts on."""
        before.was_killed()
        self.crashes, before.crashes = before.crashes, []
        self.letters, before.letters = before.letters, []
        of_the_killed = Expected()
        of_the_killed.expect(None)  # What is still told there is only how it is taken apart.
        self._expected_crashes, before._expected_crashes = before._expected_crashes, of_the_killed
        self._expected_letters, before._expected_letters = before._expected_letters, of_the_killed
        self.are_exceptions_expected = before.are_exceptions_expected
        if self._checks is not None and before._checks is not None:
            self._checks.expect_as(before._checks)

    def was_killed(self) -> None:
        """Nothing of it runs any more: what is still told there is only how it is taken apart."""
        self._ends = True
        self.look_away()

    def join(self, others: GuardedSystem) -> None:
        """Have what a test expects of others, crashes and dead letters, hold of this one and them together."""
        self.crashes, self.letters = others.crashes, others.letters
        self._expected_crashes, self._expected_letters = others._expected_crashes, others._expected_letters

    def expect_replies(self) -> None:
        """Do not complain of replies that share an object with the state of the actor that gave them."""
        if self._checks is not None:
            self._checks.are_replies_expected = True

    def expect_types(self) -> None:
        """Let messages be sent whose fields have other types than they declare, from now on."""
        if self._checks is not None:
            self._checks.are_types_expected = True

    def expect_exceptions(self) -> None:
        """Do not complain of exceptions in tasks, futures and callbacks of this test that nobody has seen."""
        self.are_exceptions_expected = True

    @property
    def asks(self) -> Mapping[asyncio.Future[Any], tuple[str, object]]:
        """List what was asked, and of whom, by the futures that somebody still holds."""
        return {} if self._checks is None else self._checks.asks

    def read_along(self, reads: Reads) -> None:
        """Tell of each message and reply that is looked at."""
        if self._checks is not None:
            self._checks.reads = reads

    def look_away(self) -> None:
        """Do not look at messages from now on: that takes most of the time of a run with many."""
        if self._checks is not None:
            self._checks.close()

    def _note(self, event: Event) -> None:
        if isinstance(event, CRASHES) or (isinstance(event, ProcessDied) and isinstance(event.reason, DEATHS)):
            self.crashes.append(event)
        elif isinstance(event, DeadLetter) and not self._ends:
            self.letters.append(event)

    def problems(self) -> list[str]:
        """List what happened and was not expected, as texts."""
        found = [
            self._expected_crashes.problem("crashes", self.crashes),
            self._expected_letters.problem("dead letters", self.letters),
            *(self._checks.problems() if self._checks is not None else ()),
        ]
        return [problem for problem in found if problem is not None]

    def verify(self) -> None:
        """Raise UnexpectedEnd if something happened that was not expected."""
        problems = self.problems()
        if problems:
            raise UnexpectedEnd(tuple(problems))


def describe(event: Event) -> str:
    """An event in one line."""
    match event:
        case ActorCrashed(life=life, reason=reason, item=item):
            return f"{event.address} (life {life}) crashed in {_brief(item)}: {reason}"
        case HookFailed(hook=hook, reason=reason):
            return f"{event.address}: {hook} raised: {reason}"
        case LifeAbandoned(life=life):
            return f"{event.address} (life {life}) went on in spite of its cancellation"
        case ProcessDied(pid=pid, reason=reason):
            return f"{event.address}: its process {pid} died: {reason}"
        case DeadLetter(message=message, why=why):
            return f"{event.address}: {_brief(message)}: {why}"
        case _:
            return f"{event.address}: {type(event).__name__}"


def _brief(item: Any) -> str:
    text = repr(message_in(item))
    return text if len(text) <= 200 else text[:200] + "..."


class Guard:
    """The systems of one test, and what must not be left when they have ended.

    Args:
        allowed: kinds of leaks (`LEAKS`) that are not told.
        exceptions: whether exceptions that nobody has seen are told.
    """

    def __init__(self, *, allowed: Collection[str] = (), exceptions: bool = True) -> None:
        self._leaks = Leaks(allowed)
        self._exceptions = exceptions
        self._systems: list[GuardedSystem] = []

    @property
    def first(self) -> GuardedSystem | None:
        """The system that was started first, if there is one."""
        return self._systems[0] if self._systems else None

    async def start(self, name: str = "app", **options: Any) -> GuardedSystem:
        """Start a system, with the options of ActorSystem; `close` ends it."""
        system = GuardedSystem(name, **options)
        await system.__aenter__()
        self._systems.append(system)
        return system

    async def close(self) -> None:
        """End every system, newest first.

        Raises:
            UnexpectedEnd: naming every leak, dead letter and crash that was not expected.
        """
        problems: list[str] = []
        try:
            unseen = self._unseen()
            for system in reversed(self._systems):
                try:
                    await system.__aexit__(None, None, None)
                except asyncio.CancelledError:
                    raise
                except HoldfastError as error:  # The tree failed; the others still have to end.
                    problems.append(f"system {system.name!r}: {error}")
                problems += system.problems()
            self._leaks.forget(self._asks())  # What the end has refused was never waited for.
            problems += [*unseen, *await self._leaks.told(), *self._leaks.outside()]
            if self._sees_exceptions():  # Now: the threads have had their time.
                problems += self._leaks.lost_in_threads()
        finally:
            self._leaks.close()
        if problems:
            raise UnexpectedEnd(tuple(problems))

    def _unseen(self) -> list[str]:
        """Before the systems end: what is asked and queued then was never waited for."""
        found = self._leaks.unseen(self._asks())
        return found if self._sees_exceptions() else []

    def _sees_exceptions(self) -> bool:
        return self._exceptions and not any(one.are_exceptions_expected for one in self._systems)

    def _asks(self) -> dict[asyncio.Future[Any], tuple[str, object]]:
        return {future: asked for system in self._systems for future, asked in system.asks.items()}
