"""Installs the faults of each point: which function is exchanged, and for what. See `faults.POINTS`."""

from __future__ import annotations

import asyncio
import signal
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import msgspec

from ..actors.errors import HoldfastError, ProcessUnavailable, SpecError
from ..actors.kernel import mailbox
from ..actors.kernel.cell import GONE, Cell
from ..actors.kernel.envelope import Ask, Envelope, Handler
from ..actors.kernel.message import message_of
from ..actors.kernel.ref import ActorRef
from ..actors.process.process_host import WorkerPlace
from ..actors.process.wire import frames
from ..actors.process.worker_pool import Worker
from ..checkpoint.commit_lanes import Submission
from ..checkpoint.home.recorded_home import switch_of
from ..checkpoint.inputs import HomeJournal
from ..checkpoint.journal import Saved, StoreFailed
from ..checkpoint.life.recorded_inbox import Fed
from ..system.system import ActorSystem
from .damage import damaged
from .faults import Strikes
from .fleet.sim_fleet import SimFleet, SimProgram
from .swaps import Swaps
from .turns import Substitute, TurnWatcher, watch_turns

Target = ActorRef[Any] | ActorSystem | SimFleet | SimProgram


def _cell(strikes: Strikes, target: Target) -> Cell:
    if not isinstance(target, ActorRef):
        raise SpecError("faults", f"{strikes.at!r} is a point of an actor: give its ref")
    cell: Cell = target._cell
    return cell


# -- admit, reply: what stands in `cell.admit` is exchanged ----------------------------------------------------------


def _exchange_admit(strikes: Strikes, cell: Cell, made: Callable[[Any], Any]) -> None:
    """Put another admit function before the one that stands there; a recorded actor's is put there at each life."""
    admit = made(cell.admit)
    switch = switch_of(cell)
    swaps = Swaps()
    if switch is not None:
        swaps.put(switch, "admit", admit)
    swaps.put(cell, "admit", admit)

    def undo() -> None:
        swaps.undo()
        if cell.admit is mailbox.admit_first and cell.queue is not None:
            cell.admit = mailbox.admit_queue

    strikes.at_end(undo)


class Late:
    """What faults hold back: it comes when its time is over, or when they end."""

    def __init__(self, strikes: Strikes) -> None:
        self._strikes = strikes
        self._waiting: dict[asyncio.TimerHandle, Callable[[], None]] = {}
        strikes.at_end(self.come)

    def hold(self, loop: asyncio.AbstractEventLoop, go: Callable[[], None]) -> None:
        """Call `go` later."""

        def come() -> None:
            del self._waiting[handle]
            go()

        handle = loop.call_later(self._strikes.delay(), come)
        self._waiting[handle] = go

    def come(self) -> None:
        """Let all of it go on now."""
        waiting, self._waiting = self._waiting, {}
        for handle, go in waiting.items():
            handle.cancel()
            go()


class Admission:
    """Faults of messages on their way into a mailbox."""

    def __init__(self, strikes: Strikes, original: Any) -> None:
        self._strikes, self._original = strikes, original
        self._held: deque[tuple[Cell, Any]] = deque()  # by a reordering: they come after the next message, or late
        self._late = Late(strikes)
        strikes.at_end(self._come)

    def admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`."""
        if type(item) not in cell.table:
            cell.require(item)  # What is refused at the call stays so, whatever happens on the way.
        match self._strikes.next(message_of(item)):
            case "drop":
                return
            case "delay":
                self._late.hold(cell.node.loop, lambda: self._admit_late(cell, item))
                return
            case "reorder":
                self._held.append((cell, item))
                self._late.hold(cell.node.loop, self._come)  # No other may come.
                return
            case "corrupt":
                item = self._corrupt(item)
            case "duplicate":
                self._original(cell, item)
            case _:
                pass
        self._original(cell, item)
        self._come()

    def _come(self) -> None:
        while self._held:
            self._admit_late(*self._held.popleft())

    def _corrupt(self, item: Any) -> Any:
        message = damaged(message_of(item), self._strikes.draw)
        if isinstance(item, Ask):
            item.message = message
            return item
        return Envelope(message, item.sender) if isinstance(item, Envelope) else message

    def _admit_late(self, cell: Cell, item: Any) -> None:
        """Its sender does not wait for this call any more."""
        try:
            (mailbox.admit_gone if cell.state is GONE else self._original)(cell, item)
        except HoldfastError as error:
            if isinstance(item, Ask):
                item.fail(error)
            else:
                cell.node.dead_letter(cell, item, str(error))


def admit(strikes: Strikes, target: Target) -> None:
    """Install at "admit"."""
    _exchange_admit(strikes, _cell(strikes, target), lambda original: Admission(strikes, original).admit)


class FaultyReply:
    """Stands for the future of an ask: the reply passes here on its way to the asker."""

    __slots__ = ("_ask", "_late", "_real", "_strikes")

    def __init__(self, strikes: Strikes, late: Late, ask: Ask) -> None:
        self._strikes, self._late, self._ask, self._real = strikes, late, ask, ask.future

    def done(self) -> bool:
        """Whether the asker has its outcome."""
        return bool(self._real.done())

    def set_exception(self, error: BaseException) -> None:
        """A failure, the deadline among them, is no reply: it goes through."""
        self._real.set_exception(error)

    def set_result(self, reply: Any) -> None:
        """The reply."""
        ask = self._ask
        match self._strikes.next(reply):
            case "drop":
                return
            case "delay":
                ask.future = self._real  # The next time it is the reply itself.
                self._late.hold(ask.to.node.loop, lambda: ask.answer(reply))
                return
            case "corrupt":
                reply = damaged(reply, self._strikes.draw)
            case "duplicate":
                ask.to.node.loop.call_soon(ask.answer, reply)
            case _:
                pass
        self._real.set_result(reply)


def reply(strikes: Strikes, target: Target) -> None:
    """Install at "reply"."""

    late = Late(strikes)

    def made(original: Any) -> Any:
        def admit(cell: Cell, item: Any) -> None:
            if type(item) is Ask and isinstance(item.future, asyncio.Future | FaultyReply):
                item.future = FaultyReply(strikes, late, item)
            original(cell, item)

        return admit

    _exchange_admit(strikes, _cell(strikes, target), made)


# -- turns -----------------------------------------------------------------------------------------------------------


class TurnFaults(TurnWatcher):
    """Faults of the turns of one actor."""

    def __init__(self, strikes: Strikes, cell: Cell) -> None:
        self._strikes, self._cell = strikes, cell
        self._hung: list[asyncio.Future[None]] = []

    def begins(self, cell: Cell, item: Any) -> Substitute | None:
        if cell is not self._cell or not (message_of(item) is not None or isinstance(item, Fed)):
            return None
        if isinstance(item, Fed) and item.feed.turn >= 0 and not self._strikes.replays:
            return None  # It has ended in an earlier life: faults are meant for what happens from now on.
        return self._before if self._strikes.at == "turn begin" else self._after

    def _before(self, handler: Handler) -> Handler:
        def turn(actor: Any, message: Any) -> object:
            wait = self._strike(message)
            return handler(actor, message) if wait is None else self._late(wait, handler, actor, message)

        return turn

    async def _late(self, wait: Awaitable[None], handler: Handler, actor: Any, message: Any) -> object:
        await wait
        result = handler(actor, message)
        return await result if asyncio.iscoroutine(result) else result

    def _after(self, handler: Handler) -> Handler:
        def turn(actor: Any, message: Any) -> object:
            result = handler(actor, message)
            if asyncio.iscoroutine(result):
                return self._end_later(result, message)
            wait = self._strike(message)
            return result if wait is None else self._end_later(_given(result), message, wait)

        return turn

    async def _end_later(self, handler: Any, message: Any, wait: Awaitable[None] | None = None) -> object:
        result = await handler
        if wait is None:
            wait = self._strike(message)
        if wait is not None:
            await wait
        return result

    def _strike(self, message: Any) -> Awaitable[None] | None:
        """Crash now, or give what the turn has to wait for."""
        match self._strikes.next(message):
            case "crash":
                raise self._strikes.crash()
            case "hang":
                hung: asyncio.Future[None] = self._cell.node.loop.create_future()
                self._hung.append(hung)
                return hung
            case "delay":
                return asyncio.sleep(self._strikes.delay())
            case _:
                return None

    def end(self) -> None:
        """What hangs goes on."""
        for hung in self._hung:
            if not hung.done():
                hung.set_result(None)


async def _given(result: object) -> object:
    return result


def turn(strikes: Strikes, target: Target) -> None:
    """Install at "turn begin" and "turn end"."""
    cell = _cell(strikes, target)
    if cell.more is not None and isinstance(cell.host.place, WorkerPlace):
        raise SpecError("faults", f"the turns of {cell.path} are in another process: use 'frame out' or 'frame in'")
    watcher = TurnFaults(strikes, cell)
    strikes.at_end(watcher.end)
    strikes.at_end(watch_turns(cell.node, watcher))


# -- frames ----------------------------------------------------------------------------------------------------------

CARRIERS = (frames.Tell, frames.Ask, frames.Offer, frames.Reply, frames.Failure, frames.Record)
"""Frames that carry something of an actor's; the others keep the process itself going."""
LOSABLE = (frames.Tell, frames.Ask, frames.Reply, frames.Failure)
"""A lost record would be no fault of the outside but a broken protocol."""
NO_FRAME = b"\xc1"
"""A byte that MessagePack never uses."""


class FrameFaults:
    """Faults of the frames of one actor, whatever process it lives in."""

    def __init__(self, strikes: Strikes, cell: Cell) -> None:
        self._strikes, self._cell = strikes, cell
        self._held: deque[Callable[[], None]] = deque()  # by a delay: order is kept, so all that follows waits too
        self._handle: asyncio.TimerHandle | None = None
        self._struck_down: Worker | None = None  # it ends, but not in this instant: nothing more strikes it
        self.swaps = Swaps()

    def install(self, worker: Worker) -> None:
        """Exchange what sends to, or hears from, this process."""
        connection = worker.connection
        if self._strikes.at == "frame out":
            send = connection.send

            def send_faulty(frame: frames.Frame, actor: str = "") -> None:
                self._pass(worker, frame, lambda: send(frame, actor))

            def tell_faulty(to: int, name: int, message: Any, number: int, actor: str) -> None:
                send_faulty(frames.Tell(to, name, message, number), actor)  # each in a frame of its own

            self.swaps.put(connection, "send", send_faulty)
            self.swaps.put(connection, "tell", tell_faulty)
            return
        self.swaps.put(connection, "_on_frame", self._heard(worker, connection._on_frame))
        takers = {kind: self._heard(worker, take) for kind, take in connection.takers.items()}
        self.swaps.put(connection, "takers", takers)

    def _heard(self, worker: Worker, take: Callable[[Any], None]) -> Callable[[Any], None]:
        def hear(frame: Any) -> None:
            self._pass(worker, frame, lambda: take(frame))

        return hear

    def _pass(self, worker: Worker, frame: Any, go: Callable[[], None]) -> None:
        """One frame passes, or what becomes of it."""
        counts = isinstance(frame, CARRIERS) and worker is not self._struck_down
        kind = self._strikes.next(frame) if counts else None
        if kind == "delay" and self._handle is None:
            self._handle = self._cell.node.loop.call_later(self._strikes.delay(), self.let_go)
        if self._handle is not None:
            if self._strikes.at == "frame in" and frames.payload_of(frame) is not None:
                frame.body = msgspec.Raw(bytes(frame.body))  # It lies in a buffer that is used again.
            self._held.append(go)
        elif kind == "drop" and isinstance(frame, LOSABLE):
            if self._strikes.at == "frame out":
                worker.connection.names.withdraw(frame)
        elif kind == "corrupt":
            self._struck_down = worker
            self._corrupt(worker)
        else:
            go()
            if kind == "crash":
                self._struck_down = worker
                worker.connection.flush()
                worker.forked.kill(signal.SIGKILL)

    def _corrupt(self, worker: Worker) -> None:
        """Bytes that are no frame, in place of one."""
        if self._strikes.at == "frame in":
            raise msgspec.DecodeError("an injected fault has damaged it")
        connection = worker.connection
        connection._out += [len(NO_FRAME).to_bytes(4, "little"), NO_FRAME]
        connection._loop.call_soon(connection.flush)

    def let_go(self) -> None:
        """The delay is over."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
        while self._held and self._handle is None:
            self._held.popleft()()


def frame(strikes: Strikes, target: Target) -> None:
    """Install at "frame out" and "frame in", in the present process and in those that follow."""
    cell = _cell(strikes, target)
    place = cell.host.place
    if not isinstance(place, WorkerPlace):
        raise SpecError("faults", f"{cell.path} has no process of its own: {strikes.at!r} is where frames pass")
    faults = FrameFaults(strikes, cell)
    adopt = Worker.adopt

    def adopted(worker: Worker, adopting: Cell, *rest: Any) -> None:
        adopt(worker, adopting, *rest)
        if adopting is cell:
            faults.install(worker)

    faults.swaps.put(Worker, "adopt", adopted)
    present = place.workers.of(cell)
    if present is not None:
        faults.install(present)
    strikes.at_end(faults.let_go)
    strikes.at_end(faults.swaps.undo)


# -- journal, processes ----------------------------------------------------------------------------------------------


class FaultyJournal:
    """A journal that sometimes refuses: what it refuses is not written."""

    def __init__(self, strikes: Strikes, real: HomeJournal) -> None:
        self._strikes, self._real = strikes, real
        self.durable, self.epoch, self.commits = real.durable, real.epoch, real.commits

    def _refuse(self, point: str, what: object) -> None:
        if self._strikes.at == point and self._strikes.next(what) is not None:
            raise StoreFailed(f"of {self._strikes.path}", f"injected fault at {point!r} (seed {self._strikes.seed})")

    def admit(self, submission: Submission) -> None:
        """What has happened already (`submit`) is not refused: it waits until it can be written."""
        self._refuse("journal append", [entry[0] for _, entry in submission.entries])
        self._real.admit(submission)

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        self._refuse("snapshot write", f"{len(snapshot)} bytes after turn {turn}")
        self._real.cut(address, snapshot, drop, turn=turn, keep=keep)

    def load(self, address: str, *, older: int = False) -> Saved:
        return self._real.load(address, older=older)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)


def journal(strikes: Strikes, target: Target) -> None:
    """Install at "journal append" and "snapshot write"."""
    cell = _cell(strikes, target)
    switch = switch_of(cell)
    if switch is None or not switch.journal.durable:
        raise SpecError("faults", f"{cell.path} has no journal in a durable store: {strikes.at!r} is where it writes")
    swaps = Swaps()
    swaps.put(switch, "journal", FaultyJournal(strikes, switch.journal))
    strikes.at_end(swaps.undo)


def process(strikes: Strikes, target: Target) -> None:
    """Install at "process start"."""
    if not isinstance(target, ActorSystem):
        raise SpecError("faults", "'process start' is a point of a system: give that")
    workers = target._workers
    take = workers.take

    async def take_faulty(*, again: bool = False) -> Worker:
        match strikes.next("a process"):
            case "fail":
                raise ProcessUnavailable(f"injected fault at 'process start' (seed {strikes.seed})")
            case "delay":
                await asyncio.sleep(strikes.delay())
            case "crash":
                worker = await take(again=again)
                worker.forked.kill(signal.SIGKILL)
                return worker
            case _:
                pass
        return await take(again=again)

    swaps = Swaps()
    swaps.put(workers, "take", take_faulty)
    strikes.at_end(swaps.undo)


def program(strikes: Strikes, target: Target) -> None:
    """Install at "post" or "request"."""
    match target:
        case SimProgram():
            target.fleet.frames.add(strikes, target)
        case SimFleet():
            target.frames.add(strikes, None)
        case _:
            raise SpecError("faults", f"{strikes.at!r} is a point of a simulated fleet: give that, or a program of it")


INSTALL: dict[str, Callable[[Strikes, Target], None]] = {
    "admit": admit,
    "turn begin": turn,
    "turn end": turn,
    "reply": reply,
    "frame out": frame,
    "frame in": frame,
    "journal append": journal,
    "snapshot write": journal,
    "process start": process,
    "post": program,
    "request": program,
}
"""What installs the faults of each point."""
