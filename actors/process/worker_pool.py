"""Workers: the OS processes of one root, forked ahead of need, watched, and always reaped."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import signal
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from ..control.orders import ObserveTurns
from ..control.orders_lane import order, send_call
from ..errors import AskFailed, ProcessUnavailable, StartFailed, StartIgnored
from ..events import REFUSED, TRACED, DeadLetter, HelperStuck, LogLine, ProcessDied, ProcessStarted, TrustBreached
from ..exit_reasons import KILLED, ExitReason, ForkServerDied, Hung, TrustBreach, pack_exit, unpack_exit
from ..kernel.cell import Cell
from ..migration.words import NO_ATTEMPT, say
from ..streams import check_can_watch
from .effect_processes import EffectProcesses
from .fork.fork_server import ForkServer
from .fork.forked_process import Forked, has_ended
from .fork.launch import keep_large_memory, why_not_importable
from .owed_answer import is_stopped
from .process_end import ProcessEnd
from .process_watchdog import LOOKS, ProcessWatch, oom_kills
from .program.stdout import OutputReader
from .resource_limits import Limits
from .stand_ins import Inner
from .wire import frames
from .wire.connection import Connection
from .wire.frames import BadFrame
from .wire.peer import Peer, RelayedAsk
from .wire.worker_gate import WorkerGate

if TYPE_CHECKING:
    from ..kernel.envelope import Ask
    from ..kernel.node import Node

REAPED_WITHIN = 2.0
"""Seconds to wait for the exit status after a process's socket has ended, before it is killed and called lost."""
AGAIN_AFTER = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""Seconds between attempts to fork a process for an actor that is restarted."""
ANSWERED_LOOK = 0.05
"""Seconds between two looks at whether all is answered that an actor which has left has been asked."""
ORDER_TIMEOUT = 60.0
"""Seconds until it does not matter any more whether a new process counts for whoever wanted to know."""


class Worker(Peer):
    """One OS process: its connection, the actor it was given, and how it ends."""

    def __init__(self, workers: Workers, forked: Forked, server: ForkServer) -> None:
        super().__init__(workers.node)
        self.forked, self.server = forked, server
        self.pid = forked.pid
        self.page = memoryview(forked.page).cast("Q")
        self.gate = WorkerGate(self)
        self.inner = Inner(self.node, self)
        self.cell: Cell | None = None
        self.life = (
            0  # the number of the life that it has; the next life at its address may begin before it is read out
        )
        self.home = ""  # the address that it was given; an actor that has left may have another one by now
        self._workers = workers
        self._died: Callable[[Cell, ExitReason], None] | None = None
        self._launches: dict[int, asyncio.Future[None]] = {}
        self.end = ProcessEnd(oom_kills())
        self._is_reserved = False  # for an actor that is being moved here, and lives elsewhere so far
        self._grave: asyncio.Future[None] = self.node.loop.create_future()
        self._watch: ProcessWatch | None = None
        self._outputs: list[OutputReader] = []
        self.movers: dict[int, Callable[[frames.Migrate], None]] = {}  # who hears of which attempt to move an actor

    # -- its life ---------------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Take over the socket and the output pipes.

        Raises:
            OSError: the loop cannot watch them.
        """
        loop, forked = self.node.loop, self.forked
        self.join(Connection(self._on_frame, self._on_lost, guarded=True))
        self.connection.takers = {
            frames.Reply: self.on_reply,
            frames.Failure: self.on_failure,
            frames.Forget: self.on_forget,
        }
        check_can_watch(forked.sock.fileno(), forked.stdout_fd, forked.stderr_fd)
        await self.connection.open(forked.sock)
        self._outputs.append(OutputReader(loop, forked.stdout_fd, functools.partial(self._on_line, "stdout")))
        forked.stdout_fd = -1  # Its reader closes it from here on.
        self._outputs.append(OutputReader(loop, forked.stderr_fd, functools.partial(self._on_line, "stderr")))
        forked.stderr_fd = -1

    def is_alive(self) -> bool:
        """Whether it can be given an actor: a process ends with its fork server, but not in the same instant."""
        return self.connection.is_open and not self.server.has_ended() and not has_ended(self.forked.pidfd)

    def is_ready(self) -> bool:
        """Whether it waits for an actor; one that a signal has stopped does not."""
        return self.is_alive() and not is_stopped(self.pid, self.server.pid)

    def adopt(self, cell: Cell, limits: Limits | None, died: Callable[[Cell, ExitReason], None]) -> None:
        """This process is now that of the actor at `cell`."""
        self.reserve(cell, limits, died)
        self._is_reserved = False
        self._workers.by_cell[cell] = self
        if self.node.events.has_listeners:
            self.node.emit(ProcessStarted(cell.path, self.pid))

    async def launch(self, cell: Cell, recipe: bytes, options: dict[str, Any]) -> None:
        """Begin the life in it.

        Raises:
            StartFailed: the actor's `__init__` or `on_start` raised, or the process ended.
        """
        limits = self._watch.limits if self._watch is not None else None
        bindings = {port: target.path for port, target in cell.extra().bindings.items()}
        await self._ask_launch(cell, recipe, dict(options, limits=_limit_options(limits), bindings=bindings))

    def _check_program(self, cell: Cell, recipe: bytes) -> None:
        """A class of `__main__` is known in the process only if that could be imported there.

        Raises:
            StartFailed: it could not, and what to do.
        """
        if b"__main__:" not in recipe:
            return
        problem = why_not_importable() or self.server.preload_errors.get("__main__")
        if problem:
            raise StartFailed(
                cell.path, f"its class is defined in the program itself, which its process cannot import: {problem}"
            )

    async def _ask_launch(self, cell: Cell, recipe: bytes, options: dict[str, Any]) -> None:
        self._check_program(cell, recipe)
        self.life = cell.life
        key = self.next_id()
        if self.end.is_buried:
            raise StartFailed(cell.path, "its process has ended")
        up = self._launches[key] = self.node.loop.create_future()
        connection = self.connection
        options = dict(options, tokens=self.node.numbers.tokens_for_process())
        connection.send(frames.Launch(key, connection.names.to_wire(cell.path), cell.life, recipe, options), cell.path)
        if "prepare" not in options:
            self._order_again(cell)
        try:
            await up
        finally:
            self._launches.pop(key, None)

    def _order_again(self, cell: Cell) -> None:
        """What was ordered while there was no process, and what counts and traces the actor over its lives."""
        more = cell.extra()
        calls, more.calls = more.calls, []
        for call in calls:
            if not call.ask.is_done:
                send_call(self, cell.path, call)
        if more.tap is not None and more.tap.is_on:
            more.tap.attach()
            wanted = more.tap.wanted
            seen = order(cell, ObserveTurns(wanted["counting"], wanted["tracing"]), ORDER_TIMEOUT)
            seen.add_done_callback(_seen)

    # -- an actor that is moved here, or leaves ---------------------------------------------------------------------

    def reserve(self, cell: Cell, limits: Limits | None, died: Callable[[Cell, ExitReason], None]) -> None:
        """The actor at `cell` may be moved into this process, which counts as its own only when it is adopted."""
        self.cell, self._died, self.home = cell, died, cell.path
        self._is_reserved = True
        if limits is not None:
            self._watch = ProcessWatch(self, limits)

    def readdress(self, was: str, now: str) -> None:
        """Its actor, or one above it, has moved; what is on its way from there still says the old address."""
        old, self.home = self.home, now + self.home[len(was) :]
        self.gate.readdressed(was, now)
        self.inner.readdressed(old, self.home)
        to = self.connection.names.to_wire(self.home)
        self.connection.send(frames.Command(to, "readdress", {"was": was, "now": now}))

    def disown(self, cell: Cell, old: str) -> None:
        """The actor that has left `old`, below its own, has another supervisor from now on, elsewhere."""
        new, connection = cell.path, self.connection
        self.gate.readdressed(old, new)
        self.inner.lost(old, cell)
        told = {"path": new, "life": cell.life}
        connection.send(frames.Command(connection.names.to_wire(old), "disown", told))

    def replaced(self, cell: Cell) -> None:
        """Another actor, elsewhere, has taken the place of this process's own: it gets what that has put aside."""
        connection = self.connection
        connection.send(frames.Command(connection.names.to_wire(cell.path), "replaced", {}))

    def give_back(self) -> None:
        """The actor is not moved into this process: it ends, and nobody is told."""
        self.cell = self._died = None
        self.take_pending()  # Whoever was to be answered from here still is, where the actor lives.
        self.gone()

    @property
    def is_killed(self) -> bool:
        """Whether we have killed it; it may not have died yet."""
        return self.end.killed_for is not None

    def on_death(self, died: Callable[[Cell, ExitReason], None]) -> None:
        """Who hears of its end from now on."""
        self._died = died

    async def prepare(self, cell: Cell, recipe: bytes) -> None:
        """Have the process import what the actor needs.

        Raises:
            StartFailed: it cannot, or has ended.
        """
        await self._ask_launch(cell, recipe, {"prepare": True})

    def leave(self, cell: Cell, reason: ExitReason, seconds: float, *, answers: bool = False) -> None:
        """The actor lives elsewhere now: what is left of it ends in good order, within `seconds`, and tells nobody.

        With `answers` not before all is answered that others wait for, and that is answered through this process.
        """
        self._died = None
        if self._workers.by_cell.get(cell) is self:
            del self._workers.by_cell[cell]
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        self.movers.clear()
        self.ignore_records()
        self._end_left(cell.path, reason, seconds, answers=answers)

    def _end_left(self, path: str, reason: ExitReason, seconds: float, *, answers: bool) -> None:
        if self.end.is_buried:
            return
        loop, connection = self.node.loop, self.connection
        if answers and any(map(_is_awaited, self.pending.values())):
            again = functools.partial(self._end_left, path, reason, seconds, answers=True)
            loop.call_later(ANSWERED_LOOK, again)
            return
        say(connection, path, NO_ATTEMPT, "leave", reason=pack_exit(reason))
        connection.flush()
        late = loop.call_later(seconds, self.kill, KILLED)
        self._grave.add_done_callback(lambda _: late.cancel())

    def kill(self, why: ExitReason) -> None:
        """SIGKILL, by pidfd; its end is then called `why`."""
        if self.end.killed_for is None:
            self.end.killed_for = why
        if not self.forked.kill(signal.SIGKILL):
            self.connection.close()  # It ends when it sees that, unless it hangs.

    def hung(self, seconds: float) -> None:
        """The watch has seen no beat."""
        if not has_ended(self.forked.pidfd):  # Else it was something else that ended it, and we shall hear of that.
            self.kill(Hung(seconds))

    def beat(self) -> None:
        """Note that the event loop of the process turns."""
        if self._watch is not None:
            self._watch.beat()

    def gone(self) -> asyncio.Future[None]:
        """A future that ends when the process is dead, reaped and told of; it is killed now if it was not.

        Each caller has one of its own: who gives up waiting ends nobody else's.
        """
        self.kill(KILLED)
        return asyncio.shield(self._grave)

    # -- what it says -----------------------------------------------------------------------------------------------

    def _on_frame(self, frame: frames.AnyFrame) -> None:
        if self.gate.admits(frame):
            self._workers.on_frame(self.node, self, frame)

    def on_forget(self, frame: frames.Forget) -> None:
        """The process gives all its names anew."""
        super().on_forget(frame)
        self.gate.forget()

    def number(self, place: int, most: int) -> int:
        """A number on the page, which the process may have written anything to; `most` can stand there."""
        number = self.page[place]
        if number <= most:
            return number
        self.breach(f"its page says {number} where {most} is the most that can be")
        return most

    def breach(self, problem: str) -> None:
        """It has said what it may not, or what cannot be: it ends, soon, since whoever noticed is at something else."""
        self.node.loop.call_soon(self.connection.close, BadFrame(problem))

    def on_launched(self, frame: frames.Launched) -> None:
        """A launch has come to its end."""
        up = self._launches.get(frame.id)
        if up is None or up.done():
            return
        if frame.ignored or frame.problem:
            kind = StartIgnored if frame.ignored else StartFailed
            up.set_exception(kind(self.cell.path if self.cell is not None else "", frame.problem))
        else:
            up.set_result(None)

    def on_ended(self, frame: frames.Ended) -> None:
        """The actor's life has ended by itself; its process has nothing more to do."""
        self._noticed()
        self.end.told = unpack_exit(frame.reason)
        self.forked.kill(signal.SIGKILL)

    def on_moved(self) -> None:
        """Its actor, whose mailbox is bounded, has begun or ended turns."""
        cell = self.cell
        bound = cell.more.bound if cell is not None and cell.more is not None else None
        if cell is not None and bound is not None:
            bound.moved(cell)

    def on_migrate(self, frame: frames.Migrate) -> None:
        """A word of an attempt to move an actor; if that one is over, it is void."""
        heard = self.movers.get(frame.attempt)
        if heard is not None:
            heard(frame)

    def on_note(self, frame: frames.Note) -> None:
        """An event of the process."""
        self._workers.on_note(self, frame)

    def _on_line(self, stream: str, text: str) -> None:
        if self.node.events.hears_lines:
            path = self.cell.path if self.cell is not None else f"process {self.pid}"
            self.node.emit(LogLine(path, stream, text, self.life))

    # -- its end ----------------------------------------------------------------------------------------------------

    def _noticed(self) -> None:
        if not self.end.noticed_at:
            self.end.noticed_at = time.monotonic()

    def _on_lost(self, error: Exception | None) -> None:
        self.end.is_lost = True
        self._noticed()
        if isinstance(error, BadFrame):
            self._breached(error)
        self.forked.kill(signal.SIGKILL)  # Whoever closes its socket has to end.
        self._bury_soon()

    def _breached(self, error: BadFrame) -> None:
        """It spoke nonsense, or of what is not its own."""
        if self.end.killed_for is None and self.end.status is None:
            path = self.cell.path if self.cell is not None else f"process {self.pid}"
            self.node.emit(TrustBreached(path, self.pid, error.problem))
        self.kill(TrustBreach(error.problem))

    def on_exit(self, status: int) -> None:
        """The fork server has reaped it."""
        self.end.status = status
        self._noticed()
        self._bury_soon()

    def _bury_soon(self) -> None:
        """At once if all is known. What it wrote before its end may still be in the socket, whose end comes behind."""
        if self.end.orphaned is not None:
            self._workers.bury_orphans(self.server)
        elif self.end.is_complete:
            self.bury()
        else:
            self.server.expect_exits()
            self.node.loop.call_later(REAPED_WITHIN, self._bury_late)

    def _bury_late(self) -> None:
        if self.end.orphaned is None:  # Else it is told of with the others.
            self.bury()

    def bury(self) -> None:
        """It has ended: tell everybody, and give back what it had."""
        if self.end.is_buried:
            return
        self.end.is_buried = True
        reason = self.end.reason(oom_kills())
        self.connection.close()
        for output in self._outputs:
            output.close()
        if self._watch is not None:
            self._watch.close()
        cell = self.cell
        if cell is not None and self.node.events.has_listeners:
            self.node.emit(ProcessDied(cell.path, self.pid, reason))
        for up in self._launches.values():
            if not up.done():
                up.set_exception(StartFailed(cell.path if cell is not None else "", str(reason)))
        self.inner.close(reason)
        if cell is not None and self._died is not None:
            self._died(cell, reason)
            if self._workers.by_cell.get(cell) is self:
                del self._workers.by_cell[cell]
        if self._is_reserved:
            self.take_pending()  # They were never its own: the life that has promised to answer them goes on.
        else:
            self.fail_pending(AskFailed(cell.path if cell is not None else "", str(reason)))
        self.page.release()
        self.forked.close()
        self._workers.buried(self)
        self._grave.set_result(None)


def _seen(done: asyncio.Future[Any]) -> None:
    """Nobody waits for it: asyncio need not complain of its failure."""
    if not done.cancelled():
        done.exception()


def _limit_options(limits: Limits | None) -> dict[str, Any]:
    """What the process sets for itself."""
    if limits is None:
        return {}
    return {
        "address_space_bytes": limits.address_space_bytes,
        "open_files": limits.open_files,
        "niceness": limits.niceness,
        "beat": None if limits.hung_after is None else limits.hung_after / LOOKS,
    }


def _is_awaited(ask: Ask) -> bool:
    """Whether anybody waits for the answer of an ask: if it came from another process, as long as that is there."""
    return not ask.is_done and (not isinstance(ask, RelayedAsk) or bool(ask.peer.connection.is_open))


class Workers:
    """The pool: one fork server, its children, and a warm one in reserve."""

    def __init__(
        self,
        node: Node,
        entry: str,
        preload: Sequence[str],
        on_frame: Callable[[Node, Worker, frames.AnyFrame], None],
        *,
        warm: int = 1,
    ) -> None:
        self.node = node
        self.on_frame = on_frame
        self.by_cell: dict[Cell, Worker] = {}
        self.effects = EffectProcesses(node.codec)
        self._entry, self._preload, self._warm = entry, list(preload), warm
        self._server: ForkServer | None = None
        self._servers: list[ForkServer] = []  # all that live, also one that does not answer
        self._opening = asyncio.Lock()
        self._alive: dict[int, Worker] = {}
        self._ready: list[Worker] = []
        self._refilling: asyncio.Task[None] | None = None
        self._closed = False

    def of(self, cell: Cell) -> Worker | None:
        """The process of an actor, if it has one now."""
        return self.by_cell.get(cell)

    @property
    def pids(self) -> dict[int, str]:
        """The processes that live, with the address that each was given; "" for one in reserve."""
        return {pid: worker.home for pid, worker in self._alive.items()}

    def want(self, module: str) -> None:
        """Have the fork server import a module before the next fork."""
        if module in self._preload or module == "__main__":
            return
        self._preload.append(module)
        if self._server is not None:
            self._server.preload(module)

    async def take(self, *, again: bool = False) -> Worker:
        """A process that waits for an actor.

        Args:
            again: for an actor that has lived before: that there is no process, memory or descriptor left may pass, and
                says nothing of the actor. So it is tried for a while, and not each failure counts as a restart.

        Raises:
            ProcessUnavailable: none could be forked.
        """
        while self._ready:
            worker = self._ready.pop()
            if worker.is_ready():
                self._refill()
                return worker
            worker.kill(KILLED)
        worker = await self._fork_again() if again else await self._fork()
        self._refill()
        return worker

    async def _fork_again(self) -> Worker:
        for pause in AGAIN_AFTER:
            try:
                return await self._fork()
            except ProcessUnavailable:
                if self._closed:
                    raise
            await asyncio.sleep(pause)
        return await self._fork()

    async def _fork(self) -> Worker:
        server = await self._open()
        try:
            forked = await server.fork()
        except ProcessUnavailable:
            if self._closed or not (server.is_deaf or server.has_ended()):
                raise  # What it refuses another one could not do either.
            if self._server is server:
                self._server = None
            server = await self._open()
            forked = await server.fork()
        worker = Worker(self, forked, server)
        self._alive[forked.pid] = worker
        try:
            await worker.connect()
        except BaseException as error:  # Or whoever asked for it does not want it any more.
            worker.kill(KILLED)
            if isinstance(error, OSError):
                raise ProcessUnavailable(f"no process can be watched: {error}") from error
            raise
        return worker

    async def _open(self) -> ForkServer:
        async with self._opening:
            if self._closed:
                raise ProcessUnavailable("the system is shutting down")
            if self._server is None:
                server = ForkServer(
                    self._entry,
                    self._preload,
                    on_exit=self._on_exit,
                    on_lost=lambda: self._on_lost(server),
                    on_stuck=lambda found: self._on_stuck(server, found),
                )
                self._servers.append(server)  # Whoever is given up twice does not wait until it has ended.
                try:
                    await server.start()
                except BaseException:
                    if server.has_ended():
                        self._servers.remove(server)
                    raise
                keep_large_memory()
                self._server = server
            return self._server

    def _refill(self) -> None:
        if self._refilling is None and len(self._ready) < self._warm and not self._closed:
            self._refilling = self.node.loop.create_task(self._refill_now(), name="warm processes")

    async def _refill_now(self) -> None:
        try:
            while len(self._ready) < self._warm and not self._closed:
                self._ready.append(await self._fork())
        except ProcessUnavailable:
            return  # Whoever needs a process asks for it, and is told why there is none.
        finally:
            self._refilling = None

    def _on_exit(self, pid: int, status: int) -> None:
        worker = self._alive.get(pid)
        if worker is not None:
            worker.on_exit(status)

    def _on_lost(self, server: ForkServer) -> None:
        """A fork server died: its children die with it, each is seen by its socket; the next fork starts another."""
        if server in self._servers:
            self._servers.remove(server)
        if self._server is server:
            self._server = None
        why = ForkServerDied(server.pid, server.died_of)
        for worker in self._children_of(server):
            worker.end.orphaned = why
        self.bury_orphans(server)
        self.node.loop.call_later(REAPED_WITHIN, functools.partial(self.bury_orphans, server, late=True))

    def _on_stuck(self, server: ForkServer, found: str) -> None:
        root = self.node.root
        assert root is not None
        self.node.emit(HelperStuck(root.path, "fork server", server.pid, found))

    def _children_of(self, server: ForkServer) -> list[Worker]:
        return [worker for worker in self._alive.values() if worker.server is server]

    def bury_orphans(self, server: ForkServer, *, late: bool = False) -> None:
        """Tell at once of all that have ended with their fork server: their supervisors see that it is one fault.

        Not before what they wrote has come, unless it is `late`.
        """
        orphans = self._children_of(server)
        if late or all(worker.end.is_complete for worker in orphans):
            for worker in orphans:
                worker.bury()

    def buried(self, worker: Worker) -> None:
        """A process is gone for good."""
        if self._alive.get(worker.pid) is worker:
            del self._alive[worker.pid]
        with contextlib.suppress(ValueError):
            self._ready.remove(worker)

    def on_note(self, worker: Worker, frame: frames.Note) -> None:
        """An event from a process: shown under its actor's address."""
        from ..events import event_from

        event = event_from(frame.kind, frame.data)
        if isinstance(event, DeadLetter) and not event.why.startswith(REFUSED):
            self.node.numbers.dead_letters += 1
        if isinstance(event, TRACED):
            cell = self.node.find(event.address)
            if cell is not None and cell.more is not None and cell.more.tap is not None:
                cell.more.tap.hub.emit(event)
        elif event is not None:
            events = self.node.events
            if events.hears_lines if isinstance(event, LogLine) else events.has_listeners:
                # In nobody's name: this may run in that of the supervisor that has made the process.
                self.node.base_context.copy().run(self.node.emit, event)

    def processes(self) -> dict[str, int]:
        """The pid of each actor's process, by address."""
        return {cell.path: worker.pid for cell, worker in self.by_cell.items()}

    async def close(self) -> None:
        """End every process and the fork server."""
        self._closed = True
        self.effects.close()
        if self._refilling is not None:
            self._refilling.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._refilling
        for server in self._servers:
            server.expect_exits()
        graves = [worker.gone() for worker in list(self._alive.values())]
        if graves:
            await asyncio.wait(graves, timeout=REAPED_WITHIN * 2)
        async with self._opening:  # Whoever is in the middle of starting one has given up, or has it now.
            servers, self._servers, self._server = self._servers, [], None
        for server in servers:
            await server.stop()
        for worker in list(self._alive.values()):  # Its server could not tell of its end, or not in time.
            worker.bury()
