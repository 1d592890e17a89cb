"""A simulated fleet: programs with whole systems, which stand by, lead and take over on simulated servers.

A program runs on the virtual clock, in the loop of the test. Servers and the post between programs are simulated, and a
seed decides what goes wrong with them. In a test with `@simulate` it decides all else, too: see `guarded_fleet`.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from contextvars import Context, copy_context
from types import TracebackType
from typing import Any, TypeAlias

from ...actors.errors import HoldfastError, SpecError
from ...cluster.leadership import LeadershipLost, Standby
from ...cluster.lines.lines import Transport
from ...cluster.ports import Engine, Unanswered
from ...cluster.servers import JoinLoop
from ...system.system import ActorSystem
from ..guarded import is_controlled
from ..schedules.choices import Choices
from ..schedules.places import ProgramPlace, inside
from .broker import NO_FAULTS, BrokerFaults, SimBroker
from .frame_faults import AS_USUAL, POST, REQUEST, Fate, SendFaults
from .post import NO_POST_FAULTS, PostFaults, SimPost, SimTransport
from .same_loop import SameLoop
from .sim_engine import SimEngine, SimLink

Body: TypeAlias = "Callable[[SimProgram], Coroutine[Any, Any, None]]"
"""What a program does: its `main`, which gets the program."""
LONGEST_END = 60.0
"""Virtual seconds that the end of a program may take."""


class ProgramHangs(HoldfastError, text="program {name} of the fleet has not ended {seconds:g} s after it was told to"):
    """A program that was told to end does not."""

    name: str
    seconds: float


class SimServers:
    """The simulated servers of one system, as one program, or a client, reaches them; see `cluster.servers.Servers`.

    Attributes:
        system: what the system is called.
        name: who reaches them so, for people.
        link: what gets through to the log, the lease and the large values, and back.
        transports: ways to other programs; each may be cut.
        fate: asked what becomes of what is sent: at which point, and to whom.
    """

    def __init__(self, broker: SimBroker, post: SimPost, system: str, name: str) -> None:
        self.system, self.name = system, name
        self.link = SimLink()
        self.link.is_struck = lambda: not self.fate(REQUEST, f"the servers of {system}").copies
        self.transports: list[SimTransport] = []
        self.fate: Callable[[str, str], Fate] = lambda at, to: AS_USUAL
        self._broker, self._post = broker, post
        self._is_cut = False

    def engine_loop(self, name: str) -> JoinLoop:
        """The loop of the test."""
        return SameLoop()

    async def open_engine(self, *, is_new: bool = True) -> Engine:
        """Connect to the log, the lease and the large values."""
        return SimEngine(self._broker, link=self.link)

    async def open_lines(self) -> tuple[Transport, str]:
        """Connect to the post; the system listens at an inbox of its own.

        Raises:
            Unanswered: nothing gets through now.
        """
        if self._is_cut:
            raise Unanswered("the post", "nothing gets through")
        made = self._post.transport(self, lambda to: self.fate(POST, to))
        self.transports.append(made)
        return made, f"inbox of {self.system}"

    def cut(self, *, log: bool = True, lines: bool = True) -> None:
        """Have nothing get through any more, to the servers of the log or to other programs, until `heal`."""
        if log:
            self.link.cut()
        if lines:
            self._is_cut = True
            for one in self.transports:
                one.is_cut = True

    def heal(self, *, log: bool = True, lines: bool = True) -> None:
        """Have everything get through again, or what is to and from the servers of the log, or other programs."""
        if log:
            self.link.heal()
        if lines:
            self._is_cut = False
            for one in self.transports:
                one.is_cut = False


class SimProgram(ProgramPlace):
    """A program of a simulated fleet; `SimFleet.start` makes it.

    Attributes:
        name: for people.
        fleet: to which it belongs.
        servers: how it reaches the servers: `cut`, `heal`, and `link.freeze` and `link.thaw`.
        system: its system, once `open` has made one.
        is_killed: whether it was.
    """

    def __init__(self, name: str, fleet: SimFleet, servers: SimServers, body: Body) -> None:
        super().__init__(name)
        self.fleet, self.servers, self._body = fleet, servers, body
        self.system: ActorSystem | None = None
        self.is_killed = False
        servers.fate = lambda at, to: fleet.frames.fate(at, self, to)
        context = copy_context()
        context.run(inside.set, self)
        self._task = asyncio.get_running_loop().create_task(self._run(), name=name, context=context)

    def open(self, name: str | None = None, *, standby: Standby | None = "warm", **options: Any) -> ActorSystem:
        """The system of this program: enter it with `async with`, which waits until the program leads.

        Args:
            name: of the system, by default that of its servers.
            standby: how it waits; None does not.
            options: further arguments of `ActorSystem`.
        """
        told: dict[str, Any] = {"store": self.servers, "standby": standby, **options}
        self.system = self.fleet.make_system(name or self.servers.system, told)
        self.systems.append(self.system)
        return self.system

    @property
    def leads(self) -> bool:
        """Tell whether its system runs: it may have been deposed without knowing it yet."""
        return self.system is not None and self.system._root is not None and not self.system.has_failed

    async def _run(self) -> None:
        try:
            while not self.is_killed:
                try:
                    await self._body(self)
                except LeadershipLost:  # As `hf.run(main, again=True)`: it stands by once more.
                    continue
                return
        except BaseException:
            if not self.is_killed:
                raise

    def kill(self) -> None:
        """End it as SIGKILL does: nothing of it reaches anybody any more, and what it has sent still arrives.

        Without `@simulate`, its tasks are cancelled, and what they do then is seen by nobody but by the test: use
        `hf.connect` rather than refs of its system.
        """
        self.is_killed = True
        self.fleet.end(self)

    def cancel(self) -> None:
        """Cut it off, and cancel what it does."""
        self.servers.cut()
        self._task.cancel()

    def stop(self) -> None:
        """Have it end in good order, as SIGTERM does."""
        self._task.cancel()

    async def ended(self) -> None:
        """Wait until it has ended.

        Raises:
            ProgramHangs: it does not. Or whatever its body raises.
        """
        if self.is_dead:
            return
        done, _ = await asyncio.wait([self._task], timeout=LONGEST_END)
        if not done:
            raise ProgramHangs(self.name, LONGEST_END)
        if not self._task.cancelled():
            self._task.result()

    def check(self) -> None:
        """Raise what its body has raised, if it has ended so."""
        if self._task.done() and not self._task.cancelled():
            self._task.result()


Party: TypeAlias = SimProgram | SimServers
"""A program, or a client by its servers."""


class SimFleet:
    """Programs, and the simulated servers by which they are one system, or several. For the virtual clock.

    Use it as an async context manager, or by the fixture `sim_fleet`.

    Attributes:
        draw: draws what a test does to the fleet, by its seed.
        post: carries what programs send each other.
        programs: all that were started and not killed.
        frames: what strikes programs where they send something; `Faults.on` installs it.
        name: what faults call it.
        parties: the servers as each program that was not killed, and each client, reaches them.

    Args:
        seed: decides all that is drawn, by the global generator of `random`, too: the context seeds that meanwhile.
        faults: how often what goes wrong with the servers of each system.
        post_faults: the same of what programs send each other.
        choices: of a simulated run: keeps what is drawn.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        faults: BrokerFaults = NO_FAULTS,
        post_faults: PostFaults = NO_POST_FAULTS,
        choices: Choices | None = None,
    ) -> None:
        self.seed, self._faults, self._choices = seed, faults, choices
        self.draw = random.Random(f"fleet {seed}")
        self.post = SimPost(seed, post_faults, choices=choices)
        self.frames = SendFaults(self.later)
        self.name = "the fleet"
        self.parties: list[SimServers] = []
        self._nowhere = Context()
        self.programs: list[SimProgram] = []
        self._brokers: dict[str, SimBroker] = {}
        self._ending: list[SimProgram] = []
        self._started = self._clients = 0
        self._splits: list[frozenset[SimServers]] = []
        self._successors: dict[SimProgram, Callable[[], None]] = {}
        self._is_closing = False

    def broker(self, system: str = "app") -> SimBroker:
        """The servers of a system, which outlive every program: `faults`, `go_away`, `expire_lease`."""
        found = self._brokers.get(system)
        if found is None:
            found = self._brokers[system] = SimBroker(self.seed, self._faults, choices=self._choices)
        return found

    def servers(self, system: str = "app") -> SimServers:
        """The servers of a system, for `hf.connect(fleet.servers("app"))` or for a program of your own."""
        self._clients += 1
        return self._reached(system, f"client {self._clients}")

    def _reached(self, system: str, by: str) -> SimServers:
        made = SimServers(self.broker(system), self.post, system, by)
        self.parties.append(made)
        return made

    def start(self, body: Body, system: str = "app", *, again: float | None = None) -> SimProgram:
        """Start one program more: `body` is its `main`, and runs again when another program has come to lead.

        Args:
            body: gets the program, and enters `program.open(...)`.
            system: of which system the servers are.
            again: seconds after which another one is started in its place when it is killed; None: none is.

        Raises:
            SpecError: `again` is no such number.
        """
        if again is not None and not again >= 0.0:
            raise SpecError("SimFleet.start", f"again= must be a number of seconds from 0 on, not {again!r}")
        self._started += 1
        name = f"program {self._started}"
        program = SimProgram(name, self, self._reached(system, name), body)
        self.programs.append(program)
        if again is not None:
            self._successors[program] = lambda: self.later(again, lambda: self._start_again(body, system, again))
        return program

    def _start_again(self, body: Body, system: str, again: float) -> None:
        if not self._is_closing:
            self.start(body, system, again=again)

    def later(self, seconds: float, call: Callable[[], None]) -> None:
        """Have something done so many seconds later, whichever programs have died meanwhile."""
        asyncio.get_running_loop().call_later(seconds, call, context=self._nowhere)

    def make_system(self, name: str, options: dict[str, Any]) -> ActorSystem:
        """A system for one of the programs."""
        told: dict[str, Any] = {"log": False, **options}
        return ActorSystem(name, **told)

    def end(self, program: SimProgram) -> None:
        """Have nothing of a program reach anybody any more."""
        program.cancel()

    def cut(self, one: Party, other: Party) -> None:
        """Let nothing through any more between two programs, or clients (by their servers), until `heal`."""
        self.post.cut(_servers_of(one), _servers_of(other))

    def split(self, *minority: Party) -> Callable[[], None]:
        """Leave these programs and clients among themselves: they reach no servers of the log, and nobody else.

        Returns what ends that; `heal` does so, too.
        """
        behind = frozenset(_servers_of(one) for one in minority)
        self._splits.append(behind)
        self.post.split(behind)
        for one in behind:
            one.link.cut()

        def heal() -> None:
            if behind in self._splits:
                self._splits.remove(behind)
                self.post.unite(behind)
                for one in behind:
                    if not any(one in split for split in self._splits):
                        one.link.heal()

        return heal

    def heal(self) -> None:
        """Let everything through again, whatever has been cut and split."""
        self.post.heal()
        self._splits.clear()
        for one in self.parties:
            one.heal()

    def kill(self, program: SimProgram | None) -> None:
        """End a program as SIGKILL does.

        Raises:
            HoldfastError: it is none: nobody leads, if this is what `leader` has said; or it is not of this fleet.
        """
        if program not in self.programs or program is None:
            why = "this one does not" if program is not None else "nobody leads; wait until `leader()` is not None"
            raise HoldfastError(f"SimFleet.kill takes a program that runs in this fleet: {why}")
        self.programs.remove(program)
        self.parties.remove(program.servers)
        self._ending.append(program)
        program.kill()
        succeed = self._successors.pop(program, None)
        if succeed is not None:
            succeed()

    def leader(self) -> SimProgram | None:
        """The program that leads, as far as is known here: the last one that has begun to."""
        return next((one for one in reversed(self.programs) if one.leads), None)

    def check(self) -> None:
        """Raise what the body of any program has raised."""
        for program in self.programs:
            program.check()

    async def __aenter__(self) -> SimFleet:
        if is_controlled(asyncio.get_running_loop()):
            raise HoldfastError("a test with @simulate gets its fleet as the parameter `fleet`, and makes no SimFleet")
        self._random = random.getstate()
        random.seed(f"random {self.seed}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await self.close()
        finally:
            random.setstate(self._random)

    async def close(self) -> None:
        """End all programs; with servers that are well, whatever was wrong with them before.

        Raises:
            ProgramHangs: one does not end. Or whatever the body of one has raised.
        """
        for broker in self._brokers.values():
            broker.faults = NO_FAULTS
        self._is_closing = True
        left, self.programs = self.programs, []
        self.heal()
        for program in left:
            program.servers.link.thaw()
            program.stop()
        for program in self._ending:
            program.servers.link.thaw()
        for program in (*self._ending, *left):
            await program.ended()
        await asyncio.sleep(LONGEST_END)  # What was late has arrived, and journals have let go of their servers.


def _servers_of(one: Party) -> SimServers:
    return one.servers if isinstance(one, SimProgram) else one
