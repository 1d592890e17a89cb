"""Actors in OS processes of their own, seen from the root: their home (queue, what is in flight) and their life.

The home stays when the process dies. What was sent and not begun is sent again to the next life; the page, memory that
both sides share and that survives a SIGKILL, says how far the dead one came.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from ..control.orders_lane import ask_turns, send_call
from ..errors import AskFailed, BadMessage, HoldfastError, StartFailed
from ..events import ActorStarted, StoreRefused
from ..exit_reasons import KILLED, ExitReason, pack_exit, unpack_exit
from ..kernel import lifecycle, links, mailbox
from ..kernel.address_host import AddressHost, Home, Parent, Place, Work
from ..kernel.cell import DOWN, GONE, RUNNING, Cell, GivenName, TurnRest
from ..kernel.codec import Parcel
from ..kernel.envelope import Ask, Envelope, Item
from ..kernel.lifecycle import NEAR
from ..overflow import DROPS
from ..persistence import child_key
from .resource_limits import Limits, limits_data
from .wire import frames
from .wire.frames import BadFrame
from .wire.peer import obey, send_signal
from .wire.start_codec import pack_recipe
from .worker_pool import Worker, Workers

if TYPE_CHECKING:
    from ..control.orders_lane import QueuedOrder
    from ..kernel.node import Node


PATIENCE = 1.0
"""Seconds in which a process tells of its actor's turns; else what it said of a rest does not count any more."""


class OwnTurns(NamedTuple):
    """What the process of an actor has told of its turns, as `turns_of` says it."""

    seen: int = 0
    rests: tuple[TurnRest, ...] = ()
    awaits: str = ""


class Outlet:
    """The way from an address to the process its actor lives in, and what is on the way."""

    __slots__ = ("begun", "flight", "own_turns", "path", "question", "sent", "worker")

    def __init__(self, path: str) -> None:
        self.path = path
        self.begun = 0  # the newest that has been begun, as far as it was looked at
        self.worker: Worker | None = None
        self.flight: deque[tuple[int, Any]] = deque()  # (number, item), oldest first, until the page says done
        self.sent = 0
        self.own_turns = OwnTurns()
        self.question: asyncio.Future[Any] | None = None  # to the process, of its actor's turns

    def ask_turns(self, cell: Cell) -> None:
        """Have the process tell of its actor's turns, unless it was asked already."""
        if self.worker is not None and self.question is None:
            self.question = ask_turns(self.worker, cell, PATIENCE)
            self.question.add_done_callback(self._told)

    def _told(self, answer: asyncio.Future[Any]) -> None:
        self.question = None
        self.own_turns = OwnTurns(self.own_turns.seen)
        if not answer.cancelled() and answer.exception() is None:
            with contextlib.suppress(
                msgspec.ValidationError
            ):  # A process may say anything; this is about its own actor.
                self.own_turns = msgspec.convert(answer.result(), OwnTurns)

    def hand_over(self, cell: Cell, item: Any) -> None:
        """Send what was queued, the runtime's own signals among it."""
        worker = self.worker
        assert worker is not None
        if isinstance(item, (links.Exit, links.Down)):
            send_signal(worker, self.path, item)
        else:
            self.send(cell, item)

    def hand_over_queue(self, cell: Cell) -> None:
        """Send all that is queued; what turns out not to be sendable is undelivered."""
        queue = cell.queue
        while queue:
            item = queue.popleft()
            try:
                self.hand_over(cell, item)
            except BadMessage as error:
                undelivered(cell, item, error)

    def send(self, cell: Cell, item: Any) -> None:
        """Send to the process; raises BadMessage if the item cannot be coded."""
        worker = self.worker
        assert worker is not None
        number = self.sent + 1
        name = worker.kinds_out.get(type(item))
        if name is None:
            worker.send_item(cell, self.path, item, number)
        else:  # A plain message of a type that was sent before: all names are numbers.
            connection = worker.connection
            connection.tell(connection.names.to_wire(self.path), name, item, number, self.path)  # type: ignore[arg-type]
        self.sent = number
        flight = self.flight
        flight.append((number, item))
        done = worker.page[1]
        try:
            while flight[0][0] <= done:  # What has been handled is let go soon: a large message is large memory.
                flight.popleft()
        except IndexError:  # Not even this one is left, and it has not gone out yet.
            worker.breach(f"its page says that message {done} is done, and {number} were sent")

    def trim(self) -> object:
        """Forget what has been handled; returns the newest of it, None if there was nothing to forget."""
        worker, flight, newest = self.worker, self.flight, None
        done = worker.number(1, self.sent) if worker is not None else 0
        while flight and flight[0][0] <= done:
            _, newest = flight.popleft()
        return newest

    @property
    def has_room(self) -> bool:
        """Whether the process keeps up."""
        return self.worker is None or self.worker.connection.has_room

    def room(self) -> asyncio.Future[None] | None:
        """None when the process keeps up."""
        return self.worker.connection.room() if self.worker is not None else None

    def close(self) -> tuple[list[Any], list[Any]]:
        """The process is gone. Returns what was being handled and what was not begun, in order."""
        worker, self.worker = self.worker, None
        numbers = (0, 0) if worker is None else (worker.number(0, self.sent), worker.number(1, self.sent))
        running, done = numbers
        flight, self.flight, self.sent, self.begun = self.flight, deque(), 0, 0
        self.own_turns = OwnTurns(self.own_turns.seen)
        begun = [item for number, item in flight if number == running > done]
        queued = [item for number, item in flight if number > max(running, done)]
        for item in queued:
            if isinstance(item, Ask):
                item.started = False
        return begun, queued


def admit_remote(cell: Cell, item: Any) -> None:
    """The mailbox of an actor in another process: sent at once, or kept until the process is up."""
    if type(item) not in cell.table and type(item) is not Parcel:
        _require(cell, item)
    outlet: Outlet = cell.more.outlet  # type: ignore[union-attr]  # made before this function stands there
    cell.node.check_caller(outlet.path)
    if outlet.worker is None:
        _check_codable(cell, item)
        mailbox.queue_of(cell).append(item)
    else:
        outlet.send(cell, item)


def admit_remote_bounded(cell: Cell, item: Any) -> None:
    """As `admit_remote`, with a capacity: what is queued here counts, and what is sent and not begun."""
    if type(item) not in cell.table and type(item) is not Parcel:
        _require(cell, item)
    more = cell.extra()
    cell.node.check_caller(cell.path)
    _check_codable(cell, item)
    assert more.bound is not None
    more.bound.admit(cell, item)


class RemoteBound(mailbox.Bound):
    """The bound of a mailbox whose actor lives in another process.

    What is sent cannot be dropped any more. So a policy that drops queued messages sends one at a time.
    """

    __slots__ = ("_at_once",)

    def __init__(self, bound: mailbox.Bound) -> None:
        super().__init__(bound.capacity, bound.overflow)
        self._at_once = 1 if bound.overflow in DROPS else bound.capacity + 1

    def admit(self, cell: Cell, item: Any) -> None:
        if self.count >= self.capacity:
            self.moved(cell)  # The page may be ahead of what we were told.
        super().admit(cell, item)

    def has_room(self, cell: Cell) -> bool:
        if self.count >= self.capacity:
            self.moved(cell)
        return super().has_room(cell)

    def put(self, cell: Cell, item: Any) -> None:
        self.count += 1
        mailbox.queue_of(cell).append(item)
        self.send(cell)

    def send(self, cell: Cell) -> None:
        """Send what is queued, as far as it may go."""
        outlet: Outlet = cell.extra().outlet
        queue = mailbox.queue_of(cell)
        if outlet.worker is None:
            return
        outlet.trim()
        while queue and len(outlet.flight) < self._at_once:
            item = deque.popleft(queue)  # It still counts.
            try:
                outlet.hand_over(cell, item)
            except BadMessage as error:
                self.count -= mailbox.counts(item)
                undelivered(cell, item, error)

    def moved(self, cell: Cell) -> None:
        """The actor has begun or ended turns."""
        outlet: Outlet = cell.extra().outlet
        if outlet.worker is None:
            return
        begun = max(outlet.begun, outlet.worker.number(0, outlet.sent))
        freed, outlet.begun = begun - outlet.begun, begun
        for _ in range(freed):
            self.taken(cell)
        self.send(cell)

    def recount(self, cell: Cell) -> None:
        """The process is gone: what counts is what is queued."""
        self.count = sum(map(mailbox.counts, cell.queue or ()))


def undelivered(cell: Cell, item: Any, error: HoldfastError) -> None:
    """A queued item turned out not to be sendable."""
    if isinstance(item, Ask):
        item.fail(error)
    else:
        cell.node.dead_letter(cell, item, str(error))


def _require(cell: Cell, item: Any) -> None:
    if not isinstance(item, (Ask, Envelope)):
        cell.require(item)


def _check_codable(cell: Cell, item: Any) -> None:
    """Refuse now what could not be sent later."""
    message = item.message if isinstance(item, (Ask, Envelope)) else item
    if type(message) is not Parcel:
        cell.node.codec.encode(message, cell.path)


class WorkerHome(Home):
    """A home whose lives can be lived in a process of their own."""

    keeps_links = True
    """Whether a life's links outlive it, so that its end is told here, and its process knows of none of them."""

    def enter(self, cell: Cell) -> Any:
        """A life is to begin: from here on what is sent is admitted by the home. Returns what `goes_on` needs.

        Raises:
            StartFailed: it cannot.
        """
        raise NotImplementedError

    async def let_begin(self) -> None:
        """Wait until the life may begin."""

    def subscribe(self, cell: Cell, topics: Iterable[str]) -> None:
        """See to it that what is published comes in."""
        raise NotImplementedError

    def hand_to(self, cell: Cell, worker: Worker) -> dict[str, Any]:
        """Give a process what the next life begins with; returns the options of its launch."""
        raise NotImplementedError

    async def goes_on(self, cell: Cell, worker: Worker, entered: Any) -> None:
        """The life has begun there: what waits goes to it.

        Raises:
            StartFailed: it has ended meanwhile, or cannot go on from where the last one was.
        """
        raise NotImplementedError

    def readdressed(self, cell: Cell) -> None:
        """The actor has moved to another supervisor."""

    def takes_stop(self, cell: Cell) -> bool:
        """Whether a life has come so far that it can be told to end in good order."""
        raise NotImplementedError

    def in_hand(self, worker: Worker) -> int:
        """The number of the input that a process has in hand, -1 if none is known."""
        return -1

    def has_come_to(self, worker: Worker, key: int) -> bool:
        """Whether a process may have begun a recorded input that has no end."""
        return True

    def lost(self, cell: Cell, worker: Worker | None, reason: ExitReason) -> Callable[[bool | None], None] | None:
        """The process is gone, or the life in it has ended. Returns what is done when it is known what follows.

        None: no life was there.
        """
        raise NotImplementedError


class FlightHome(WorkerHome):
    """A queue here, and what is on its way to the process: sent again to the next life unless it was begun."""

    takes_parcels = True
    keeps_links = False

    def enter(self, cell: Cell) -> None:
        more = cell.extra()
        if more.outlet is None:
            more.outlet = Outlet(cell.path)
            cell.admit = admit_remote
            if more.bound is not None:
                more.bound = RemoteBound(more.bound)
                cell.admit = admit_remote_bounded
        if cell.node.on_life is not None:
            cell.node.on_life(cell)

    def subscribe(self, cell: Cell, topics: Iterable[str]) -> None:
        for topic in topics:
            cell.node.topics.subscribe(topic, cell)

    def hand_to(self, cell: Cell, worker: Worker) -> dict[str, Any]:
        return {"bounded": cell.extra().bound is not None}

    async def goes_on(self, cell: Cell, worker: Worker, entered: Any) -> None:
        if cell.host.place.process(cell) is not worker:
            raise StartFailed(cell.path, str(cell.extra().reason))  # It was up, and has died before we came to it.
        node = cell.node
        if node.events.has_listeners:
            node.emit(ActorStarted(cell.path, cell.life))
        outlet: Outlet = cell.extra().outlet
        outlet.worker = worker
        bound = cell.extra().bound
        if isinstance(bound, RemoteBound):
            bound.send(cell)
        else:
            outlet.hand_over_queue(cell)

    def readdressed(self, cell: Cell) -> None:
        outlet: Outlet | None = cell.extra().outlet
        if outlet is not None:
            outlet.path = cell.path

    def takes_stop(self, cell: Cell) -> bool:
        outlet: Outlet | None = cell.extra().outlet
        return outlet is not None and outlet.worker is not None

    def lost(self, cell: Cell, worker: Worker | None, reason: ExitReason) -> Callable[[bool | None], None] | None:
        """Keep what is queued, fail what was begun."""
        if cell.state in (DOWN, GONE):
            return None
        outlet: Outlet = cell.extra().outlet
        begun, queued = outlet.close()
        if queued:
            mailbox.queue_of(cell).extendleft(reversed(queued))
        bound = cell.extra().bound
        if isinstance(bound, RemoteBound):
            bound.recount(cell)
        for item in begun:
            if isinstance(item, Ask):
                item.fail(AskFailed(cell.path, str(reason)))
        again = {id(item) for item in queued}
        if worker is not None:
            for ask in worker.take_pending():
                if id(ask) not in again:  # Asks from inside the process, or delayed replies: nobody answers them now.
                    ask.fail(AskFailed(cell.path, str(reason)))
        return lambda recovers: None

    def push(self, cell: Cell, item: Item) -> None:
        outlet: Outlet | None = cell.extra().outlet
        if outlet is None or outlet.worker is None or cell.queue:
            mailbox.queue_of(cell).append(item)
        else:
            send_signal(outlet.worker, cell.path, item)

    def is_open(self, cell: Cell) -> bool:
        return self.takes_stop(cell)

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        """The process puts a turn's number on its page first, and only then looks whether its deadline is over."""
        outlet: Outlet | None = cell.extra().outlet
        if outlet is None or outlet.worker is None:
            return True
        page = outlet.worker.page
        return ask.started <= max(page[0], page[1]) or not cell.node.clock.is_past(ask.deadline)

    def backlog(self, cell: Cell, running: int) -> int:
        queued = sum(map(mailbox.counts, cell.queue or ()))
        outlet: Outlet | None = cell.extra().outlet
        if outlet is None or outlet.worker is None:
            return queued
        begun = max(outlet.worker.page[0], outlet.worker.page[1])
        return queued + sum(number > begun for number, _ in outlet.flight)

    def work(self, cell: Cell, running: int) -> Work:
        """The oldest message that was sent to the process and is not handled, or how many were."""
        outlet: Outlet | None = cell.extra().outlet
        if outlet is None or outlet.worker is None:
            return Work()
        newest = outlet.trim()
        has_answered = isinstance(newest, Ask) and newest.is_done
        if outlet.flight:
            return Work(outlet.flight[0][1], True, None, has_answered, outlet.own_turns.seen, newest)
        return Work(outlet.sent, False, None, has_answered, outlet.own_turns.seen, newest)

    def rests(self, cell: Cell) -> list[TurnRest]:
        outlet: Outlet | None = cell.extra().outlet
        return [] if outlet is None else list(outlet.own_turns.rests)

    def awaits(self, cell: Cell) -> str:
        outlet: Outlet | None = cell.extra().outlet
        return "" if outlet is None else outlet.own_turns.awaits

    def ask_turns(self, cell: Cell) -> None:
        outlet: Outlet | None = cell.extra().outlet
        if outlet is not None:
            outlet.ask_turns(cell)

    def load(self, cell: Cell) -> int:
        queued = len(cell.queue or ())
        outlet: Outlet | None = cell.extra().outlet
        if outlet is None or outlet.worker is None:
            return queued
        return queued + int(outlet.sent - outlet.worker.page[1])


FLIGHT = FlightHome()


class WorkerPlace(Place):
    """A process of the actor's own; one such place per address."""

    is_here = False
    kind = "process"
    owns_processes = True

    def __init__(self, home: WorkerHome, parent: Parent, workers: Workers, limits: Limits | None) -> None:
        self.home, self.parent, self.workers, self._limits = home, parent, workers, limits
        self._starting: asyncio.Task[None] | None = None
        self._stop_wanted: ExitReason | None = None
        self.stop_sent: ExitReason | None = None  # the life in the process has been told to stop

    def readdress(self, cell: Cell, was: str, now: str) -> None:
        worker = self.process(cell)
        if worker is not None:
            worker.readdress(was, now)
        self.home.readdressed(cell)

    def handed_to(self, parent: Parent) -> None:
        self.parent = parent

    @property
    def has_ended_in_turn(self) -> bool:
        """Whether a turn of an actor in the last process has ended it, though the process's own was still starting."""
        return False

    @property
    def is_ending(self) -> bool:
        """Whether the life in the process has been told to stop."""
        return self.stop_sent is not None or self._stop_wanted is not None

    # -- beginning --------------------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> asyncio.Future[None]:
        """Begin a life in a fresh process, outside the supervisor's turn."""
        start = cell.extra().start
        if start is not None:
            cell.table = start.kind._table
        entered = self.home.enter(cell)  # Now, not in the task.
        self._stop_wanted = self.stop_sent = None
        self._starting = lifecycle.outside_turn(cell, self._start(cell, entered))
        return self._starting

    async def fork(self, *, again: bool = False) -> Worker:
        """A process for a life; `again`: there was one before.

        Raises:
            ProcessUnavailable: there is none to be had.
        """
        return await self.workers.take(again=again)

    async def take(self, cell: Cell) -> tuple[Worker, bytes]:
        """A process for the next life at `cell`, which is running from now on, and its recipe.

        Raises:
            StartFailed: there is none to be had, or the actor was stopped meanwhile.
        """
        start = self.parent.recipe(cell)
        try:
            recipe = start if isinstance(start, bytes) else pack_recipe(start, cell.path)
            worker = await self.fork(again=cell.life > 0)
        except HoldfastError as error:
            raise StartFailed(cell.path, str(error)) from error
        if cell.state is not DOWN:
            worker.kill(KILLED)
            raise StartFailed(cell.path, "it was stopped while it started")
        cell.life += 1
        cell.state = RUNNING
        worker.adopt(cell, self._limits, self.died)
        return worker, recipe

    def options(self, cell: Cell) -> dict[str, Any]:
        """What a launch here says besides what the home says."""
        return {}

    async def _start(self, cell: Cell, entered: Any) -> None:
        await self.home.let_begin()
        worker, recipe = await self.take(cell)
        self.home.subscribe(cell, self.parent.topics(cell))
        try:
            await worker.launch(cell, recipe, {**self.options(cell), **self.home.hand_to(cell, worker)})
            await self.home.goes_on(cell, worker, entered)
        except StartFailed:
            await worker.gone()  # The next life begins when this one is over.
            if self.has_ended_in_turn:
                return  # That is told by its end, and no start has failed.
            raise
        self.settled(cell)

    def settled(self, cell: Cell) -> None:
        """The life in the process is the one; if it was to be stopped before, it is stopped now."""
        if self._stop_wanted is not None:
            self.stop(cell, self._stop_wanted)

    # -- ending -----------------------------------------------------------------------------------------------------

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        """Ask the actor to end in good order; while it starts, when it is up. A supervisor can end while it starts."""
        worker = self.workers.of(cell)
        start = cell.extra().start
        supervises = start is not None and start.kind._supervises
        if worker is not None and (supervises or self.home.takes_stop(cell)):
            self.send_stop(worker, cell, reason)
        else:
            self._stop_wanted = reason

    def send_stop(self, worker: Worker, cell: Cell, reason: ExitReason) -> None:
        """Tell the process that its actor shall end."""
        self.stop_sent = reason
        connection = worker.connection
        connection.send(frames.Command(connection.names.to_wire(cell.path), "stop", {"reason": pack_exit(reason)}))

    def kill(self, cell: Cell) -> None:
        """End the actor's process with SIGKILL."""
        worker = self.workers.of(cell)
        if worker is not None:
            worker.kill(KILLED)
        elif self._starting is not None:
            self._starting.cancel()

    def died(self, cell: Cell, reason: ExitReason) -> None:
        """The process is gone, or the life in it has ended."""
        over = self.home.lost(cell, self.workers.of(cell), reason)
        if over is not None:
            self.parent.life_over(cell, self.home.cause(reason), over)

    def retired(self, cell: Cell) -> None:
        worker = self.workers.of(cell)
        if worker is not None:
            worker.kill(KILLED)
        elif self._starting is not None and not self._starting.done():
            self._starting.cancel()  # It waits for a process that is not wanted any more.

    # -- what else a place does -------------------------------------------------------------------------------------

    def control(self, cell: Cell, call: QueuedOrder) -> None:

        worker = self.workers.of(cell)
        if worker is not None:
            send_call(worker, cell.path, call)
        else:
            cell.extra().calls.append(call)  # Sent behind the next launch.

    def process(self, cell: Cell) -> Worker | None:
        return self.workers.of(cell)

    def is_up(self, cell: Cell) -> bool:
        return self.process(cell) is not None

    def spec_data(self, cell: Cell) -> dict[str, Any]:
        return {"layers": [], "isolation": "process", "limits": limits_data(self._limits)}

    def running(self, cell: Cell) -> int:
        worker = self.workers.of(cell)
        return -1 if worker is None else self.home.in_hand(worker)

    def may_have_begun(self, cell: Cell, key: int) -> bool:
        worker = self.workers.of(cell)
        return worker is not None and self.home.has_come_to(worker, key)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        worker = self.workers.of(cell)
        its_own = ("bind",) if self.home.keeps_links else ("bind", "link", "unlink")
        if worker is not None and verb in its_own:  # What its process has to know of itself.
            worker.connection.send(frames.Command(worker.connection.names.to_wire(cell.path), verb, data))


def in_process(workers: Workers, limits: Limits | None) -> AddressHost:
    """The host of an actor without recovery that has a process of its own."""
    return AddressHost(FLIGHT, WorkerPlace(FLIGHT, NEAR, workers, limits), NEAR)


def on_frame(node: Node, worker: Worker, frame: frames.AnyFrame) -> None:
    """What comes from an actor process, and has passed its gate: messages for others, and replies."""
    match frame:
        case frames.Reply():
            worker.on_reply(frame)
        case frames.Tell():
            worker.on_tell(worker.gate.target(frame.to), frame, None)
        case frames.Ask():
            worker.on_ask(worker.gate.target(frame.to), frame, None)
        case frames.Failure():
            worker.on_failure(frame)
        case frames.PageChanged():
            worker.on_moved()
        case frames.Offer():
            worker.on_offer([worker.gate.target(frame.to)], frame)
        case frames.Publish():
            worker.on_offer(node.topics.subscribers(frame.topic), frame, frame.topic)
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
        case frames.Migrate():
            worker.on_migrate(frame)
        case frames.Forget():
            worker.on_forget(frame)
        case frames.Launch() | frames.TellRun():
            raise AssertionError(f"{type(frame).__name__} has no way in")


def _command(node: Node, worker: Worker, frame: frames.Command) -> None:
    """What an actor process wants done to an address, or tells of its own."""
    path = worker.connection.names.from_wire(frame.to)
    own = worker.cell if path == worker.home else None  # Perhaps nobody else finds it: it may not be the one yet.
    cell = node.cell_at(path) if own is None else own
    match frame.verb:
        case "subscribe":
            node.topics.subscribe(frame.data["topic"], cell)
        case "unsubscribe":
            node.topics.unsubscribe(frame.data["topic"], cell)
        case "born":
            data = frame.data
            bound, last = data.get("bindings", {}), unpack_exit(data["last"]) if "last" in data else KILLED
            worker.inner.born(cell, data["path"], data["kind"], data["life"], bound, last)
        case "gone":
            reason, with_parent = unpack_exit(frame.data.get("reason")), bool(frame.data.get("with_parent"))
            worker.inner.gone(frame.data["path"], reason, with_parent=with_parent)
        case "waits":
            node.supervised.waiting.add(cell)
        case "undone":
            worker.inner.undone(frame.data["path"])
        case "name":
            said, name = frame.data, GivenName(frame.data["name"], frame.data["scope"])
            problem = _problem(lambda: worker.inner.named(cell, said["path"], said["kind"], name))
            worker.accepted(said["answer"], problem)
        case "keep":
            keep(worker, frame)
        case "readdressed":
            pass  # Its gate has heard it.
        case _:
            obey(node, cell, path, frame)


def keep(worker: Worker, frame: frames.Command) -> None:
    """What the supervisors in an actor process say to the keeper, of addresses below their process's own.

    Who waits for an answer gets the error; of any other the process has gone on already, and it is told as an event.

    Raises:
        BadFrame: there is nothing like it to be done.
    """
    node, data = worker.node, frame.data
    path, keeper = data["path"], node.ports.keeper

    goes_on: asyncio.Future[None] | None = None

    def tell() -> None:
        nonlocal goes_on
        match data["what"]:
            case "erase":
                goes_on = keeper.erase(path, below=bool(data.get("below")))
            case "roll_back":
                keeper.roll_back(path, str(data.get("why", "")))
            case "blame":
                keeper.blame(path)
            case "returned":
                keeper.returned(path)
            case "dismissed":
                keeper.dismissed(path, below=bool(data.get("below")), for_good=bool(data.get("for_good")))
            case "began":
                keeper.began(path, [str(name) for name in data.get("listed", ())])
            case "note":
                above, _, name = path.rpartition("/")
                keeper.note(child_key(above, name), data.get("value"))
            case what:
                raise BadFrame(f"an actor process cannot have {what!r} done")

    def over(problem: HoldfastError | None) -> None:
        if (answer := data.get("answer")) is not None:
            worker.accepted(answer, problem)
        elif problem is not None:
            node.emit(StoreRefused(path, str(problem)))

    def ended(done: asyncio.Future[None]) -> None:
        if not done.cancelled():
            over(_problem(done.result))

    problem = _problem(tell)
    if goes_on is None:
        over(problem)
    else:
        goes_on.add_done_callback(ended)


def _problem(work: Callable[[], None]) -> HoldfastError | None:
    """Do what an actor process wants done; why it cannot be. The process goes on: it was not its fault.

    Raises:
        BadFrame: it was.
    """
    try:
        work()
    except BadFrame:
        raise
    except HoldfastError as error:
        return error
    return None
