"""One move of a live actor: made ready, brought to rest, carried over, and let go in one place; or undone.

At each instant one of the two lives may handle messages, and this process decides which. The new life is up, and has
handled nothing, when it becomes the one; until then the old one is only at rest.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Generator
from typing import TYPE_CHECKING, Any, TypeVar

from ..errors import CannotMove, StartFailed
from ..exit_reasons import ExitReason, Shutdown
from ..kernel.cell import Cell, Host
from .quiesce import ATTEMPTS, Transit
from .words import Incoming, say

if TYPE_CHECKING:
    from ..process.wire.frames import Migrate
    from ..process.worker_pool import Worker

T = TypeVar("T")


class Move:
    """One move; `run` carries it out."""

    to: str

    def __init__(self, cell: Cell, host: Host, timeout: float) -> None:
        self.cell, self.host, self.timeout = cell, host, timeout
        self.attempt = next(ATTEMPTS)
        self.node = cell.node
        self.given_up: asyncio.Future[str] = self.node.loop.create_future()
        self.transit: Transit | None = None
        self.rest_at = self.gone_on_at = 0.0
        self.is_done = False
        self.is_late = False  # its life has ended before it was at rest
        self.moved: Callable[[], None] = lambda: None  # called at once when the new life is the one
        self._hearing = contextlib.ExitStack()

    async def run(self) -> None:
        """Move the actor.

        Raises:
            CannotMove, StartFailed, ProcessUnavailable: why it stays; it goes on as if nothing had been.
        """
        ended = self.cell.ended()
        ended.add_done_callback(self._life_ended)
        try:
            await self.prepare()
            await self.take()
            await self.carry()
        except BaseException as error:
            if not self.is_done:
                self.undo()
            if isinstance(error, StartFailed):
                raise CannotMove(self.cell.path, f"its new life could not begin ({error.reason})") from error
            raise
        finally:
            self._hearing.close()
            enders = self.cell.extra().enders
            if enders is not None and ended in enders:
                enders.remove(ended)

    def _life_ended(self, ended: asyncio.Future[ExitReason]) -> None:
        self.is_late = True
        self.give_up("its life has ended")

    async def prepare(self) -> None:
        """Make the new place ready."""

    async def take(self) -> None:
        """Bring the old life to rest."""
        raise NotImplementedError

    async def carry(self) -> None:
        """Bring the new life up, and make it the one."""
        raise NotImplementedError

    def undo(self) -> None:
        """The old life goes on."""
        raise NotImplementedError

    def give_up(self, why: str) -> None:
        """Whatever the move waits for: it is not to be."""
        if not self.given_up.done():
            self.given_up.set_result(why)

    async def within(self, work: Awaitable[T], seconds: float, why: Any) -> T:
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

    def hear(self, worker: Worker) -> None:
        """Have what the process says of this attempt told to `heard`, until the move is over."""
        incoming = Incoming(imports=False)

        def taken(frame: Migrate) -> None:
            told = incoming.take(frame)
            if told is not None:
                self.heard(frame.step, told)

        worker.movers[self.attempt] = taken
        self._hearing.callback(worker.movers.pop, self.attempt, None)

    def heard(self, step: str, told: dict[str, Any]) -> None:
        """A word of the process."""

    def at_rest(self) -> None:
        """The old life handles nothing any more."""
        self.transit = Transit(self.cell.host, self.give_up)
        self.cell.host = self.transit

    @contextlib.contextmanager
    def commit(self) -> Generator[None]:
        """Within this the new life becomes the one: there is no way back from here on."""
        self.is_done = True
        tap = self.cell.extra().tap
        if tap is not None:
            tap.detach()
        yield
        if tap is not None:
            tap.attach()

    def reason(self) -> ExitReason:
        """What the old life's `on_stop` is told."""
        return Shutdown(f"moved to {'a process' if self.to == 'process' else 'a task'}")
