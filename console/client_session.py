"""What one client of the control endpoint asks for, and what is held for it until it goes."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from typing import TYPE_CHECKING, Any, assert_never

import msgspec

from ..actors.errors import HoldfastError, SpecError, type_name
from ..actors.events import Event, EventStream, MessageIn, MessageOut, TurnBegan, TurnEnded
from ..actors.kernel.actor import Actor
from ..system.history.authors import ACTING, OPERATOR
from ..system.history.evidence import PutAside, put_aside
from ..system.transaction.change import Change
from .declare.tree_plan import declare
from .inspection import inspected
from .overview import look_at
from .restarting import restart_actor
from .service.named_messages import ask_by_name, tell_by_name
from .trust import Needed, trusted_imports
from .wire import (
    About,
    AnyRequest,
    AskCauses,
    AskConnections,
    AskDiagnosis,
    AskHistory,
    AskLives,
    AskLogs,
    AskQuarantined,
    AskWhy,
    BadRequest,
    ControlActor,
    CountTurns,
    DeclareTree,
    DropKept,
    FollowActor,
    InspectActor,
    NextEvents,
    NotRunningHere,
    OrderRepair,
    Overview,
    RestartActor,
    SendMessage,
    SettleQuarantined,
    Transact,
    Tree,
    Whereis,
    open_arg,
)

if TYPE_CHECKING:
    from ..system.history.pages import HistoryPage
    from ..system.last_lines.line_page import LogPage
    from ..system.system import ActorSystem

LONGEST = 3600.0
"""Seconds that one request may take."""
MOST_CAUSES = 100
"""Addresses of which one request asks what is wrong there."""
MOST_COUNTED = 1000
"""Actors whose turns are counted for one client."""
OPENED_TOGETHER = 32
"""Operations of a transaction that are opened in one step of the loop."""
LONGEST_MESSAGE = 1000
"""Characters that are shown of a message that is followed."""
_TREE = {"add", "remove", "move", "reorder", "strategy", "intensity", "isolation", "respecify", "stop", "start"}
_LIVING = {"bind", "unbind", "register", "unregister", "suspend", "resume", "replace_state", "replace_code"}
OPERATIONS = frozenset(_TREE | _LIVING | {"protect", "update"})
NAMED = {"update": ("mechanism", "role")}
"""What comes last is named."""


class ClientSession:
    """Answers the requests of one client. `close` gives back what it has switched on."""

    def __init__(self, system: ActorSystem, since: float) -> None:
        self._system, self._since = system, since
        self._followed: EventStream | None = None
        self._counted: set[str] = set()

    async def close(self) -> None:
        """The client has gone: nobody follows or counts for it any more."""
        if self._followed is not None:
            self._followed.close()
        await self._count([])

    async def carry_out(self, request: AnyRequest) -> Any:
        """Answer a request as an operator's, in a task of its own. Raises whatever goes wrong, and TimeoutError."""
        ACTING.set(OPERATOR)  # In the context of the task of this request.
        async with asyncio.timeout(LONGEST):
            return await self.answer(request)

    async def answer(self, request: AnyRequest) -> Any:
        """Carry out a request. Raises whatever goes wrong."""
        system = self._system
        if not isinstance(request, About) and (why := _why_not_here(system)):
            raise NotRunningHere(os.getpid(), system.name, why)
        match request:
            case About():
                return {
                    "name": system.name,
                    "node": socket.gethostname(),
                    "pid": os.getpid(),
                    "role": system.role,
                    "leader": system.leader,
                    "store": system.store_name,
                    "since": self._since,
                    "actors": len(system.tree()),
                }
            case Tree():
                return system.tree()
            case Whereis():
                return system.whereis(request.name).path
            case Overview():
                return msgspec.msgpack.encode(await look_at(system, parts=request.parts, paths=request.paths))
            case InspectActor():
                return await inspected(system, request.path, min(request.timeout, LONGEST))
            case RestartActor():
                return await restart_actor(system, request.path, min(request.timeout, LONGEST), at_once=request.at_once)
            case SendMessage():
                return await self._send(request)
            case ControlActor():
                return await self._control(request)
            case Transact():
                return await self._transact(request)
            case FollowActor():
                return await self._follow(request.path)
            case NextEvents():
                return await self._next_events(request)
            case CountTurns():
                return await self._count(request.paths)
            case DeclareTree():
                timeout = min(request.timeout, LONGEST)
                change = await declare(system, request.text, request.name, dry_run=request.dry_run, timeout=timeout)
                return {"steps": [], "difference": [], "lost": []} if change is None else as_told(change)
            case AskHistory():
                return msgspec.to_builtins(await self._history(request))
            case AskLogs():
                return msgspec.to_builtins(await self._logs(request))
            case AskLives():
                return msgspec.to_builtins(system.lives(request.path))
            case AskWhy():
                return await system.why(request.path, timeout=min(request.timeout, LONGEST))
            case AskCauses():
                return await self._causes(request)
            case AskQuarantined():
                return msgspec.to_builtins(system.put_aside(request.path))
            case SettleQuarantined():
                return self._settle(request)
            case AskConnections():
                return msgspec.to_builtins(system.connected())
            case DropKept():
                return await system.drop_kept(request.system)
            case AskDiagnosis():
                from .diagnosed import diagnosed  # only now: few systems have diagnosis, and all have an endpoint

                return await diagnosed(system, request.path, min(request.timeout, LONGEST))
            case OrderRepair():
                from .diagnosed import order_repair

                return await order_repair(system, request.verb, request.words, min(request.timeout, LONGEST))
            case _:
                assert_never(request)

    async def _causes(self, request: AskCauses) -> dict[str, Any]:
        """What is wrong at each address, one after another: the evidence about many is much work for one step."""
        if len(request.paths) > MOST_CAUSES:
            raise SpecError("causes", f"at most {MOST_CAUSES} addresses are asked about at a time")
        timeout = min(request.timeout, LONGEST)
        return {path: list(map(list, await self._system.causes(path, timeout=timeout))) for path in request.paths}

    async def _history(self, request: AskHistory) -> HistoryPage:
        """A page; its question comes from elsewhere, and is checked as everybody's is."""
        asked = request.question
        page = self._system.history(
            asked.path, kinds=asked.kinds, since=asked.since, until=asked.until, after=asked.after, limit=asked.limit
        )
        if page.events or not request.wait:
            return page
        after, wait = page.next, min(request.wait, LONGEST)
        return await self._system.follow_history(asked.path, kinds=asked.kinds, after=after, timeout=wait)

    async def _logs(self, request: AskLogs) -> LogPage:
        """A page of last lines; the question is checked as everybody's is."""
        system, asked = self._system, request.question
        path, level, after, limit = asked.path, asked.level, asked.after, asked.limit
        if after is None or not request.wait:
            return system.logs(path, level=level, since=asked.since, after=after, limit=limit)
        wait = min(request.wait, LONGEST)
        return await system.follow_logs(path, level=level, after=after, limit=limit, timeout=wait)

    def _settle(self, request: SettleQuarantined) -> dict[str, Any]:
        """Retry or drop what is meant, each message by itself; which of them it was, and why others were not."""
        system = self._system
        meant = [one for one in system.quarantined(request.path) if request.id in (None, one.id)]
        if not meant:
            which = "nothing" if request.id is None else f"no message {request.id}"
            raise SpecError(request.path, f"{which} of it is in quarantine: `holdfast quarantine` lists what is")
        done: list[PutAside] = []
        failed: list[str] = []
        for one in meant:
            try:
                (system.retry if request.verb == "retry" else system.drop)(one)
                done.append(put_aside(one))
            except HoldfastError as error:
                failed.append(f"{one.address} {one.id}: {error}")
        return {"done": msgspec.to_builtins(done), "failed": failed}

    async def _send(self, request: SendMessage) -> dict[str, Any]:
        """The reply, or nothing if none is wanted."""
        path, message, fields = request.path, request.message, request.fields
        if request.asks:
            return await ask_by_name(self._system, path, message, fields, min(request.timeout, LONGEST))
        tell_by_name(self._system, path, message, fields)
        return {}

    async def _control(self, request: ControlActor) -> Any:
        system, timeout = self._system, min(request.timeout, LONGEST)
        ref = system.ref(request.path, Actor)
        with trusted_imports(system._node, Needed(request.script, request.args)):
            args = [open_arg(arg) for arg in request.args]
        value = await getattr(system, request.verb)(ref, *args, timeout=timeout)
        return str(value) if request.verb == "terminate" else value

    async def _transact(self, request: Transact) -> Any:
        timeout = min(request.timeout, LONGEST)
        everything = [arg for _, args in request.operations for arg in args]
        node, operations = self._system._node, list[tuple[str, list[Any]]]()
        with trusted_imports(node, Needed(request.script, everything)):
            pass  # The script is loaded, if something of it is needed.
        for begin in range(0, len(request.operations), OPENED_TOGETHER):
            with trusted_imports(node, Needed(None, [])):
                some = request.operations[begin : begin + OPENED_TOGETHER]
                operations += [(verb, [open_arg(arg) for arg in args]) for verb, args in some]
            await asyncio.sleep(0)  # Others are answered meanwhile; outside of the block, whose imports are ours alone.
        async with self._system.transaction(dry_run=request.dry_run, timeout=timeout) as change:
            for verb, args in operations:
                if verb not in OPERATIONS:
                    raise BadRequest(f"there is no operation {verb!r}")
                if verb == "respecify":
                    change.respecify(args[0], **_options(args))
                    continue
                named = NAMED.get(verb, ())
                at = len(args) - len(named)
                if at < 0:
                    raise BadRequest(f"{verb} lacks {', '.join(named[at:])}")
                getattr(change, verb)(*args[:at], **dict(zip(named, args[at:], strict=True)))
        return as_told(change)

    # -- following ----------------------------------------------------------------------------------------------------

    async def _follow(self, path: str) -> None:
        if self._followed is not None:
            raise BadRequest("this connection follows an actor already")
        self._followed = await self._system.trace(self._system.ref(path))

    async def _next_events(self, request: NextEvents) -> dict[str, Any]:
        """What has happened since the last time; waits for something at most so many seconds."""
        stream = self._followed
        if stream is None:
            raise BadRequest("this connection follows nobody")
        try:
            async with asyncio.timeout(min(request.seconds, LONGEST)):
                first = [await anext(stream)]
        except TimeoutError:
            return {"events": [], "missed": stream.missed, "is_over": False}
        except StopAsyncIteration:
            return {"events": [], "missed": stream.missed, "is_over": True}
        now = self._system._node.clock.wall()
        return {
            "events": [event_words(one, now) for one in (*first, *stream.take())],
            "missed": stream.missed,
            "is_over": False,
        }

    # -- counting -----------------------------------------------------------------------------------------------------

    async def _count(self, paths: list[str]) -> dict[str, int]:
        """Count the turns of just these actors from now on; how many each has handled since that began.

        Whoever is counted for somebody else is left as it is.
        """
        wanted = set(paths[:MOST_COUNTED])
        if len(paths) > MOST_COUNTED:
            raise SpecError("count", f"at most {MOST_COUNTED} actors are counted for one client")
        for path in self._counted - wanted:
            with contextlib.suppress(HoldfastError):  # It has gone, and its counts with it.
                await self._system.statistics(self._system.ref(path), False, timeout=1.0)
        self._counted &= wanted
        counts = await asyncio.gather(*(self._turns_of(path) for path in paths))
        return {path: turns for path, turns in zip(paths, counts, strict=True) if turns is not None}

    async def _turns_of(self, path: str) -> int | None:
        try:
            ref = self._system.ref(path)
            known = await self._system.statistics(ref, timeout=1.0)
            if known is None:
                self._counted.add(path)
                known = await self._system.statistics(ref, True, timeout=1.0)
        except HoldfastError:  # It has gone, or does not come to it: no number is shown.
            return None
        return None if known is None else known.turns


def _why_not_here(system: ActorSystem) -> str:
    """Why a program does not run its system so far; an empty text if it does."""
    match system.role:
        case "standby":
            return f"it stands by, and {system.leader} leads"
        case "waiting":
            return "it is being started, or waits for the servers of its store"
        case "leader" | "alone":
            return ""


def _options(args: list[Any]) -> dict[str, Any]:
    """The options of a child that came behind it. Raises BadRequest if these are none."""
    match args:
        case [_, dict() as options] if all(isinstance(name, str) for name in options):
            return options
        case _:
            raise BadRequest("respecify takes a child and its options")


def as_told(change: Change) -> dict[str, Any]:
    """The steps of a transaction, and how the tree changes, as plain data."""
    steps = [(step.number, step.verb, step.target, step.text, step.note) for step in change.steps]
    return {"steps": steps, "difference": list(change.difference), "lost": list(change.lost)}


def event_words(event: Event, now: float) -> dict[str, Any]:
    """What a followed actor has done, as plain data."""
    said: dict[str, Any] = {"at": now, "what": type(event).__name__}
    if isinstance(event, MessageIn | TurnBegan | TurnEnded | MessageOut):
        message = event.message
        is_text = isinstance(message, str)
        said["type"] = message if is_text else type_name(type(message))
        said["message"] = (message if is_text else repr(message))[:LONGEST_MESSAGE]
    match event:
        case TurnEnded():
            return {**said, "seconds": event.seconds, "outcome": event.outcome}
        case MessageOut():
            return {**said, "to": event.to}
        case _:
            return said
