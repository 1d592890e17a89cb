"""A running system as a script sees it from another process: the same calls, sent over the control endpoint."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import socket
import threading
import uuid
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import msgspec

from ..actors.control.orders import Change as StateChange
from ..actors.control.orders import Status
from ..actors.control.tracing import Statistics
from ..actors.errors import HoldfastError, SpecError
from ..actors.kernel.actor import Actor, Start
from ..actors.process.wire.frame_buffer import LENGTH
from ..actors.seconds import check_seconds
from ..actors.values import decode_value, describe_value
from ..cluster.lines.lines import PeerLook
from ..ftm.group.protected import ProtectionStatus
from ..supervision.spec import NAMELESS, ChildSpec, Isolation, Strategy, child
from ..system.history.evidence import PutAside
from ..system.history.lives import PastLife
from ..system.history.pages import MOST_ON_PAGE, HistoryPage, question
from ..system.last_lines.line_page import LogPage, log_question
from ..system.transaction.operation import Step, described_steps
from .overview import LOOK, SystemLook
from .wire import (
    RESPONSE,
    About,
    AnyRequest,
    AskConnections,
    AskDiagnosis,
    AskHistory,
    AskLives,
    AskLogs,
    AskQuarantined,
    AskWhy,
    ControlActor,
    CountTurns,
    DeclareTree,
    DropKept,
    FollowActor,
    InspectActor,
    NextEvents,
    OrderRepair,
    Overview,
    RepairVerb,
    RestartActor,
    SendMessage,
    SettleQuarantined,
    Transact,
    Tree,
    Whereis,
    body_size,
    check_user,
    frame,
    open_arg,
    outcome,
    pack_arg,
    peer_of,
)

ABOUT_TIMEOUT = 5.0
"""Seconds that a system has to say which it is."""
CONNECT_TIMEOUT = 4.0
"""Seconds that the kernel has to connect: more only if many others wait there for a system that does not answer."""
GRACE = 35.0
"""Seconds beyond its own time limit that a request is waited for: it may have to be undone."""


SHORT_GRACE = 5.0
"""The same of one that changes nothing."""
CHANGES = (ControlActor, DeclareTree, DropKept, RestartActor, SettleQuarantined, Transact)


class NotReached(
    HoldfastError, text="no system answers at {path}: {why}; is it running, with a control endpoint there?"
):
    """No running system answers at this socket."""

    path: str
    why: str


class NotAnswering(
    HoldfastError,
    text="the system at {path} (process {pid}) is there and does not answer within {seconds:g} s: {state}",
):
    """A running system is at this socket, and says nothing: it is stopped, or something occupies its event loop."""

    path: str
    pid: int
    seconds: float
    state: str


class RemoteRef:
    """An address of the running system."""

    __slots__ = ("path",)

    def __init__(self, path: str) -> None:
        self.path = path

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RemoteRef) and other.path == self.path

    def __hash__(self) -> int:
        return hash(self.path)

    def __repr__(self) -> str:
        return f"<RemoteRef {self.path}>"


RemoteTarget = RemoteRef | str


class Client:
    """One connection; a request, then its answer. It blocks: `RemoteSystem` waits for it in a thread.

    Attributes:
        pid: of the process that listens there; 0 if it cannot be seen from here.

    Raises:
        NotReached: nobody listens there. WrongUser: somebody else does.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._lock = threading.Lock()
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            self._sock.settimeout(CONNECT_TIMEOUT)
            self._sock.connect(self.path)
            peer = peer_of(self._sock)
            check_user(peer.uid, os.geteuid())
            self.pid = peer.pid
        except OSError as error:
            self._sock.close()
            raise NotReached(self.path, error.strerror or str(error)) from error
        except BaseException:
            self._sock.close()
            raise

    def call(self, request: AnyRequest, timeout: float, read: Callable[[bytes], Any] = decode_value) -> Any:
        """Ask, and wait at most `timeout` seconds (and some for an undo) for the answer, which `read` makes of bytes.

        Raises:
            HoldfastError: what the system answers. NotReached: it does not.
        """
        with self._lock:
            try:
                self._sock.settimeout(timeout + (GRACE if isinstance(request, CHANGES) else SHORT_GRACE))
                self._sock.sendall(frame(request))
                body = self._read(body_size(self._read(LENGTH.size)))
            except OSError as error:
                raise NotReached(self.path, error.strerror or str(error)) from error
        return outcome(RESPONSE.decode(body), read)

    def greet(self, seconds: float) -> None:
        """Find out whether anybody answers, before something is asked that may take its time.

        Raises:
            NotAnswering: the process is there, and says nothing within so many seconds.
            NotReached: it has closed the connection.
        """
        with self._lock:
            try:
                self._sock.settimeout(seconds)
                self._sock.sendall(frame(About()))
                self._read(body_size(self._read(LENGTH.size)))
            except TimeoutError as error:
                raise NotAnswering(self.path, self.pid, seconds, _state_of(self.pid)) from error
            except OSError as error:
                raise NotReached(self.path, error.strerror or str(error)) from error

    def _read(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            part = self._sock.recv(size - len(data))
            if not part:
                raise OSError(0, "it has closed the connection")
            data += part
        return bytes(data)

    def close(self) -> None:
        """End the connection; what is asked for and not done yet is undone."""
        try:
            self._sock.shutdown(socket.SHUT_RDWR)  # Wakes the thread that waits.
        except OSError:
            pass  # It was closed by the other side.
        self._sock.close()


def _state_of(pid: int) -> str:
    """Why a process says nothing, as far as the kernel knows, and what to do."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):  # Another system than Linux, or it has ended just now.
        state = ""
    if state in ("T", "t"):
        return f"it is stopped; kill -CONT {pid} lets it go on"
    return "something occupies its event loop, or the machine; wait, or end the process"


class RemoteSystem:
    """The running system at a control endpoint.

    Args:
        path: the socket.
        dry_run: every transaction is one; orders to actors are refused.
        timeout: seconds that a transaction may take if it does not say itself.
        script: the file whose code may be needed there (path and sha256).
        told: called with each transaction when it is over.

    Raises:
        NotReached, WrongUser: as `Client`.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        dry_run: bool = False,
        timeout: float = 10.0,
        script: tuple[str, str] | None = None,
        told: Callable[[RemoteChange], None] | None = None,
    ) -> None:
        self._client = Client(path)
        self._dry_run, self._timeout, self._script = dry_run, timeout, script
        self._told = told
        self._is_in_body = False

    def __enter__(self) -> RemoteSystem:
        return self

    def __exit__(self, *exc: object) -> None:
        self._client.close()

    def close(self) -> None:
        """End the connection; what is asked for and not done yet is undone."""
        self._client.close()

    def greet(self, seconds: float) -> None:
        """Find out whether the system answers at all. Raises NotAnswering, NotReached."""
        self._client.greet(seconds)

    # -- looking at it ------------------------------------------------------------------------------------------------

    def about(self) -> dict[str, Any]:
        """Which system it is: name, pid, since when it is served (seconds of the clock), and how many actors it has."""
        found: dict[str, Any] = self._client.call(About(), ABOUT_TIMEOUT)
        return found

    def look(self, *, parts: bool = False) -> SystemLook:
        """How all actors are; with `parts` those of the runtime itself too."""
        found: SystemLook = LOOK.decode(self._client.call(Overview(parts), 10.0))
        return found

    def inspect(self, target: RemoteTarget, *, timeout: float = 5.0) -> dict[str, Any]:
        """All that can be said of one actor, as plain data."""
        found: dict[str, Any] = self._client.call(InspectActor(text_of(target), timeout), timeout)
        return found

    def state(self, target: RemoteTarget, *, timeout: float = 5.0) -> Any:
        """An actor's state as plain data: no class of it is imported here."""
        from ..checkpoint.store_tools.plain_export import as_plain  # only now: it takes a while to import

        return as_plain(
            self._client.call(ControlActor("get_state", text_of(target), [], timeout), timeout, describe_value)
        )

    async def outline(self, target: RemoteTarget, *, timeout: float = 5.0) -> dict[str, str]:
        """An actor's state in short texts, one for each variable; see `ActorSystem.outline`."""
        return msgspec.convert(await self._control("outline", target, timeout), dict[str, str])

    def follow(self, target: RemoteTarget) -> None:
        """Follow what an actor does, for as long as this connection lasts: `next_events` tells."""
        self._client.call(FollowActor(text_of(target)), 10.0)

    def next_events(self, seconds: float) -> dict[str, Any]:
        """What the actor that is followed has done since the last time, waiting at most so long for something."""
        found: dict[str, Any] = self._client.call(NextEvents(seconds), seconds + 10.0)
        return found

    def count_turns(self, paths: list[str]) -> dict[str, int]:
        """Count the turns of just these actors, for as long as this connection lasts; how many there were so far."""
        found: dict[str, int] = self._client.call(CountTurns(paths), 10.0)
        return found

    def tree(self) -> list[str]:
        """The addresses that live now, parents before children."""
        found: list[str] = self._client.call(Tree(), 10.0)
        return found

    def whereis(self, name: str) -> RemoteRef:
        """The actor with this name. Raises NoSuchActor."""
        return RemoteRef(self._client.call(Whereis(name), 10.0))

    def ref(self, path: str, kind: type[Actor] | None = None) -> RemoteRef:
        """The address; whether somebody lives there is seen when it is used. (`kind` is for the call in process.)"""
        return RemoteRef(path)

    async def get_status(self, target: RemoteTarget, *, timeout: float = 5.0) -> Status:
        """Get the status of an actor, also while a turn of it waits."""
        status: Status = await self._control("get_status", target, timeout)
        return status

    async def protection(self, target: RemoteTarget, *, timeout: float = 5.0) -> ProtectionStatus:
        """Whether an actor is protected by mechanisms, by which, who leads, and whether a replica may die."""
        found: ProtectionStatus = await self._control("protection", target, timeout)
        return found

    async def get_state(self, target: RemoteTarget, *, timeout: float = 5.0) -> Any:
        """A copy of an actor's state."""
        return await self._control("get_state", target, timeout)

    async def statistics(
        self, target: RemoteTarget, on: bool | None = None, *, timeout: float = 5.0
    ) -> Statistics | None:
        """What an actor has done since its statistics were switched on; None while they are off."""
        args = [] if on is None else [int(on)]
        counts: Statistics | None = await self._control("statistics", target, timeout, *args, changes=on is not None)
        return counts

    # -- its past -----------------------------------------------------------------------------------------------------

    def history(
        self,
        target: RemoteTarget = "**",
        *,
        kinds: Sequence[str] = (),
        since: float = 0.0,
        until: float = float("inf"),
        after: int | None = None,
        limit: int = MOST_ON_PAGE,
    ) -> HistoryPage:
        """Past events, oldest first; see `ActorSystem.history`."""
        asked = question(text_of(target), kinds=kinds, since=since, until=until, after=after, limit=limit)
        return msgspec.convert(self._client.call(AskHistory(asked), 10.0), HistoryPage)

    async def follow_history(
        self, target: RemoteTarget = "**", *, after: int, kinds: Sequence[str] = (), timeout: float = 30.0
    ) -> HistoryPage:
        """Past events behind `after`, as soon as there is one; see `ActorSystem.follow_history`."""
        check_seconds("follow_history", "timeout", timeout)
        asked = question(text_of(target), kinds=kinds, after=after)
        return msgspec.convert(await self.call(AskHistory(asked, timeout), timeout), HistoryPage)

    def logs(
        self,
        target: RemoteTarget = "**",
        *,
        level: str = "debug",
        since: float = 0.0,
        after: int | None = None,
        limit: int = MOST_ON_PAGE,
    ) -> LogPage:
        """The last lines, oldest first; see `ActorSystem.logs`."""
        asked = log_question(text_of(target), level=level, since=since, after=after, limit=limit)
        return msgspec.convert(self._client.call(AskLogs(asked), 10.0), LogPage)

    async def follow_logs(
        self,
        target: RemoteTarget = "**",
        *,
        after: int,
        level: str = "debug",
        limit: int = MOST_ON_PAGE,
        timeout: float = 30.0,
    ) -> LogPage:
        """The lines behind `after`, as soon as there are some; see `ActorSystem.follow_logs`."""
        check_seconds("follow_logs", "timeout", timeout)
        asked = log_question(text_of(target), level=level, after=after, limit=limit)
        return msgspec.convert(await self.call(AskLogs(asked, timeout), timeout), LogPage)

    def lives(self, target: RemoteTarget) -> list[PastLife]:
        """The newest lives at an address, oldest first."""
        return msgspec.convert(self._client.call(AskLives(text_of(target)), 10.0), list[PastLife])

    async def why(self, target: RemoteTarget, *, timeout: float = 5.0) -> list[str]:
        """Why an actor restarts, has ended, or does not get on, in sentences."""
        check_seconds("why", "timeout", timeout)
        return msgspec.convert(await self.call(AskWhy(text_of(target), timeout), timeout), list[str])

    def put_aside(self, target: RemoteTarget | None = None) -> list[PutAside]:
        """The messages in quarantine, of one actor or of all, oldest first."""
        path = None if target is None else text_of(target)
        return msgspec.convert(self._client.call(AskQuarantined(path), 10.0), list[PutAside])

    def settle_put_aside(
        self, verb: Literal["retry", "drop"], target: RemoteTarget, id: int | None = None
    ) -> tuple[list[PutAside], list[str]]:
        """Have messages in quarantine handled as if they had come now, or forget them: they become dead letters.

        Args:
            verb: "retry" or "drop".
            target: whose messages.
            id: of one of them, as `put_aside` tells it; None means all of the address.

        Returns:
            those for which it was done, and for the others why not, in words.

        Raises:
            SpecError: none of them is in quarantine, or this is a dry run.
        """
        if self._dry_run:
            raise SpecError(verb, "in a dry run nothing in quarantine is changed")
        answer = self._client.call(SettleQuarantined(verb, text_of(target), id), 10.0)
        return msgspec.convert(answer["done"], list[PutAside]), msgspec.convert(answer["failed"], list[str])

    def connected(self) -> list[PeerLook]:
        """The programs that are connected to the system, and systems that were, with what is kept for each."""
        return msgspec.convert(self._client.call(AskConnections(), 10.0), list[PeerLook])

    def drop_kept(self, system: str) -> int:
        """Drop what recorded actors have told another system that has not accepted it; return how many that were.

        Raises:
            SpecError: no system of that name was ever connected, or this is a dry run.
        """
        if self._dry_run:
            raise SpecError("drop", "in a dry run nothing that is kept is dropped")
        return msgspec.convert(self._client.call(DropKept(system), 10.0), int)

    async def diagnosis(self, target: RemoteTarget | None = None, *, timeout: float = 5.0) -> list[dict[str, Any]]:
        """What each diagnosis that runs says now, as plain data; with a target of the suspects there and below it.

        Raises:
            NotDiagnosed: none runs, or none has a component there.
        """
        check_seconds("diagnosis", "timeout", timeout)
        path = None if target is None else text_of(target)
        found: list[dict[str, Any]] = await self.call(AskDiagnosis(path, timeout), timeout)
        return found

    async def order_repair(
        self, verb: RepairVerb, words: tuple[str, ...] = (), *, timeout: float = 5.0
    ) -> list[dict[str, Any]]:
        """Give an order to repair, and ask how it stands then: one answer for each repairer, as plain data.

        Args:
            verb: "status", or "approve" or "deny" with a case (and why), "retry" with components, "set" with a stance.
            words: what belongs to the verb.
            timeout: seconds in which each repairer has to answer.

        Raises:
            NotDiagnosed: no repair runs. NobodyWaits: no plan of this case waits. SpecError: this is a dry run.
        """
        check_seconds("repair", "timeout", timeout)
        if self._dry_run and verb != "status":
            raise SpecError("repair", "in a dry run repair is given no orders")
        found: list[dict[str, Any]] = await self.call(OrderRepair(verb, words, timeout), timeout)
        return found

    # -- orders to one actor ------------------------------------------------------------------------------------------

    async def suspend(self, target: RemoteTarget, *, timeout: float = 5.0) -> None:
        """Have an actor handle no message until `resume`."""
        await self._control("suspend", target, timeout, changes=True)

    async def resume(self, target: RemoteTarget, *, timeout: float = 5.0) -> None:
        """Have it handle messages again."""
        await self._control("resume", target, timeout, changes=True)

    async def replace_state(self, target: RemoteTarget, change: StateChange, *, timeout: float = 5.0) -> Any:
        """Put `change(state)` in the place of an actor's state; a function of the script, or of another module."""
        return await self._control("replace_state", target, timeout, change, changes=True)

    async def replace_code(
        self,
        target: RemoteTarget,
        new: type[Actor] | Start[Any],
        change: StateChange | None = None,
        *,
        timeout: float = 5.0,
    ) -> None:
        """Have a suspended actor go on as another class."""
        await self._control("replace_code", target, timeout, new, change, changes=True)

    async def checkpoint(self, target: RemoteTarget, *, timeout: float = 5.0) -> None:
        """Have a recorded actor's state saved."""
        await self._control("checkpoint", target, timeout, changes=True)

    async def restart(self, target: RemoteTarget, *, timeout: float = 5.0, at_once: bool = False) -> str:
        """End a life in good order, so that the supervisor begins the next one. Returns how it ended, in words.

        With `at_once` it is killed, also in the middle of a turn that hangs.
        """
        ended: str = await self.call(RestartActor(text_of(target), timeout, at_once), timeout)
        return ended

    async def send_message(
        self, path: str, message: str, fields: str, *, asks: bool, timeout: float = 5.0
    ) -> dict[str, Any]:
        """Send a message of a class that the actor handles, with its fields as JSON.

        Returns the reply as plain data (`reply`), or as Python writes it (`text`); nothing of either if none is wanted.
        """
        said: dict[str, Any] = await self.call(SendMessage(path, message, fields, asks, timeout), timeout)
        return said

    async def terminate(self, target: RemoteTarget, *, timeout: float = 5.0) -> str:
        """End a life in good order; its supervisor then does as its spec says. Returns its exit reason in words."""
        reason: str = await self._control("terminate", target, timeout, changes=True)
        return reason

    async def _control(self, verb: Any, target: RemoteTarget, timeout: float, *args: Any, changes: bool = False) -> Any:
        if changes and self._dry_run:
            raise SpecError(verb, "in a dry run no order is given to an actor: put it into a transaction")
        check_seconds(text_of(target), "timeout", timeout)
        packed = [pack_arg(arg, verb) for arg in args]
        return await self.call(ControlActor(verb, text_of(target), packed, timeout, self._script), timeout)

    # -- transactions -------------------------------------------------------------------------------------------------

    def transaction(self, *, dry_run: bool = False, timeout: float | None = None) -> RemoteTransaction:
        """As `ActorSystem.transaction`: what the body collects is sent when it ends, and carried out there as one."""
        return RemoteTransaction(self, dry_run or self._dry_run, self._timeout if timeout is None else timeout)

    async def transact(self, change: RemoteChange, *, dry_run: bool, timeout: float) -> None:
        """Have the collected operations carried out."""
        check_seconds("transaction", "timeout", timeout)
        request = Transact(change.operations, dry_run, timeout, self._script)
        answer = await self.call(request, timeout)
        change._take(answer)
        if self._told is not None:
            self._told(change)

    async def declare(self, text: str, name: str, *, dry_run: bool = False, timeout: float = 60.0) -> RemoteChange:
        """Have the tree be as a file says, by one transaction; `name` is what the file is called in errors."""
        change = RemoteChange()
        change._take(await self.call(DeclareTree(text, name, dry_run, timeout), timeout))
        return change

    async def call(self, request: AnyRequest, timeout: float) -> Any:
        """Ask in a thread; if the wait is cancelled the connection ends, and what was asked for is undone."""
        work = asyncio.get_running_loop().run_in_executor(None, self._client.call, request, timeout)
        try:
            return await asyncio.shield(work)
        except asyncio.CancelledError:
            self._client.close()
            await asyncio.wait((work,))
            work.exception()
            raise


class RemoteTransaction:
    """`async with system.transaction() as change:` from another process."""

    def __init__(self, system: RemoteSystem, dry_run: bool, timeout: float) -> None:
        self._system, self._dry_run, self._timeout = system, dry_run, timeout
        self._change = RemoteChange()

    async def __aenter__(self) -> RemoteChange:
        if self._system._is_in_body:
            raise SpecError("transaction", "there is one already: collect all steps in it")
        self._system._is_in_body = True
        return self._change

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._system._is_in_body = False
        if error is None:
            await self._system.transact(self._change, dry_run=self._dry_run, timeout=self._timeout)


class RemoteChange:
    """Collects operations, as `Change` does; see there."""

    def __init__(self) -> None:
        self._operations: list[tuple[str, list[Any]]] = []
        self._steps: tuple[Step, ...] | None = None
        self._difference: tuple[str, ...] = ()
        self._lost: tuple[str, ...] = ()

    def add(self, supervisor: RemoteTarget, spec: ChildSpec | Start[Any]) -> str:
        """Start one more child; returns its address."""
        made = child(None, spec) if isinstance(spec, Start) else spec
        if not isinstance(made, ChildSpec):
            raise SpecError("add", f"takes child(...), start(...) or supervisor(...), not {spec!r}")
        if made.id == NAMELESS:
            made = dataclasses.replace(made, id=f"{made.start.kind.__name__.lower()}-{uuid.uuid4().hex[:8]}")
        self._put("add", supervisor, made)
        return f"{text_of(supervisor)}/{made.id}"

    def remove(self, target: RemoteTarget) -> None:
        """Stop an actor for good."""
        self._put("remove", target)

    def move(self, target: RemoteTarget, to_supervisor: RemoteTarget) -> None:
        """Put a child under another supervisor."""
        self._put("move", target, text_of(to_supervisor))

    def reorder(self, supervisor: RemoteTarget, ids: Iterable[str]) -> None:
        """Give children another start order."""
        self._put("reorder", supervisor, list(ids))

    def strategy(self, supervisor: RemoteTarget, strategy: Strategy) -> None:
        """Have a supervisor restart its children by another strategy."""
        self._put("strategy", supervisor, strategy)

    def intensity(self, supervisor: RemoteTarget, intensity: int, period: float) -> None:
        """Allow this many restarts within `period` seconds."""
        self._put("intensity", supervisor, intensity, period)

    def isolation(self, target: RemoteTarget, isolation: Isolation) -> None:
        """Have an actor live in a process of its own, or as a task."""
        self._put("isolation", target, isolation)

    def respecify(self, target: RemoteTarget, **options: Any) -> None:
        """Have a child restarted and stopped by other options from now on: those that `Change.respecify` takes."""
        self._put("respecify", target, options)

    def bind(self, owner: RemoteTarget, port: str, target: RemoteTarget) -> None:
        """Have a binding lead to another actor."""
        self._put("bind", owner, port, text_of(target))

    def register(self, name: str, target: RemoteTarget) -> None:
        """Give an actor a name."""
        self._put("register", name, text_of(target))

    def unregister(self, name: str) -> None:
        """Free a name that an actor has beside its address."""
        self._put("unregister", name)

    def suspend(self, target: RemoteTarget) -> None:
        """Have an actor handle no message until it is resumed."""
        self._put("suspend", target)

    def resume(self, target: RemoteTarget) -> None:
        """Have it handle messages again."""
        self._put("resume", target)

    def replace_state(self, target: RemoteTarget, change: StateChange) -> None:
        """Put `change(state)` in the place of an actor's state."""
        self._put("replace_state", target, change)

    def replace_code(
        self, target: RemoteTarget, new: type[Actor] | Start[Any], change: StateChange | None = None
    ) -> None:
        """Go on as another class."""
        self._put("replace_code", target, new, change)

    def stop(self, target: RemoteTarget) -> None:
        """Stop a child, and keep its spec."""
        self._put("stop", target)

    def start(self, supervisor: RemoteTarget, name: str) -> str:
        """Start a child again that was stopped; returns its address."""
        self._put("start", supervisor, name)
        return f"{text_of(supervisor)}/{name}"

    def unbind(self, owner: RemoteTarget, port: str) -> None:
        """Have a binding lead to nobody."""
        self._put("unbind", owner, port)

    def protect(self, target: RemoteTarget, stack: Any) -> None:
        """Have an actor protected by just this stack; None: by none. A file is one of the running system's."""
        self._put("protect", target, None if stack is None else in_full(stack))

    def update(self, target: RemoteTarget, brick: str, new: Any, *, mechanism: str = "", role: str = "") -> None:
        """Give one brick new code."""
        self._put("update", target, brick, in_full(new), mechanism, role)

    @property
    def operations(self) -> list[tuple[str, list[Any]]]:
        """What was collected so far, as a `Transact` takes it."""
        return self._operations

    def _put(self, verb: str, target: RemoteTarget, *args: Any) -> None:
        packed = [pack_arg(arg, f"{verb} {text_of(target)}") for arg in (text_of(target), *args)]
        self._operations.append((verb, packed))

    def _take(self, answer: dict[str, Any]) -> None:
        self._steps = tuple(Step(*step) for step in answer["steps"])
        self._difference = tuple(answer["difference"])
        self._lost = tuple(answer["lost"])

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps, in order; in full when the system has answered."""
        if self._steps is not None:
            return self._steps
        named = [(verb, open_arg(args[0])) for verb, args in self._operations]
        return tuple(Step(n, verb, target, f"{verb} {target}") for n, (verb, target) in enumerate(named, 1))

    @property
    def difference(self) -> tuple[str, ...]:
        """How the tree changes, line by line."""
        return self._difference

    @property
    def lost(self) -> tuple[str, ...]:
        """What of recorded states is left behind, in sentences."""
        return self._lost

    def describe(self) -> str:
        """The steps, and how the tree changes, in words."""
        return "\n".join([*described_steps(self.steps), *self._difference])


def text_of(target: RemoteTarget) -> str:
    """The address of a target, which may be a ref or text."""
    return target.path if isinstance(target, RemoteRef) else target


def in_full(code: Any) -> Any:
    """Files by their whole path: the running system has another working directory."""
    if isinstance(code, (tuple, list)):
        return tuple(map(in_full, code))
    text = os.fspath(code) if isinstance(code, os.PathLike) else code
    if not isinstance(text, str):
        return text
    file, colon, name = text.partition(":")
    return f"{Path(file).resolve()}{colon}{name}" if file.endswith(".py") else text
