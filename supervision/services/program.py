"""External programs as supervised children: any command, started, watched, restarted and stopped like an actor."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import os
import re
import signal
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeGuard

import msgspec

from ...actors import exit_reasons
from ...actors.backoff import Backoff
from ...actors.errors import SpecError
from ...actors.events import HookFailed, LogLine, ProcessDied, ProcessStarted
from ...actors.exit_reasons import ExitReason
from ...actors.kernel.actor import Actor, on, start
from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message, Refusal, RuntimeCall
from ...actors.kernel.ref import ActorRef
from ...actors.process.fork.launch import outside_environment
from ...actors.process.program.external_program import KeptProgram, ProgramFailed
from ...actors.process.resource_limits import Limits
from ...actors.seconds import check_seconds
from ..rules import Rule
from ..spec import ChildSpec, Restart, Shutdown, child
from .program_lines import LineSender, receiver_in
from .readiness import ReadySign, Sign, by_name, reached
from .silent_programs import SilenceWatch

Stop: TypeAlias = int | Sequence[str] | Callable[[int], Awaitable[object] | object]
"""How a program is asked to end: a signal, a command, or a function that is given its pid."""

LINES = 20
"""Lines of output that are remembered."""
SLACK = 5.0
"""Seconds that a program's actor may take longer than `shutdown`: it is not to be killed before its program is."""


class ProgramStatus(msgspec.Struct, frozen=True):
    """The state of a program: its pid, seconds since its start, and its last lines of output, oldest first."""

    pid: int
    uptime: float
    lines: list[str]


class ProgramInfo(Message[ProgramStatus]):
    """Asks a `Program` how it is."""


class ProgramInput(RuntimeCall[None]):
    """Something for a `Program` to read: `text` (as UTF-8), then `data`; after `end` it finds the end of its input.

    The reply says that it is on its way, not that it has been read.
    """

    text: str = ""
    data: bytes = b""
    end: bool = False


class InputRefused(Refusal, text="the program takes no input: {why}"):
    """The program takes no input; `why` says whether it never does, no more, or not now."""

    why: str


@dataclasses.dataclass(frozen=True, slots=True)
class ProgramPlan:
    """What a program is and how it is started and stopped. Made by `program`."""

    command: tuple[str, ...]
    ready: ReadySign | None
    ready_timeout: float
    stop: Any
    shutdown: Shutdown
    env: dict[str, str | None]
    cwd: str | None
    limits: Limits | None
    stdin: bool
    lines_to: str | None
    log_lines: bool
    silent_after: float | None = None


class Program(Actor):
    """Owns one external program: its life is the program's life. Built by `program(...)`."""

    deterministic = False

    def __init__(self, order: ProgramPlan) -> None:
        self._order = order
        self._kept: KeptProgram | None = None
        self._is_up = self._is_stopping = False
        self._lines: deque[str] = deque(maxlen=LINES)
        self._parts: dict[str, str] = {}  # of lines that have no end yet, by stream
        self._sign: Sign | None = None
        self._sender: LineSender | None = None
        self._is_held = False
        self._silence: SilenceWatch | None = None
        self._since = 0.0

    @property
    def lines_to(self) -> str | None:
        """The receiver of each line of its output: an address, or a registered name; None: there is none."""
        return self._order.lines_to

    # -- start ------------------------------------------------------------------------------------------------------

    async def on_start(self, restored: bool) -> None:
        """Start the program and wait until it is ready; if it is not, it is stopped and the start has failed."""
        cell, own = self.ctx._cell, self.ctx.path
        remains, before = cell.node.remains, cell.node.kept.get(cell)
        if left := [ended for ended, address in remains.items() if address == own]:
            await asyncio.wait(left)  # The last life was killed: its program must be gone before the next one begins.
        order = self._order
        if isinstance(before, KeptProgram) and not before.ended.done():
            why = f"that of an earlier life still runs, and cannot be ended from here ({before.denied.result()})"
            raise ProgramFailed(order.command[0], why)
        if order.lines_to is not None:
            self._sender = LineSender(cell, order.lines_to, self._hold, self._go_on)
            self._sender.check()
        self._sign = None if order.ready is None else Sign(order.ready)
        kept = self._kept = self._keep(order.command, stdin=order.stdin)
        self._since = self._now()
        kept.started.add_done_callback(self._started)
        kept.ended.add_done_callback(self._ended)
        await asyncio.shield(kept.started)
        if self._sign is not None:
            await self._until_ready(kept, self._sign)
        self._is_up = True
        if kept.ended.done():  # At once: nobody was there yet to be told.
            self.ctx.stop(kept.ended.result())
        elif order.silent_after is not None:
            loop = cell.node.loop
            self._silence = SilenceWatch(loop, kept.pid, order.silent_after, self._is_kept_quiet, self._hangs)
            kept.ended.add_done_callback(self._listen_no_more)

    def _keep(
        self, command: Sequence[str], more: Mapping[str, str] | None = None, *, stdin: bool = False
    ) -> KeptProgram:
        order = self._order
        kept = KeptProgram(
            self.ctx._cell.node,
            self.ctx.path,
            command,
            env={**_environment(order.env), **(more or {})},
            cwd=order.cwd,
            limits=order.limits,
            on_line=self._line,
            on_part=self._part,
            stdin=stdin,
        )
        kept.denied.add_done_callback(functools.partial(self._denied, command[0]))
        _Leash(self.ctx._cell, kept)
        return kept

    def _denied(self, program: str, denied: asyncio.Future[str]) -> None:
        """It cannot be ended: somebody has to know."""
        why = f"it cannot be ended from here, and runs on until somebody else ends it ({denied.result()})"
        self.ctx._cell.node.emit(HookFailed(self.ctx.path, "stop", exit_reasons.crash(ProgramFailed(program, why))))

    async def _until_ready(self, kept: KeptProgram, sign: Sign) -> None:
        """Wait for the sign.

        Raises:
            ProgramFailed: it did not come in time, or the program ended before.
        """
        timeout = self._order.ready_timeout
        waiting = self.ctx._cell.node.loop.create_task(
            reached(sign, self.ctx._cell.node.threads), name=f"ready of {self.ctx.path}"
        )
        try:
            first: set[asyncio.Future[Any]] = {waiting, kept.ended}
            await asyncio.wait(first, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            if kept.ended.done():
                raise self._failed(f"it ended before it was ready: {kept.ended.result()}")
            if not waiting.done():
                raise self._failed(f"it was not ready after {timeout:g} s")
            if waiting.cancelled():
                raise self._failed("what `ready` waited for was cancelled")
            try:
                waiting.result()
            except Exception as error:
                raise self._failed(f"`ready` raised {type(error).__name__}: {error}") from error
        finally:
            if not waiting.cancel() and not waiting.cancelled():
                waiting.exception()  # Seen: the end of the program came at the same time, and says more.
            sign.close()

    def _failed(self, why: str) -> ProgramFailed:
        last = "\n".join(self._last())
        return ProgramFailed(self._order.command[0], f"{why}; its last lines:\n{last}" if last else why)

    # -- while it runs ----------------------------------------------------------------------------------------------

    def _is_kept_quiet(self) -> bool:
        """Whether it is not to be heard now: its lines wait for their receiver, or its actor is suspended."""
        more = self.ctx._cell.more
        return self._is_held or (more is not None and more.suspended != 0)

    def _hangs(self, seconds: float) -> None:
        if self._kept is not None:
            self._kept.kill(exit_reasons.Hung(round(seconds, 3), "it has printed nothing"))

    def _listen_no_more(self, ended: object = None) -> None:
        if self._silence is not None:
            self._silence.close()

    def _line(self, stream: str, text: str) -> None:
        self._lines.append(text)
        if self._silence is not None:
            self._silence.heard()
        self._parts.pop(stream, None)
        node = self.ctx._cell.node
        if node.events.hears_lines:
            node.emit(LogLine(self.ctx.path, stream, text, self.ctx._cell.life, self._order.log_lines))
        if self._sender is not None:
            self._sender.send(stream, text)
        if self._sign is not None:
            self._sign.line(text)

    def _hold(self) -> None:
        self._is_held = True
        if self._kept is not None:
            self._kept.hold_output()

    def _go_on(self) -> None:
        self._is_held = False
        if self._kept is not None:
            self._kept.let_output_go_on()

    def _part(self, stream: str, text: str, whole: str) -> None:
        """A line that has no end yet; it comes again. What came before of a very long one is there in `whole`."""
        if text and text != self._parts.get(stream) and self._silence is not None:
            self._silence.heard()
        self._parts[stream] = text
        if whole and self._sign is not None:
            self._sign.line(whole)

    def _last(self) -> list[str]:
        """The last words that the program has written."""
        return [*self._lines, *(text for text in self._parts.values() if text)][-LINES:]

    def _started(self, started: asyncio.Future[int]) -> None:
        """It runs. Told from here, for it may have ended before `on_start` goes on."""
        if not started.cancelled() and started.exception() is None:
            self.ctx._cell.node.emit(ProcessStarted(self.ctx.path, started.result()))

    def _ended(self, ended: asyncio.Future[ExitReason]) -> None:
        """Nothing of the program is left: our life ends for the reason it ended for."""
        node, kept = self.ctx._cell.node, self._kept
        assert kept is not None
        if kept.pid > 0:
            asked = self._is_stopping and not kept.was_killed
            node.emit(ProcessDied(self.ctx.path, kept.pid, ended.result(), asked))
        if self._is_up and not self.ctx._closed:
            self.ctx.stop(ended.result())

    @on(ProgramInfo, readonly=True)
    def info(self, message: ProgramInfo) -> ProgramStatus:
        """Tell how the program is."""
        kept = self._kept
        return ProgramStatus(-1 if kept is None else kept.pid, self._now() - self._since, self._last())

    @on(ProgramInput)
    def feed(self, message: ProgramInput) -> None:
        """Give it something to read."""
        into = None if self._kept is None else self._kept.input
        if into is None:
            raise InputRefused("it has no standard input: make it with program(..., stdin=True)")
        if not into.is_open:
            raise InputRefused("its standard input is closed")
        if not into.write(message.text.encode("utf-8", "replace") + message.data):
            raise InputRefused(f"it does not read: {into.waiting} bytes wait for it")
        if message.end:
            into.end()

    def _now(self) -> float:
        return self.ctx._cell.node.loop.time()

    # -- stop -------------------------------------------------------------------------------------------------------

    async def on_stop(self, reason: ExitReason) -> None:
        """End the program: as it wants to be asked, then SIGTERM to its group, then SIGKILL to all that is left."""
        kept, self._is_stopping = self._kept, True
        self._listen_no_more()
        if kept is None or kept.ended.done():
            return
        patience = _seconds(self._order.shutdown)
        if kept.pid < 0:  # It has never run: there is nobody to be asked, and no pid to be given to anybody.
            patience = 0
        if patience != 0 and not await self._asked(kept, None if patience is None else patience / 2):
            kept.signal(signal.SIGTERM, group=True)
            await asyncio.wait({kept.ended}, timeout=None if patience is None else patience / 2)
        if not kept.ended.done():
            kept.kill()
        await kept.wait_killed()

    async def _asked(self, kept: KeptProgram, patience: float | None) -> bool:
        """Ask the program to end; whether it did so in time."""
        try:
            async with asyncio.timeout(patience):
                await self._ask(kept)
                await kept.wait()
        except TimeoutError:
            pass
        except (Exception, asyncio.CancelledError) as error:  # The user's own way: the rest of the ladder is left.
            if isinstance(error, asyncio.CancelledError) and _is_cancelled():
                raise
            self.ctx._cell.node.emit(HookFailed(self.ctx.path, "stop", exit_reasons.crash(error)))
        return kept.ended.done()

    async def _ask(self, kept: KeptProgram) -> None:
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
        running = self._kept
        assert running is not None
        kept = self._keep(command, {"MAINPID": str(running.pid)})
        try:
            reason = await kept.wait()
        finally:
            if not kept.ended.done():  # It takes too long.
                kept.kill()
                await kept.wait_killed()
        kept.started.result()
        if not reason.is_clean:
            raise ProgramFailed(command[0], str(reason))


class _Leash:
    """Ends with the life that owns a program, also if that is killed and no hook runs: then the program is too."""

    def __init__(self, cell: Cell, kept: KeptProgram) -> None:
        self._cell, self._kept = cell, kept
        cell.extra().belongings.timers.add(self)

    def cancel(self) -> None:
        """End the program, because the life that owns it is over."""
        cell, kept = self._cell, self._kept
        cell.extra().belongings.timers.discard(self)
        if kept.ended.done():
            return
        kept.kill()
        cell.node.end_after(cell.node.loop.create_task(kept.wait_killed(), name=f"end of {cell.path}"), cell.path)
        cell.node.kept[cell] = kept  # If we may not end it, no second one is started beside it.


def program(
    command: Sequence[str],
    *,
    id: str | None = None,
    ready: str | re.Pattern[str] | Path | tuple[str, int] | float | Callable[[], Awaitable[bool] | bool] | None = None,
    ready_timeout: float = 30.0,
    stop: Stop = signal.SIGTERM,
    env: Mapping[str, str | None] | None = None,
    cwd: str | Path | None = None,
    stdin: bool = False,
    lines_to: ActorRef[Any] | str | None = None,
    log_lines: bool = True,
    silent_after: float | None = None,
    restart: Restart = "permanent",
    shutdown: Shutdown = 5.0,
    backoff: Backoff | None = None,
    limits: Limits | None = None,
    significant: bool = False,
    rules: Iterable[Rule] = (),
) -> ChildSpec:
    """Describe an external program as a child: any command, started and stopped like an actor.

    It ends with its actor, and with the process that hosts that, however it ends; its descendants end with it. Its
    output is logged. Exit code 0 is a normal end, any other `Exited(code)`, a signal `Signal(number)`. `ProgramInfo`
    asks how it is.

    Args:
        command: the program and its arguments; it is looked for in PATH, and no shell sees it.
        id: the last part of the address; the program's name if left out.
        ready: what says that it is up: a regular expression to be found in a line of its output, a `Path` (seen from
            `cwd`) where a file appears or changes, or a Unix socket takes connections, `(host, port)` that takes
            connections, seconds that it lives, or a function that returns True, asked again and again; may be
            `async`. If left out: that it runs.
        ready_timeout: seconds it may take to be ready, > 0.
        stop: how it is asked to end: a signal, a command (which finds its pid in MAINPID), or a function that is given
            its pid; may be `async`. After half the time of `shutdown`, or if that cannot be done, its process group
            gets SIGTERM.
        env: variables besides those of this process; None takes one away.
        cwd: its working directory.
        stdin: whether it reads what `ProgramInput` brings; else its standard input is empty.
        lines_to: who gets each line of its output as a `ProgramLine`: a ref, an address or a registered name. A hundred
            that are not handled have the program wait. The first ones are kept until the receiver is there, for ten
            seconds and a thousand of them at most. What nobody can take is a dead letter.
        log_lines: whether each line of its output is written to the log, too; `holdfast logs` shows the last ones in
            any case.
        silent_after: seconds without any output, once it is ready, after which it hangs: it is ended by SIGKILL, as
            `Hung`, and restarted as if it had crashed. None: it may be silent for ever. What it is told is no output.
            Time in which this process is late, its lines wait for their receiver, or its actor is suspended does not
            count.
        restart, backoff, significant, rules: as in `child`.
        shutdown: seconds it may take to end before it is ended by SIGKILL, "brutal_kill" or "infinity".
        limits: of the program itself; `hung_after` does not apply.

    Raises:
        SpecError: naming the option and what it may be.
    """
    words = _command_in("program", "the command", command)
    name = os.path.basename(words[0]) if id is None else id
    where = f"program {name!r}"
    check_seconds(where, "ready_timeout", ready_timeout)
    if not isinstance(stdin, bool):
        raise SpecError(where, f"stdin must be True or False, not {stdin!r}")
    if not isinstance(log_lines, bool):
        raise SpecError(where, f"log_lines must be True or False, not {log_lines!r}")
    if limits is not None and not isinstance(limits, Limits):
        raise SpecError(where, f"limits must be Limits(...) or left out, not {limits!r}")
    if limits is not None and limits.hung_after is not None:
        raise SpecError(where, "limits.hung_after is for actors: a program has no heartbeat; say silent_after=")
    if silent_after is not None:
        silent_after = check_seconds(where, "silent_after", silent_after)
    directory = _directory_in(where, cwd)
    if isinstance(ready, Path) and directory is not None:
        ready = Path(directory, ready)
    order = ProgramPlan(
        words,
        None if ready is None else ReadySign.of(where, ready),
        float(ready_timeout),
        _stop_in(where, stop),
        shutdown,
        _changes_in(where, env),
        directory,
        limits,
        stdin,
        receiver_in(where, lines_to),
        log_lines,
        silent_after,
    )
    # The actor does the counting, for a kill of the actor must not come before that of the program.
    own = child(
        name,
        start(Program, order),
        restart=restart,
        shutdown=shutdown,
        backoff=backoff,
        significant=significant,
        rules=rules,
    )
    patience: Shutdown = "infinity" if isinstance(shutdown, str) else shutdown + SLACK
    return dataclasses.replace(own, shutdown=patience)


def _is_cancelled() -> bool:
    """Whether this very task is cancelled; else what it waited for was."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def _stop_in(where: str, stop: Any) -> Any:
    if isinstance(stop, int) and not isinstance(stop, bool) and stop in signal.valid_signals():
        return int(stop)
    if callable(stop):
        return by_name(stop)
    if isinstance(stop, (list, tuple)):
        return _command_in(where, "stop", stop)
    raise SpecError(where, f"stop must be a signal, a command as a list of texts, or a function, not {stop!r}")


def _command_in(where: str, what: str, command: Any) -> tuple[str, ...]:
    words = tuple(command) if isinstance(command, (list, tuple)) else ()
    if not words or not all(_is_text(word) for word in words) or not words[0]:
        raise SpecError(where, f"{what} must be a list of texts, ['name', 'argument'], not {command!r}")
    return words


def _directory_in(where: str, cwd: Any) -> str | None:
    if cwd is None:
        return None
    path = os.fspath(cwd) if isinstance(cwd, (str, os.PathLike)) else None
    if not _is_text(path):
        raise SpecError(where, f"cwd must be a path, not {cwd!r}")
    return path


def _changes_in(where: str, env: Any) -> dict[str, str | None]:
    changes: dict[Any, Any] = dict(env) if isinstance(env, Mapping) else {}
    if env is not None and not isinstance(env, Mapping):
        raise SpecError(where, f"env must be a mapping of names to texts, not {env!r}")
    for name, value in changes.items():
        if not _is_text(name) or not name or "=" in name or not (value is None or _is_text(value)):
            raise SpecError(
                where, f"env must map names to texts (or None, to take one away), not {name!r} to {value!r}"
            )
    return changes


def _is_text(value: object) -> TypeGuard[str]:
    """Whether the kernel takes it: it has no text with a NUL in it."""
    return isinstance(value, str) and "\0" not in value


def _environment(changes: Mapping[str, str | None]) -> dict[str, str]:
    merged = {**outside_environment(), **changes}
    return {name: value for name, value in merged.items() if value is not None}


def _seconds(shutdown: Shutdown) -> float | None:
    if shutdown == "brutal_kill":
        return 0.0
    return None if shutdown == "infinity" else float(shutdown)
