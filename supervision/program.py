"""External programs as supervised children: any command, started, watched, restarted and stopped like an actor."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import re
import signal
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from ..actors import exits
from ..actors.actor import Actor, on, start
from ..actors.cell import Cell
from ..actors.errors import SpecError
from ..actors.events import HookFailed, LogLine, ProcessDied, ProcessStarted
from ..actors.exits import ExitReason
from ..actors.message import Message
from ..actors.process.kept import Kept, ProgramFailed
from ..actors.process.limits import Limits
from .backoff import Backoff
from .ready import Ready, Sign, reached
from .spec import ChildSpec, Restart, Shutdown, child

Stop: TypeAlias = int | Sequence[str] | Callable[[int], Awaitable[object] | object]
"""How a program is asked to end: a signal, a command, or a function that is given its pid."""

LINES = 20
"""Lines of output that are remembered."""
SLACK = 10.0
"""Seconds that a program's actor may take longer than `shutdown`: it is not to be killed before its program is."""


class ProgramStatus(msgspec.Struct, frozen=True):
    """How a program is: its pid, seconds since its start, and its last lines of output, oldest first."""

    pid: int
    uptime: float
    lines: list[str]


class ProgramInfo(Message[ProgramStatus]):
    """Asks a `Program` how it is."""


@dataclasses.dataclass(frozen=True, slots=True)
class Order:
    """What a program is and how it is started and stopped. Made by `program`."""

    command: tuple[str, ...]
    ready: Ready | None
    ready_timeout: float
    stop: Any
    shutdown: Shutdown
    env: dict[str, str | None]
    cwd: str | None
    limits: Limits | None


class Program(Actor):
    """Owns one external program: its life is the program's life. Built by `program(...)`."""

    deterministic = False

    def __init__(self, order: Order) -> None:
        self._order = order
        self._kept: Kept | None = None
        self._is_up = False
        self._lines: deque[str] = deque(maxlen=LINES)
        self._sign: Sign | None = None
        self._since = 0.0

    # -- start ------------------------------------------------------------------------------------------------------

    async def on_start(self, restored: bool) -> None:
        """Start the program and wait until it is ready; if it is not, it is stopped and the start has failed."""
        own, remains = self.ctx.path, self.ctx.cell.node.remains
        if left := [ended for ended, address in remains.items() if address == own]:
            await asyncio.wait(left)  # The last life was killed: its program must be gone before the next one begins.
        order = self._order
        self._sign = None if order.ready is None else Sign(order.ready)
        kept = self._kept = self._keep(order.command)
        self._since = self._now()
        kept.ended.add_done_callback(self._ended)
        pid = await asyncio.shield(kept.started)
        self.ctx.cell.node.emit(ProcessStarted(self.ctx.path, pid))
        if self._sign is not None:
            await self._until_ready(kept, self._sign)
        self._is_up = True
        if kept.ended.done():  # At once: nobody was there yet to be told.
            self.ctx.stop(kept.ended.result())

    def _keep(self, command: Sequence[str]) -> Kept:
        order = self._order
        kept = Kept(
            self.ctx.cell.node,
            command,
            env=_environment(order.env),
            cwd=order.cwd,
            limits=order.limits,
            on_line=self._line,
        )
        _Leash(self.ctx.cell, kept)
        return kept

    async def _until_ready(self, kept: Kept, sign: Sign) -> None:
        """Wait for the sign.

        Raises:
            ProgramFailed: it did not come in time, or the program ended before.
        """
        timeout = self._order.ready_timeout
        waiting = self.ctx.cell.node.loop.create_task(reached(sign), name=f"ready of {self.ctx.path}")
        try:
            first: set[asyncio.Future[Any]] = {waiting, kept.ended}
            await asyncio.wait(first, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            if kept.ended.done():
                raise self._failed(f"it ended before it was ready: {kept.ended.result()}")
            if not waiting.done():
                raise self._failed(f"it was not ready after {timeout:g} s")
            try:
                waiting.result()
            except Exception as error:
                raise self._failed(f"`ready` raised {type(error).__name__}: {error}") from error
        finally:
            waiting.cancel()
            sign.close()

    def _failed(self, why: str) -> ProgramFailed:
        last = "\n".join(self._lines)
        return ProgramFailed(self._order.command[0], f"{why}; its last lines:\n{last}" if last else why)

    # -- while it runs ----------------------------------------------------------------------------------------------

    def _line(self, stream: str, text: str) -> None:
        self._lines.append(text)
        node = self.ctx.cell.node
        if node.watched:
            node.emit(LogLine(self.ctx.path, stream, text))
        if self._sign is not None:
            self._sign.line(text)

    def _ended(self, ended: asyncio.Future[ExitReason]) -> None:
        """Nothing of the program is left: our life ends for the reason it ended for."""
        node, kept = self.ctx.cell.node, self._kept
        assert kept is not None
        if kept.pid > 0:
            node.emit(ProcessDied(self.ctx.path, kept.pid, ended.result()))
        if self._is_up and not self.ctx.closed:
            self.ctx.stop(ended.result())

    @on(ProgramInfo, readonly=True)
    def info(self, message: ProgramInfo) -> ProgramStatus:
        """How it is."""
        kept = self._kept
        return ProgramStatus(-1 if kept is None else kept.pid, self._now() - self._since, list(self._lines))

    def _now(self) -> float:
        return self.ctx.cell.node.loop.time()

    # -- stop -------------------------------------------------------------------------------------------------------

    async def on_stop(self, reason: ExitReason) -> None:
        """End the program: as it wants to be asked, then SIGTERM to its group, then SIGKILL to all that is left."""
        kept = self._kept
        if kept is None or kept.ended.done():
            return
        patience = _seconds(self._order.shutdown)
        if patience != 0 and not await self._asked(kept, None if patience is None else patience / 2):
            kept.signal(signal.SIGTERM, group=True)
            await asyncio.wait({kept.ended}, timeout=None if patience is None else patience / 2)
        if not kept.ended.done():
            kept.kill()
        await kept.wait()

    async def _asked(self, kept: Kept, patience: float | None) -> bool:
        """Ask the program to end; whether it did so in time."""
        try:
            async with asyncio.timeout(patience):
                await self._ask(kept)
                await kept.wait()
        except TimeoutError:
            pass
        except Exception as error:  # The user's own way of stopping it: the rest of the ladder is left.
            self.ctx.cell.node.emit(HookFailed(self.ctx.path, "stop", exits.crash(error)))
        return kept.ended.done()

    async def _ask(self, kept: Kept) -> None:
        way = self._order.stop
        if isinstance(way, int):
            kept.signal(way)
        elif callable(way):
            result = way(kept.pid)
            if isinstance(result, Awaitable):
                await result
        else:
            await self._run(way)

    async def _run(self, command: Sequence[str]) -> None:
        """Run the command that stops it.

        Raises:
            ProgramFailed: it cannot be run, or ends badly.
        """
        kept = self._keep(command)
        try:
            reason = await kept.wait()
        finally:
            if not kept.ended.done():  # It takes too long.
                kept.kill()
                await kept.wait()
        kept.started.result()
        if not reason.is_clean:
            raise ProgramFailed(command[0], str(reason))


class _Leash:
    """Ends with the life that owns a program, also if that is killed and no hook runs: then the program is too."""

    def __init__(self, cell: Cell, kept: Kept) -> None:
        self._cell, self._kept = cell, kept
        cell.extra().timers.add(self)

    def cancel(self) -> None:
        """The life is over."""
        cell, kept = self._cell, self._kept
        cell.extra().timers.discard(self)
        if kept.ended.done():
            return
        kept.kill()
        remains = cell.node.remains
        remains[kept.ended] = cell.path
        kept.ended.add_done_callback(remains.pop)


def program(
    command: Sequence[str],
    *,
    id: str | None = None,
    ready: str | re.Pattern[str] | Path | tuple[str, int] | float | Callable[[], Awaitable[bool] | bool] | None = None,
    ready_timeout: float = 30.0,
    stop: Stop = signal.SIGTERM,
    env: Mapping[str, str | None] | None = None,
    cwd: str | Path | None = None,
    restart: Restart = "permanent",
    shutdown: Shutdown = 5.0,
    backoff: Backoff | None = None,
    limits: Limits | None = None,
) -> ChildSpec:
    """An external program as a child.

    It ends with its actor, and with the process that hosts that, however it ends; its descendants end with it. Its
    output is logged. Exit code 0 is a normal end, any other `Exited(code)`, a signal `Signal(number)`. `ProgramInfo`
    asks how it is.

    Args:
        command: the program and its arguments; it is looked for in PATH, and no shell sees it.
        id: the last part of the address; the program's name if left out.
        ready: what says that it is up: text or a pattern to be found in a line of its output, a `Path` that appears
            (or a Unix socket there that takes connections), `(host, port)` that takes connections, seconds that it
            lives, or a function that returns True; if left out, that it runs.
        ready_timeout: seconds it may take to be ready, > 0.
        stop: how it is asked to end: a signal, a command, or a function that is given its pid. After half the time of
            `shutdown` its process group gets SIGTERM.
        env: variables besides those of this process; None takes one away.
        cwd: its working directory.
        restart, backoff: as in `child`.
        shutdown: seconds it may take to end before it is ended by SIGKILL, "brutal_kill" or "infinity".
        limits: of the program itself; `hung_after` does not apply.

    Raises:
        SpecError: naming the option and what it may be.
    """
    if isinstance(command, (str, bytes)) or not command or not all(isinstance(part, str) for part in command):
        raise SpecError("program", f"the command must be a list of texts, ['name', 'argument'], not {command!r}")
    name = os.path.basename(command[0]) if id is None else id
    where = f"program {name!r}"
    if not isinstance(ready_timeout, (int, float)) or not ready_timeout > 0:
        raise SpecError(where, f"ready_timeout must be seconds > 0, not {ready_timeout!r}")
    if limits is not None and limits.hung_after is not None:
        raise SpecError(where, "limits.hung_after is for actors: a program has no heartbeat")
    order = Order(
        tuple(command),
        None if ready is None else Ready.of(where, ready),
        float(ready_timeout),
        _stop_in(where, stop),
        shutdown,
        dict(env or {}),
        None if cwd is None else os.fspath(cwd),
        limits,
    )
    # The actor does the counting, for a kill of the actor must not come before that of the program.
    own = child(name, start(Program, order), restart=restart, shutdown=shutdown, backoff=backoff)
    patience: Shutdown = "infinity" if isinstance(shutdown, str) else shutdown + SLACK
    return dataclasses.replace(own, shutdown=patience)


def _stop_in(where: str, stop: Any) -> Any:
    if isinstance(stop, int) and not isinstance(stop, bool) and stop in signal.valid_signals():
        return int(stop)
    if callable(stop):
        return stop
    if isinstance(stop, Sequence) and not isinstance(stop, (str, bytes)) and stop:
        return tuple(stop)
    raise SpecError(where, f"stop must be a signal, a command as a list of texts, or a function, not {stop!r}")


def _environment(changes: Mapping[str, str | None]) -> dict[str, str]:
    merged = {**os.environ, **changes}
    return {name: value for name, value in merged.items() if value is not None}


def _seconds(shutdown: Shutdown) -> float | None:
    if shutdown == "brutal_kill":
        return 0.0
    return None if shutdown == "infinity" else float(shutdown)
