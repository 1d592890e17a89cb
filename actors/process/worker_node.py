"""The guest: what runs inside an actor's OS process. A node with one actor (or one subtree), joined to the root."""

from __future__ import annotations

import asyncio
import mmap
import os
import socket
import sys
import weakref
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import msgspec

from .. import exit_reasons
from ..control.orders_lane import obey_order
from ..deadline_thread import Overdue
from ..errors import ONLY_MESSAGES, HoldfastError, NotGranted, StartFailed, StartIgnored
from ..events import ActorStarted, Event, event_data
from ..exit_reasons import ExitReason, pack_exit
from ..fast_loop import new_event_loop
from ..kernel import lifecycle, links
from ..kernel.actor import Start
from ..kernel.address_host import AddressHost
from ..kernel.cell import ORDERS, RUNNING, Cell, GivenName
from ..kernel.envelope import AnyTable, Envelope
from ..kernel.lifecycle import HERE, MAILBOX
from ..kernel.message import Message, RuntimeOrder, message_name
from ..kernel.node import TOKENS, Node, Ports
from ..kernel.ref import current
from ..kernel.topics import Topics
from ..migration.worker_moves import Attempt, GuestMoves, Replaced, hand_on_stash
from ..persistence import Keeper
from .effect_processes import EffectProcess, EffectProcesses, FunctionProcess
from .wire import frames
from .wire.connection import Connection
from .wire.frames import BadFrame
from .wire.peer import Arrived, OutsideHost, Peer, RelayedAsk, named, obey
from .wire.start_codec import unpack_recipe
from .wire.worker_gate import is_at_or_below, is_granted

ENDED_WITHIN = 1.0
"""Seconds that an ended process waits for the root to read why it has ended."""

_BODIES = msgspec.msgpack.Decoder(list[frames.Raw])


class Composition(Protocol):
    """What the composition root alone knows, for one actor process."""

    recovery: Any
    """The recovery method's side in this process."""

    @property
    def keeper(self) -> Keeper:
        """The root's keeper, as the supervisors of this process speak to it."""
        ...

    def launch(self, cell: Cell, frame: frames.Launch) -> asyncio.Future[None] | None:
        """Begin the life that the root asks for."""
        ...

    def host_for(self, spec: Any) -> AddressHost:
        """How a child below this process's supervisor is lived."""
        ...

    def complete(self, spec: Any, path: str) -> Any:
        """A child spec with what else is known of it."""
        ...

    def respec(self, cell: Cell, start: Start[Any]) -> None:
        """Have an actor's next lives begin with this."""
        ...

    def child_attempt(self, path: str, number: int) -> Attempt:
        """An attempt to move a live child of this process's supervisor."""
        ...


Compose = Callable[["Guest"], Composition]


def main(sock: socket.socket, page_fd: int, compose: Compose) -> int:
    """Serve the root until its socket ends. Returns the exit code."""
    page = memoryview(mmap.mmap(page_fd, 0)).cast("Q")
    os.close(page_fd)
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        return runner.run(_serve(sock, page, compose))


async def _serve(sock: socket.socket, page: memoryview, compose: Compose) -> int:
    loop = asyncio.get_running_loop()
    guest = Guest(loop, page, compose, Overdue(loop))
    guest.join(Connection(guest.on_frame, guest.on_lost, guest.on_batch))
    guest.connection.takers = guest.takers
    await guest.connection.open(sock)
    code = await guest.ended
    # Handlers may hold threads or swallow cancellation: the process ends here, not when they are ready.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


class GuestParent(lifecycle.NearParent):
    """Above the actors of the process: the root knows their addresses, so that they can be reached."""

    def __init__(self, guest: Guest) -> None:
        self._guest = guest

    def undone(self, cell: Cell) -> None:
        self._guest.tell_undone(cell)

    def retired(self, cell: Cell) -> None:
        self._guest.address_retired(cell)


class GuestTopics(Topics):
    """Topics in an actor process: the root knows all subscribers, so it is told of ours."""

    def __init__(self, guest: Guest) -> None:
        super().__init__()
        self._guest = guest

    def subscribe(self, topic: str, cell: Cell) -> None:
        super().subscribe(topic, cell)
        self._guest.command(cell, "subscribe", {"topic": topic})

    def unsubscribe(self, topic: str, cell: Cell) -> None:
        super().unsubscribe(topic, cell)
        self._guest.command(cell, "unsubscribe", {"topic": topic})


class OutsideTable(AnyTable):
    """The table of an actor that is not in this process: whether an order may be given there is looked at each time."""

    def __contains__(self, kind: object) -> bool:
        return self.knows(kind) and not issubclass(kind, RuntimeOrder)  # type: ignore[arg-type]  # a message's type

    def knows(self, kind: type) -> bool:
        return issubclass(kind, Message)


OUTSIDE = OutsideTable()


class NudgingPage:
    """The page of an actor with a bounded mailbox: the home is told, once per loop tick, when it has changed."""

    __slots__ = ("_guest", "_is_told", "_page")

    def __init__(self, guest: Guest, page: memoryview) -> None:
        self._guest, self._page = guest, page
        self._is_told = False

    def __setitem__(self, index: int, number: int) -> None:
        self._page[index] = number
        if not self._is_told:
            self._is_told = True
            self._guest.node.loop.call_soon(self._tell)

    def _tell(self) -> None:
        self._is_told = False
        self._guest.connection.send(frames.PageChanged())


class Guest(Peer):
    """The child's end of the connection, and its node."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        page: memoryview,
        compose: Compose,
        overdue: Overdue | None,
        effect_process: Callable[[], FunctionProcess] = EffectProcess,
    ) -> None:
        super().__init__(Node("guest", loop, topics=GuestTopics(self)))
        self.page: Any = page
        self.ended: asyncio.Future[int] = loop.create_future()
        self._composition = composition = compose(self)
        self.recovery = composition.recovery
        self.moves = GuestMoves(self, composition.child_attempt)
        self._starting: tuple[int, asyncio.Future[None]] | None = None  # the launch whose `on_start` is awaited
        self._targets: dict[int, Cell] = {}
        self._outside: dict[str, Cell] = {}
        self._left: set[str] = set()  # addresses below ours whose actors live elsewhere now: the root knows where
        self._host = OutsideHost(self)
        self.parent = GuestParent(self)
        self.node.connect(
            Ports(
                here=AddressHost(MAILBOX, HERE, self.parent),
                host_for=composition.host_for,
                complete=composition.complete,
                respec=composition.respec,
                outside=self.outside,
                keeper=composition.keeper,
                uplink=self,
                overdue=overdue,
                run_in_process=EffectProcesses(
                    self.node.codec, effect_process
                ).run,  # They are killed when this process ends.
            )
        )
        self.node.events.add_sink(self._on_event)
        self.takers: dict[type[frames.Frame], Callable[[Any], None]] = {
            frames.Tell: self._tell,
            frames.TellRun: self._run,
            frames.Ask: self._ask,
            frames.Offer: lambda frame: self.on_offer([self._target(frame.to)], frame),
            frames.Reply: self.on_reply,
            frames.Failure: self.on_failure,
            frames.Launch: self._launch,
            frames.Command: self._command,
            frames.Record: self.on_record,
            frames.Migrate: lambda frame: self.moves.hear(self.connection.names.from_wire(frame.to), frame),
            frames.Forget: self.on_forget,
        }

    # -- the world outside ------------------------------------------------------------------------------------------

    def outside(self, path: str) -> Cell | None:
        """The stand-in for an address that is not in this process; None for one that would be."""
        root = self.node.root
        if root is not None and is_at_or_below(path, root.path) and path not in self._left:
            return None
        cell = self._outside.get(path)
        if cell is None:
            cell = self._outside[path] = self._stand_in(path)
        return cell

    def _stand_in(self, path: str) -> Cell:
        """A way to whoever lives at an address for the root."""
        cell = Cell(self.node, None, path, self._host)
        cell.state = RUNNING
        cell.admit, cell.table = self._host.home.admit, OUTSIDE
        return cell

    def require_granted(self, path: str, order: str) -> None:
        """See whether an actor here may give this order; the root would end the process for one that may not.

        Raises:
            NotGranted: it may not.
        """
        root = self.node.root
        if root is None or is_at_or_below(path, root.path):
            return
        sender = current.get(None)
        by = root.path if sender is None else sender.path
        if order in ORDERS and not is_at_or_below(path, "/" + root.path.split("/")[1]):
            raise NotGranted(path, order, by, ONLY_MESSAGES)
        if not is_granted(path, root, every_cell(root)):
            raise NotGranted(path, order, by)

    def publish(self, topic: str, item: Envelope) -> asyncio.Future[None]:
        """Publish through the root; the future ends when every subscriber has accepted."""
        connection = self.connection
        self.require_whole(topic, item.message)
        name, body = self._payload(item.message)
        source = None if item.sender is None else connection.names.to_wire(item.sender.path)
        key, accepted = self.acceptance()
        connection.send(frames.Publish(key, topic, name, body, source, item.chain), topic)
        return accepted

    def command(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """Tell the root something about an address."""
        self.connection.send(frames.Command(self.connection.names.to_wire(cell.path), verb, data))

    def claim_name(self, cell: Cell, name: GivenName) -> asyncio.Future[None]:
        """Have the root give a name to the life of a child that is about to begin here.

        The future fails with StartFailed if another actor has it.
        """
        root, start = self.node.root, cell.extra().start
        assert root is not None
        assert start is not None
        cell.table = start.kind._table  # Who finds it by its name may send at once, before there is a life.
        key, claimed = self.acceptance()
        claimed.add_done_callback(lambda done: done.exception())  # Whoever has asked may have ended meanwhile.
        child = {"path": cell.path, "kind": message_name(start.kind)}
        self.command(root, "name", {**child, "name": name.text, "scope": name.scope, "answer": key})
        return claimed

    def tell_undone(self, cell: Cell) -> None:
        """The life of a child is over, and its address may have another one: the root frees what names it had."""
        root = self.node.root
        if root is not None and cell is not root and cell.spec is not None:
            self.command(root, "undone", {"path": cell.path})

    def address_retired(self, cell: Cell) -> None:
        """An address of this process is free. The process's own is kept at the root, and the process ends with it."""
        if cell is not self.node.root:
            self.tell_gone(cell)
            return
        if cell.queue:
            cell.queue.clear()  # Its home has these, and sends them to the next life.
        self.report_end(cell, cell.more.reason if cell.more is not None else None)

    def tell_gone(self, cell: Cell) -> None:
        """An address of this process is free."""
        root = self.node.root
        reason = cell.more.reason if cell.more is not None else exit_reasons.SHUTDOWN
        with_parent = lifecycle.parent_ended(cell)
        if root is not None:
            data = {"path": cell.path, "reason": pack_exit(reason), "with_parent": with_parent}
            self.command(root, "gone", data)

    def _tell_born(self, path: str) -> None:
        """A life has begun at an address below ours."""
        root, cell = self.node.root, self.node.find(path)
        if root is None or cell is None:
            return
        start = cell.extra().start
        kind = type(cell.actor) if cell.actor is not None else None if start is None else start.kind
        if kind is not None:
            bound = {port: target.path for port, target in cell.extra().bindings.items()}
            last = pack_exit(cell.extra().reason)  # how the life before it ended, if there was one
            born = {"path": path, "kind": message_name(kind), "life": cell.life, "bindings": bound, "last": last}
            self.command(root, "born", born)

    def _on_event(self, event: Event) -> None:
        if type(event) is ActorStarted:
            if self.node.root is not None and event.address == self.node.root.path:
                return  # The root tells of this one when it is up.
            self._tell_born(event.address)
        self.connection.send(frames.Note(type(event).__name__, event_data(event)))

    def on_forget(self, frame: frames.Forget) -> None:
        """The root gives all its names anew: a good time to forget who was written to and is known to nobody here."""
        super().on_forget(frame)
        self._targets.clear()
        still = weakref.WeakValueDictionary(self._outside)
        self._outside.clear()
        self._outside.update(still)

    # -- frames from the root ---------------------------------------------------------------------------------------

    def on_frame(self, frame: frames.AnyFrame) -> None:
        """A frame that nobody here takes."""
        raise BadFrame(f"the root sent a {type(frame).__name__}")

    def on_batch(self) -> None:
        """All frames that have come are taken in: run the turns, and answer, in the same tick."""
        self.node.run_now()
        self.connection.flush()

    def _tell(self, frame: frames.Tell) -> None:
        """The hot path in: a plain message to our own actor, of a type it has had before."""
        route = self.routes.get((frame.to, frame.name))
        if route is not None and frame.sender is None and not frame.chain:
            cell, decode, _ = route
            try:
                message = decode(frame.body)
            except Exception:
                route = None  # Said below, with all names.
            else:
                cell.admit(cell, Arrived(message, None, frame.number, self.page))
                return
        self.on_tell(self._target(frame.to), frame, self.page if frame.number else None)

    def _run(self, frame: frames.TellRun) -> None:
        """Many such messages: decoded in one call."""
        route = self.routes.get((frame.to, frame.name))
        number, page = frame.first, self.page
        if route is not None:
            cell, _, decode = route
            try:
                messages = decode(frame.bodies)
            except Exception:
                route = None  # One of them: said below, with all names.
            else:
                admit = cell.admit
                for message in messages:
                    admit(cell, Arrived(message, None, number, page))
                    number += 1
                return
        for body in _BODIES.decode(frame.bodies):
            self._tell(frames.Tell(frame.to, frame.name, body, number))
            number += 1

    def _ask(self, frame: frames.Ask) -> None:
        """The same for an ask that no turn waits for."""
        route = self.routes.get((frame.to, frame.name))
        if route is not None and frame.sender is None and not frame.chain:
            cell, decode, _ = route
            try:
                message = decode(frame.body)
            except Exception:
                route = None
            else:
                ask = RelayedAsk.taken(self, frame, cell, self.page)
                ask.message = message
                cell.admit(cell, ask)
                return
        self.on_ask(self._target(frame.to), frame, self.page if frame.number else None)

    def _target(self, to: frames.Name) -> Cell:
        """The cell at an address of this process."""
        if type(to) is int and (cell := self._targets.get(to)) is not None:
            return cell
        path = self.connection.names.from_wire(to)
        cell = self.node.cell_at(path)
        if cell is self.node.root:  # Cells of a subtree come and go; ours stays.
            self._targets[self.connection.names.number_of(to)] = cell
        return cell

    def _launch(self, frame: frames.Launch) -> None:
        path, before = self.connection.names.from_wire(frame.to), int(frame.options["tokens"])
        self.node.numbers.begin_tokens(before, before + TOKENS)
        if frame.options.get("prepare"):
            self._prepare(frame)
            return
        limits = frame.options.get("limits") or {}
        if frame.options.get("bounded"):
            self.page = NudgingPage(self, self.page)
        node = self.node
        cell = node.root = Cell(node, None, path, node.ports.here)
        self._left.update(frame.options.get("left", ()))
        cell.life = frame.life - 1
        try:
            _apply(limits)
            for port, target in frame.options.get("bindings", {}).items():
                cell.extra().bindings[port] = node.cell_at(target)
            cell.extra().start = unpack_recipe(frame.recipe)
            if limits.get("beat"):
                self._beat(float(limits["beat"]))
            if frame.options.get("moved"):
                up: asyncio.Future[None] | None = self.moves.begin(cell, unpack_recipe(frame.recipe))
            else:
                up = self._composition.launch(cell, frame)
        except (
            BaseException
        ) as error:  # Limits that cannot be set, modules that cannot be imported, arguments, `__init__`.
            self._launched(frame.id, error)
            return
        if up is None:
            self._launched(frame.id, None)
        else:
            self._starting = frame.id, up
            up.add_done_callback(lambda done: self._on_up())

    def _prepare(self, frame: frames.Launch) -> None:
        """An actor may be moved here."""
        try:
            self.moves.prepare(frame.recipe)
        except BaseException as error:  # Importing a module runs it.
            self._launched(frame.id, error)
        else:
            self._launched(frame.id, None)

    def _on_up(self) -> None:
        """Tell how the start went, once; it may be over before the loop calls back."""
        if self._starting is not None and self._starting[1].done():
            (key, done), self._starting = self._starting, None
            self._launched(key, done.exception())

    def _launched(self, key: int, error: BaseException | None) -> None:
        if isinstance(error, StartFailed):
            self.connection.send(frames.Launched(key, error.reason, isinstance(error, StartIgnored)))
        else:
            self.connection.send(frames.Launched(key, "" if error is None else str(exit_reasons.crash(error))))

    def _command(self, frame: frames.Command) -> None:
        if frame.verb == "readdress":
            self.connection.names.from_wire(frame.to)  # The root uses its number from now on.
            self._readdress(str(frame.data["was"]), str(frame.data["now"]))
            return
        cell = self._target(frame.to)
        if frame.verb == "disown":
            self._disown(cell, self.connection.names.from_wire(frame.to), str(frame.data["path"]), frame.data["life"])
        elif frame.verb == "recipe":
            self.node.ports.respec(cell, unpack_recipe(frame.data["start"]))
        elif frame.verb == "replaced":
            hand_on_stash(cell, self._stand_in(cell.path))
        elif frame.verb == "bind":
            more, port = cell.extra(), str(frame.data["port"])
            more.bindings[port] = named(self.node, frame, "target")
            more.claimed = more.claimed | {port} if frame.data.get("is_claimed") else more.claimed - {port}
        elif frame.verb == "control":
            obey_order(self, cell, frame)
        else:
            obey(self.node, cell, cell.path, frame, by_root=True)

    def _readdress(self, was: str, now: str) -> None:
        """Our own actor, or one above it, has moved to another supervisor: so have all of them at or below `was`."""
        cell = self.node.root
        assert cell is not None
        old, cell.name = cell.path, now + cell.path[len(was) :]
        for path in [path for path in self._outside if is_at_or_below(path, was)]:
            other = self._outside.pop(path)
            other.name = now + path[len(was) :]
            self._outside[other.name] = other
        self._outside.pop(cell.path, None)
        self.moves.readdressed(old, cell.path)
        if self.recovery is not None:
            self.recovery.readdressed(old, cell.path)
        for one in every_cell(cell):
            one.host.place.readdress(one, was, now)
        self._has_heard(was)

    def _has_heard(self, old: str) -> None:
        """From here on the address `old` is not meant as that of the actor that has left it."""
        cell = self.node.root
        assert cell is not None
        self.connection.names.give_anew(old)
        self.command(cell, "readdressed", {})

    def _disown(self, cell: Cell, old: str, path: str, life: int) -> None:
        """A child has a supervisor elsewhere, and is lived elsewhere: its cell stands for one outside."""
        self._has_heard(old)
        self._outside[path] = self._outside[old] = cell
        self._left.add(old)
        left = None if cell.actor is None else Replaced(cell)  # A supervisor: another one takes its place.
        if cell.parent is not None:
            lifecycle.disown(cell)
        cell.name, cell.state = path, RUNNING
        cell.host, cell.admit, cell.table = self._host, self._host.home.admit, OUTSIDE
        more = cell.extra()
        more.start = more.outlet = None
        if left is not None:
            left.hand_on(self._host)
        here = self.node.find(path)
        if here is not None and here is not cell:  # Its other supervisor is in this process too.
            links.hand_over(cell, here)
        for watch in more.ties.monitors:  # The root was not told of these, for whoever watches it was told here.
            data = {"watcher": watch.watcher.path, "for_good": watch.for_good, "life": life}
            cell.host.told(cell, "monitor", data)
        if left is not None:
            for peer in more.ties.links:  # Nor of these.
                cell.host.told(cell, "link", {"peer": peer.path})

    # -- the end ----------------------------------------------------------------------------------------------------

    def report_end(self, cell: Cell, reason: ExitReason | None) -> None:
        """The process's own actor has ended: tell why, and end with it."""
        self._on_up()
        told = pack_exit(reason if reason is not None else exit_reasons.SHUTDOWN)
        sys.stdout.flush()
        sys.stderr.flush()
        self.connection.send(frames.Ended(self.connection.names.to_wire(cell.path), cell.life, told))
        self.connection.flush()
        # The root ends us when it has read this. If we closed, and it wrote to us just then, it would read no more.
        self.node.loop.call_later(ENDED_WITHIN, self.connection.close)

    def on_lost(self, error: Exception | None) -> None:
        """The root is gone, or we have closed: nothing is left to live for."""
        if isinstance(error, HoldfastError):
            print(f"holdfast: {error}", file=sys.stderr)
        if not self.ended.done():
            self.ended.set_result(0 if error is None else 70)

    def _beat(self, interval: float) -> None:
        if self.connection.is_open:
            self.connection.send(frames.Beat())
            self.node.loop.call_later(interval, self._beat, interval)


def every_cell(top: Cell) -> Iterator[Cell]:
    """An actor, and all below it."""
    yield top
    for cell in (top.children or {}).values():
        yield from every_cell(cell)


def _apply(limits: dict[str, Any]) -> None:
    """Set the limits that a process sets for itself."""
    import resource

    if limits.get("address_space_bytes"):
        most = int(limits["address_space_bytes"])
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    if limits.get("open_files"):
        most = int(limits["open_files"])
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    if limits.get("niceness"):
        os.nice(int(limits["niceness"]))
