"""Actors in OS processes of their own, seen from the root: their home (queue, what is in flight) and their life.

The home stays when the process dies. What was sent and not begun is sent again to the next life; the page, memory that
both sides share and that survives a SIGKILL, says how far the dead one came.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .. import links, lives, mailbox
from ..cell import DOWN, ENDING, GONE, RUNNING, Cell
from ..codec import Parcel
from ..errors import AskFailed, BadMessage, ProcessUnavailable, StartFailed
from ..events import ActorStarted
from ..exits import KILLED, ExitReason, pack_exit
from ..mail import Ask, Envelope, Item
from . import frames
from .limits import Limits
from .recipe import pack_recipe
from .relay import RelayedAsk, send_signal
from .workers import Worker, Workers

if TYPE_CHECKING:
    from ..node import Node

TRIM = 256
"""How many messages may be in flight before the page is asked which of them are done."""


class Outlet:
    """The way from an address to the process its actor lives in, and what is on the way."""

    __slots__ = ("_asked", "acknowledged", "flight", "path", "sent", "worker")

    def __init__(self, path: str) -> None:
        self.path = path
        self.worker: Worker | None = None
        self.flight: deque[tuple[int, Any]] = deque()  # (number, item), oldest first, until the page says done
        self.sent = 0

    def send(self, cell: Cell, item: Any) -> None:
        """Send to the process; raises BadMessage if the item cannot be coded."""
        worker = self.worker
        assert worker is not None
        number = self.sent + 1
        worker.send_item(cell, self.path, item, number)
        self.sent = number
        self.flight.append((number, item))
        if len(self.flight) >= TRIM and number % TRIM == 0:
            self.trim()

    def trim(self) -> None:
        """Forget what has been handled."""
        worker, flight = self.worker, self.flight
        done = worker.page[1] if worker is not None else 0
        while flight and flight[0][0] <= done:
            flight.popleft()

    def room(self) -> asyncio.Future[None] | None:
        """None when the process keeps up."""
        return self.worker.connection.room() if self.worker is not None else None

    def close(self) -> tuple[list[Any], list[Any]]:
        """The process is gone. Returns what was being handled and what was not begun, in order."""
        worker, self.worker = self.worker, None
        running, done = (worker.page[0], worker.page[1]) if worker is not None else (0, 0)
        flight, self.flight, self.sent = self.flight, deque(), 0
        begun = [item for number, item in flight if number == running > done]
        queued = [item for number, item in flight if number > max(running, done)]
        return begun, queued


def admit_remote(cell: Cell, item: Any) -> None:
    """The mailbox of an actor in another process: sent at once, or kept until the process is up."""
    if type(item) not in cell.table and type(item) is not Parcel:
        _require(cell, item)
    outlet: Outlet = cell.extra().outlet
    if outlet.worker is None:
        _check_codable(cell, item)
        mailbox.queue_of(cell).append(item)
    else:
        outlet.send(cell, item)


def _require(cell: Cell, item: Any) -> None:
    if not isinstance(item, (Ask, Envelope)):
        cell.require(item)


def _check_codable(cell: Cell, item: Any) -> None:
    """Refuse now what could not be sent later."""
    message = item.message if isinstance(item, (Ask, Envelope)) else item
    if type(message) is not Parcel:
        cell.node.codec.encode(message, cell.path)


class ProcessHost:
    """The host of actors with a process of their own; one per such address."""

    takes_parcels = True

    def recovers(self, reason: Any) -> bool:
        return False

    def __init__(self, workers: Workers, limits: Limits | None, options: dict[str, Any] | None = None) -> None:
        self._workers = workers
        self._limits = limits
        self._options = options or {}
        self._starting: asyncio.Task[None] | None = None
        self._stop_wanted: ExitReason | None = None

    # -- beginning --------------------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> asyncio.Future[None]:
        """Begin a life in a fresh process."""
        more = cell.extra()
        assert more.start is not None
        cell.table = more.start.kind._table
        if more.outlet is None:
            more.outlet = Outlet(cell.path)
            cell.admit = admit_remote
        self._stop_wanted = None
        self._starting = cell.node.loop.create_task(self._start(cell), name=f"start of {cell.path}")
        return self._starting

    async def _start(self, cell: Cell) -> None:
        start = cell.extra().start
        assert start is not None
        try:
            recipe = pack_recipe(start, cell.path)
            worker = await self._workers.take()
        except ProcessUnavailable as error:
            raise StartFailed(cell.path, str(error)) from error
        cell.life += 1
        cell.state = RUNNING
        worker.adopt(cell, self._limits, self.died)
        for topic in start.kind._topics:
            cell.node.topics.subscribe(topic, cell)
        try:
            await worker.launch(cell, recipe, self._options)
        except StartFailed:
            await worker.gone()
            raise
        self.up(cell, worker)

    def up(self, cell: Cell, worker: Worker) -> None:
        """The life is up: send what waits."""
        node = cell.node
        if node.watched:
            node.emit(ActorStarted(cell.path, cell.life))
        outlet: Outlet = cell.extra().outlet
        outlet.worker = worker
        queue = cell.queue
        while queue and outlet.worker is not None:
            item = queue.popleft()
            try:
                if isinstance(item, (Exit_, Down_)):
                    send_signal(worker, cell.path, item)
                else:
                    outlet.send(cell, item)
            except BadMessage as error:
                if isinstance(item, Ask):
                    item.fail(error)
                else:
                    node.dead_letter(cell, item, str(error))
        if self._stop_wanted is not None:
            self.stop(cell, self._stop_wanted)

    # -- ending -----------------------------------------------------------------------------------------------------

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        """Ask the actor to end in good order; while it starts, when it is up."""
        worker = self._workers.of(cell)
        outlet: Outlet | None = cell.extra().outlet
        if worker is None or outlet is None or outlet.worker is None:
            self._stop_wanted = reason
            return
        self.send_stop(worker, cell, reason)

    @staticmethod
    def send_stop(worker: Worker, cell: Cell, reason: ExitReason) -> None:
        """Tell the process that its actor shall end."""
        connection = worker.connection
        connection.send(frames.Command(connection.name_out(cell.path), "stop", {"reason": pack_exit(reason)}))

    def kill(self, cell: Cell) -> None:
        """SIGKILL the process."""
        worker = self._workers.of(cell)
        if worker is not None:
            worker.kill(KILLED)
        elif self._starting is not None:
            self._starting.cancel()

    def died(self, cell: Cell, reason: ExitReason) -> None:
        """The process is gone, or the life in it has ended: keep what is queued, fail what was begun."""
        if cell.state in (DOWN, GONE):
            return
        outlet: Outlet = cell.extra().outlet
        worker = self._workers.of(cell)
        begun, queued = outlet.close()
        if queued:
            mailbox.queue_of(cell).extendleft(reversed(queued))
        for item in begun:
            if isinstance(item, Ask):
                item.fail(AskFailed(cell.path, str(reason)))
        again = {id(item) for item in queued}
        if worker is not None:
            for ask in worker.take_pending():
                if id(ask) not in again:  # Asks from inside the process, or delayed replies: nobody answers them now.
                    ask.fail(AskFailed(cell.path, str(reason)))
        lives.ended(cell, reason)

    def retired(self, cell: Cell) -> None:
        worker = self._workers.of(cell)
        if worker is not None:
            worker.kill(KILLED)

    def push(self, cell: Cell, item: Item) -> None:
        outlet: Outlet | None = cell.extra().outlet
        if outlet is None or outlet.worker is None:
            mailbox.queue_of(cell).append(item)
        else:
            send_signal(outlet.worker, cell.path, item)


Exit_, Down_ = links.Exit, links.Down


def on_frame(node: Node, worker: Worker, frame: frames.AnyFrame) -> None:
    """What comes from an actor process: messages for others, and replies."""
    match frame:
        case frames.Reply():
            worker.on_reply(frame)
        case frames.Tell():
            worker.on_tell(_target(node, worker, frame.to), frame, None)
        case frames.Ask():
            worker.on_ask(_target(node, worker, frame.to), frame, None)
        case frames.Failure():
            worker.on_failure(frame)
        case frames.Publish():
            _publish(node, worker, frame)
        case frames.Command():
            _command(node, worker, frame)
        case frames.Launched():
            worker.on_launched(frame)
        case frames.Ended():
            worker.on_ended(frame)
        case frames.Beat():
            worker.beat()
        case frames.Note():
            worker.on_note(frame)
        case frames.Record():
            worker.on_record(frame)
        case frames.Launch():
            raise TypeError("an actor process cannot launch actors here")


def _target(node: Node, worker: Worker, to: frames.Name) -> Cell:
    if type(to) is int and (cell := worker.targets.get(to)) is not None and cell.state is not GONE:
        return cell
    path = worker.connection.name_in(to)
    cell = node.cell_at(path)
    worker.targets[worker.connection.number_in(path)] = cell
    return cell


def _publish(node: Node, worker: Worker, frame: frames.Publish) -> None:
    """A message for every subscriber; each decodes it for itself."""
    name = worker.connection.name_in(frame.name)
    sender = None if frame.sender is None else node.cell_at(worker.connection.name_in(frame.sender))
    for cell in node.topics.subscribers(frame.topic):
        try:
            message = node.codec.message_in(cell, name, frame.body)
            cell.admit(cell, message if sender is None else Envelope(message, sender))
        except Exception as error:  # One subscriber's trouble is not another's.
            node.dead_letter(cell, Parcel(name, bytes(frame.body)), str(error))


def _command(node: Node, worker: Worker, frame: frames.Command) -> None:
    """A command from an actor process to an address: links and monitors, stop and kill."""
    from ..exits import unpack_exit

    target = node.cell_at(worker.connection.name_in(frame.to))
    match frame.verb:
        case "stop":
            target.request_stop(unpack_exit(frame.data["reason"]))
        case "kill":
            target.kill()
        case "monitor":
            links.monitor(node.cell_at(frame.data["watcher"]), target, for_good=bool(frame.data["for_good"]))
        case "link":
            links.link(node.cell_at(frame.data["peer"]), target)
        case "unlink":
            links.unlink(node.cell_at(frame.data["peer"]), target)
        case "subscribe":
            node.topics.subscribe(frame.data["topic"], target)
        case "unsubscribe":
            node.topics.unsubscribe(frame.data["topic"], target)
        case verb:
            raise TypeError(f"unknown command {verb!r}")


