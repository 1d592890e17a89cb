"""One migration of a live actor: the same life at another place.

A move has two sides: where the life leaves (`Leaving`), and where it enters (`Entering`). The new place is made ready;
the old life is brought to rest between two turns; the new one comes up, and handles nothing; then, in one place of the
code, it becomes the one. Until then the old life is only at rest, and goes on if anything fails. At each instant one of
the two lives may handle messages, and this process decides which.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import Awaitable, Callable, Generator
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from ..errors import CannotMove, StartFailed
from ..exit_reasons import ExitReason, Shutdown
from ..kernel.cell import RUNNING, Cell, Host
from .luggage import Stays
from .quiesce import ATTEMPTS, Transit, obey_commands
from .words import Incoming, say

if TYPE_CHECKING:
    from ..kernel.actor import Actor
    from ..kernel.envelope import Ask, Item
    from ..kernel.mailbox import Bound
    from ..process.wire.frames import Migrate
    from ..process.worker_pool import Worker

T = TypeVar("T")


UNWANTED = "it is not wanted any more"


class CommitGate:
    """Where a change that is ready waits for leave to be made, so that several are made at the same instant.

    Whoever has the gate can give up the change for which it was made, and no other one of the same actor.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.opened: asyncio.Future[None] = loop.create_future()
        self.reached: asyncio.Future[None] = loop.create_future()
        self.closed: asyncio.Future[None] = loop.create_future()
        self.is_waiting = False
        self.lives_ended = 0
        """How many lives have ended before they were at rest, so that the change of the next one was begun."""

    @property
    def is_closed(self) -> bool:
        """Whether the change is not to be."""
        return self.closed.done()

    def open(self) -> None:
        """All that comes may pass from now on."""
        if not self.opened.done():
            self.opened.set_result(None)

    def close(self) -> None:
        """Nothing passes any more, also what comes later; what is on its way here is given up."""
        if not self.closed.done():
            self.closed.set_result(None)
        self.open()

    def on_closed(self, give_up: Callable[[str], None]) -> None:
        """Have a change that is on its way here told when it is not to be."""
        self.closed.add_done_callback(lambda closed: give_up(UNWANTED))

    def passage(self) -> CommitGate:
        """A gate on the way to this one: all may pass, until this one is closed."""
        before = CommitGate(self.opened.get_loop())
        before.open()
        self.closed.add_done_callback(lambda closed: before.close())
        return before

    @contextlib.contextmanager
    def waiting(self) -> Generator[asyncio.Future[None]]:
        """A change is ready, and waits for the future that it is given, or gives up."""
        self.is_waiting = True
        if not self.reached.done():
            self.reached.set_result(None)
        try:
            yield self.opened
        finally:
            self.is_waiting = False
            if self.reached.done():
                self.reached = self.opened.get_loop().create_future()


@dataclasses.dataclass
class Luggage:
    """What a life takes along. Of a recorded one that is little: its home has the rest, and stays where it is."""

    suspended: bool = False
    traps: bool = False  # `ctx.trap_exits`
    was_left: bool = True  # A turn that had begun was left at rest: what is ordered may come before it.
    state: bytes = b""  # packed with its handles, as `luggage.unpack` reads it
    rest: dict[str, Any] = dataclasses.field(default_factory=dict)
    data: bytes = b""  # its variables alone, as a snapshot has them
    restore: Callable[[Actor], None] = lambda actor: None  # gives them to an actor in this process
    stash: list[Any] = dataclasses.field(default_factory=list)
    owed: dict[int, Ask] = dataclasses.field(
        default_factory=dict[int, "Ask"]
    )  # promised replies, by the numbers in the state
    # These are known when the new life is up:
    queue: list[Any] = dataclasses.field(default_factory=list)
    waiting: list[Any] = dataclasses.field(default_factory=list)  # for room in a bounded mailbox, behind the queue
    timers: list[Any] = dataclasses.field(default_factory=list)  # those that are not in `rest`
    bound: Bound | None = None


class Side:
    """One of the two places of a move."""

    move: Move

    @property
    def cell(self) -> Cell:
        """The address."""
        return self.move.cell


class Leaving(Side):
    """The place that a life leaves."""

    async def quiesce(self) -> None:
        """Bring the life to rest, and have its luggage.

        Raises:
            CannotMove: it does not come to rest in time, or cannot leave.
        """
        raise NotImplementedError

    async def let_go(self) -> None:
        """The new life is up: what has come to the old place meanwhile comes too."""

    def part(self) -> list[Item]:
        """The address has no life here any more; returns the commands that had been given to it."""
        raise NotImplementedError

    def retire(self) -> None:
        """What is left here ends. The new life is the one."""

    def resume(self) -> None:
        """The life goes on here, if it has come to rest at all: it does not move."""
        raise NotImplementedError


class Entering(Side):
    """The place that a life enters."""

    to: ClassVar[str]
    host: Host

    async def prepare(self) -> None:
        """Make the place ready; the old life works on."""

    def owe(self, ask: Ask) -> int:
        """The number under which this place answers an ask that the life has promised to answer.

        Raises:
            Stays: it cannot.
        """
        raise Stays("an ask waits for its reply, which it could not give from another place")

    def packed(self, actor: Actor) -> None:
        """The life is at rest in this process: take what this place needs of it."""

    async def begin(self) -> None:
        """Bring the new life up; it handles nothing yet.

        Raises:
            CannotMove, StartFailed: it could not be.
        """
        raise NotImplementedError

    def take_over(self) -> list[Item]:
        """The new life is the address's; returns the commands that it had been given before it was."""
        raise NotImplementedError

    def go_on(self) -> None:
        """It handles what waits from now on."""

    async def went_on(self) -> None:
        """Wait until it is known when the actor went on, if that is worth it."""

    def settled(self) -> None:
        """All others know where the actor lives."""

    def discard(self) -> None:
        """The new life is not to be."""
        raise NotImplementedError


class Staying(Entering):
    """No other place."""

    to = "nowhere"

    async def begin(self) -> None:
        """There is no other life."""

    def discard(self) -> None:
        """There is none."""


class Move:
    """One move; `run` carries it out."""

    stays = False
    """Whether the life only comes to rest, and goes on where it is."""

    def __init__(self, cell: Cell, leaving: Leaving, entering: Entering, timeout: float) -> None:
        self.cell, self.leaving, self.entering, self.timeout = cell, leaving, entering, timeout
        self.attempt = next(ATTEMPTS)
        self.node = cell.node
        self.luggage = Luggage()
        self.given_up: asyncio.Future[str] = self.node.loop.create_future()
        self.transit: Transit | None = None
        self.rest_at = self.gone_on_at = 0.0
        self.is_bound = False  # the old place has let the life go: there is no way back
        self.is_done = False
        self.is_late = False  # its life has ended before it was at rest
        self.gate: CommitGate | None = None  # it waits there when all is ready
        self.moved: Callable[[], None] = lambda: None  # called at once when the new life is the one
        self.ending: asyncio.Future[None] | None = None  # of what is not needed any more
        self._hearing = contextlib.ExitStack()
        leaving.move = entering.move = self

    async def run(self) -> None:
        """Move the actor.

        Raises:
            CannotMove, StartFailed, ProcessUnavailable: why it stays; it goes on as if nothing had been.
        """
        leaving, entering = self.leaving, self.entering
        ended = self.cell.ended()
        ended.add_done_callback(self._life_ended)
        if self.gate is not None:
            self.gate.on_closed(self.give_up)
        try:
            await entering.prepare()
            await leaving.quiesce()
            await entering.begin()
            await self._allowed()
            await leaving.let_go()
            if not self.is_done:
                self.commit()
            await entering.went_on()
        except BaseException as error:
            if not self.is_done:
                entering.discard()
                leaving.resume()
            if isinstance(error, StartFailed):
                raise CannotMove(self.cell.path, f"its new life could not begin ({error.reason})") from error
            raise
        finally:
            self._hearing.close()
            enders = self.cell.extra().enders
            if enders is not None and ended in enders:
                enders.remove(ended)

    async def _allowed(self) -> None:
        """Wait for leave to go on, for as long as it takes. Raises CannotMove: it was given up meanwhile."""
        if self.gate is None:
            return
        if not self.gate.opened.done():
            with self.gate.waiting() as opened:
                await asyncio.wait((opened, self.given_up), return_when=asyncio.FIRST_COMPLETED)
        if self.gate.is_closed:
            self.give_up(UNWANTED)
        if self.given_up.done():
            raise CannotMove(self.cell.path, self.given_up.result())

    def commit(self) -> None:
        """From here on the new life is the one: nowhere else is it decided where an address lives.

        A side that hears the last word calls this itself, so that nothing else is heard in between.

        Raises:
            CannotMove: it is not to be.
        """
        cell, leaving, entering = self.cell, self.leaving, self.entering
        if self.given_up.done() and not self.is_bound:
            raise CannotMove(cell.path, self.given_up.result())
        self._over()
        assert self.transit is not None
        self.is_done = True
        tap = cell.extra().tap
        if tap is not None:
            tap.detach()
        commands = leaving.part()
        commands = [*entering.take_over(), *commands]
        if tap is not None:
            tap.attach()
        self.transit.over(cell, entering.host)
        entering.go_on()
        leaving.retire()
        obey_commands(cell, commands)
        self.moved()
        entering.settled()

    def _over(self) -> None:
        """Raises CannotMove: its life has ended."""
        if self.cell.state is not RUNNING:
            self.is_late = True
            raise CannotMove(self.cell.path, "its life has ended")

    def _life_ended(self, ended: asyncio.Future[ExitReason]) -> None:
        self.is_late = True
        self.give_up("its life has ended")

    def give_up(self, why: str) -> None:
        """Whatever the move waits for: it is not to be."""
        if not self.given_up.done():
            self.given_up.set_result(why)

    async def within(self, work: Awaitable[T], seconds: float, why: Callable[[], str]) -> T:
        """What comes of `work`.

        Raises:
            CannotMove: nothing within the time, or the move was given up.
        """
        future = asyncio.ensure_future(work)
        try:
            await asyncio.wait((future, self.given_up), timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            future.cancel()
            raise
        if future.done() and (not self.given_up.done() or future.exception() is not None):
            return future.result()
        future.cancel()
        if self.given_up.done():
            raise CannotMove(self.cell.path, self.given_up.result())
        raise CannotMove(self.cell.path, f"{why()} within {seconds:g} s")

    def say(self, worker: Worker, step: str, **told: Any) -> None:
        """Tell the process at the other end of the move, which begins or gives up the life."""
        say(worker.connection, self.cell.path, self.attempt, step, **told)

    def say_now(self, worker: Worker, step: str, **told: Any) -> None:
        """The same, not with whatever else is said in this tick."""
        self.say(worker, step, **told)
        worker.connection.flush()

    def hear(self, worker: Worker, heard: Callable[[str, dict[str, Any]], None]) -> None:
        """Have what the process says of this attempt told to `heard`, until the move is over."""
        incoming = Incoming(imports=False)

        def taken(frame: Migrate) -> None:
            told = incoming.take(frame)
            if told is not None:
                heard(frame.step, told)

        worker.movers[self.attempt] = taken
        self._hearing.callback(worker.movers.pop, self.attempt, None)

    def at_rest(self) -> None:
        """The old life handles nothing any more."""
        self.transit = Transit(self.cell.host, self.give_up)
        self.cell.host = self.transit

    def reason(self) -> ExitReason:
        """What the old life's `on_stop` is told."""
        return Shutdown(f"moved {self.entering.to}")


class Pause(Move):
    """A recorded life comes to rest where it is, with a snapshot, and goes on there when it has leave to."""

    stays = True

    def __init__(self, cell: Cell, leaving: Leaving, timeout: float) -> None:
        super().__init__(cell, leaving, Staying(), timeout)

    def commit(self) -> None:
        self._over()
        self.is_done = True
        self.leaving.resume()
