"""Connections to other systems: `hf.connect`, and how a system is reached itself."""

from __future__ import annotations

import asyncio
import contextlib
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar, overload

from ..actors.errors import HoldfastError, SpecError, Unreachable
from ..actors.kernel.actor import Actor
from ..actors.kernel.message import Message
from ..actors.kernel.node import Node, Ports
from ..actors.kernel.ref import ActorRef
from ..actors.process.wire import frames
from ..actors.seconds import check_seconds
from ..actors.values.path_parts import check_path_part
from ..checkpoint.home.ask_recovery import PASSING
from ..cluster.configuration import NatsSettings
from ..cluster.leadership import Patience
from ..cluster.lines.calls import LineCaller, LineGate
from ..cluster.lines.far_line import FindName
from ..cluster.lines.lines import Lines, Transport, new_boot
from ..cluster.ports import Unanswered
from ..cluster.servers import Servers, servers_of
from ..cluster.silence import SilenceOfServers

if TYPE_CHECKING:
    from .system import ActorSystem

A = TypeVar("A", bound=Actor)
CLOSE_SECONDS = 5.0
"""How long a connection that is closed waits until what was sent is on its way."""


class SystemConnection:
    """A connection to another system: refs to its actors, and its topics. Made by `connect`; an async context manager.

    It stays while the other system is led by one program after the other.
    """

    def __init__(self, servers: str | Servers, system: str | None, within: ActorSystem | None, seconds: float) -> None:
        self._servers, self._system, self._within, self._seconds = servers, system, within, seconds
        self._own: Node | None = None
        self._lines: Lines | None = None
        self._transport: Transport | None = None
        self._call: LineCaller | None = None
        self._topics: dict[str, set[str]] = {}

    async def __aenter__(self) -> SystemConnection:
        if self._call is not None:
            raise HoldfastError(f"the connection to {self.system!r} was opened already; make a new one")
        servers = servers_of(self._servers, NatsSettings().told())
        self._system = self._system or servers.system
        try:
            transport, to = await servers.open_lines()
        except Unanswered as error:
            raise Unreachable(f"/{self._system}", error.problem) from error
        self._transport = transport
        try:
            lines = self._lines = self._lines_of(self._within)
            call = self._call = LineCaller(lines, transport, to, self._system, self._subscribe_again)
            await transport.unless_denied(call.begin(self._seconds))
        except (TimeoutError, Unanswered) as error:
            await self.close()
            problem = f"no program that leads it has answered for {self._seconds:g} s"
            raise Unreachable(
                f"/{self._system}", error.problem if isinstance(error, Unanswered) else problem
            ) from error
        except BaseException:
            await self.close()
            raise
        return self

    def _lines_of(self, within: ActorSystem | None) -> Lines:
        if within is not None:
            return within.lines
        boot = new_boot()
        node = self._own = Node(f"{PASSING[1:]}{boot.token}", asyncio.get_running_loop())
        lines = Lines(node, node.name, boot)
        node.connect(Ports(outside=lines.find))
        return lines

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection: asks that are out fail, and nothing more is sent. A second call changes nothing."""
        if self._call is not None:
            await self._call.end(CLOSE_SECONDS)
        transport, self._transport = self._transport, None
        if transport is not None:
            await transport.close()
        node, self._own = self._own, None
        if node is not None:
            await node.close()
            node.deadlines.close()
            node.events.close()

    @property
    def system(self) -> str:
        """The name of the other system: the first part of its addresses."""
        return self._system or str(self._servers)

    @property
    def is_reachable(self) -> bool:
        """Tell whether a program that leads the other system has answered within the last seconds."""
        return self._call is not None and self._call.far.line is not None and not self._call.far.is_lost

    @overload
    def ref(self, path: str) -> ActorRef[Any]: ...
    @overload
    def ref(self, path: str, kind: type[A]) -> ActorRef[A]: ...
    def ref(self, path: str, kind: type[Actor] = Actor) -> ActorRef[Any]:
        """A ref to an actor of the other system, whether it lives there or not: what is sent to nobody fails there.

        Args:
            path: its address, such as `/billing/bank/alice`.
            kind: its class, for type checkers.

        Raises:
            SpecError: the address is not one of that system.
        """
        top = f"/{self.system}"
        if path != top and not path.startswith(f"{top}/"):
            raise SpecError("connect", f"{path!r} is no address of {self.system!r}: they begin with {top}/")
        return ActorRef(self._opened().far.stand_in(path))

    @overload
    async def whereis(self, name: str, *, timeout: float = ...) -> ActorRef[Any]: ...
    @overload
    async def whereis(self, name: str, kind: type[A], *, timeout: float = ...) -> ActorRef[A]: ...
    async def whereis(self, name: str, kind: type[Actor] = Actor, *, timeout: float = 5.0) -> ActorRef[Any]:
        """Return a ref to the actor of the other system that has a name there, given with `scope="fleet"`.

        Who leads the system has answered, and it was sure then that no other program does. The ref is to the address,
        and stays good when the name is freed. Between two lives of its actor nobody has a name.

        Args:
            name: beside its address, as the other system has registered it.
            kind: its class, for type checkers.
            timeout: seconds until an answer has come.

        Raises:
            NoSuchActor: nobody has the name now, or it is for the other system alone. AskTimeout: no answer came.
            ConnectionLost: the program that was asked may lead no more.
        """
        call = self._opened()
        system: ActorRef[Any] = ActorRef(call.far.stand_in(f"/{self.system}"))
        return ActorRef(call.far.stand_in(await system.ask(FindName(name), timeout)))

    async def publish(self, topic: str, message: Message[Any]) -> None:
        """Publish on a topic of the other system, and return when each subscriber there has accepted it.

        Raises:
            Unreachable: the other system is known to be cut off. AskFailed: it was lost meanwhile.
            BadMessage: the message cannot be coded.
        """
        far = self._opened().far
        name, body = far._payload(message)
        key, accepted = far.acceptance()
        far.connection.send(frames.Publish(key, topic, name, body), topic)
        await accepted

    def subscribe(self, topic: str, actor: ActorRef[Any]) -> None:
        """Have an actor of this system get what is published on a topic of the other one, from now on.

        While the other system changes its leader nobody gets what is published there.

        Raises:
            SpecError: the connection was not made within the system of the actor.
        """
        far = self._opened().far
        if actor._cell.node is not far.node:
            raise SpecError("connect", f"{actor.path} is not of the system that the connection was made within")
        self._topics.setdefault(topic, set()).add(actor.path)
        far.command(actor.path, "subscribe", {"topic": topic})

    def unsubscribe(self, topic: str, actor: ActorRef[Any]) -> None:
        """No more of a topic of the other system; unknown ones are fine."""
        self._topics.get(topic, set()).discard(actor.path)
        self._opened().far.command(actor.path, "unsubscribe", {"topic": topic})

    def _subscribe_again(self) -> None:
        """Another program leads the other system: it knows nothing of who has subscribed."""
        assert self._call is not None
        for topic, paths in self._topics.items():
            for path in paths:
                self._call.far.command(path, "subscribe", {"topic": topic})

    def _opened(self) -> LineCaller:
        if self._call is None:
            raise HoldfastError(f"the connection to {self.system!r} is not open: async with hf.connect(...) as it")
        return self._call


def connect(
    servers: str | Servers, *, system: str | None = None, within: ActorSystem | None = None, timeout: float = 5.0
) -> SystemConnection:
    """Describe a connection to another system; `async with` opens it.

    Args:
        servers: "nats://HOST,HOST/NAME", as the other system has it for a store; its credentials may be in it. In a
            simulation the servers of its fleet (`holdfast.testing.fleet`).
        system: the first part of the addresses of the other system; NAME if left out.
        within: the system whose actors use the refs, and are reached from there. None: this program has none.
        timeout: seconds until a program that leads the other system has answered.

    Raises:
        SpecError: an argument is not valid.

    Raises (when it is opened):
        Unreachable: nobody has answered. SpecError: the address cannot be read.
        AccessRefused: the servers do not let this program in, or do not let it send to the system.
        LineTaken: there is a connection to a system of that name already.
    """
    if system is not None:
        check_path_part("connect", "the system", system)
    check_seconds("connect", "timeout", timeout)
    return SystemConnection(servers, system, within, timeout)


async def serve(
    lines: Lines, at: str | Servers, settings: NatsSettings, *, waits: bool, silence: SilenceOfServers
) -> Transport:
    """Have this system reached at its servers.

    Args:
        lines: to other programs.
        at: the servers.
        settings: how they are reached.
        waits: until they answer, however long that takes.
        silence: told why they do not, and when they do.

    Raises:
        SpecError: the address cannot be read. Unanswered: no server can be reached for a moment, and nobody is to wait.
    """
    servers = servers_of(at, settings.told())

    async def listening() -> Transport:
        transport, inbox = await servers.open_lines()
        try:
            await transport.hear(inbox, LineGate(lines, transport).hear)
        except BaseException:
            with contextlib.suppress(TimeoutError):
                await transport.close()
            raise
        return transport

    transport = await Patience(waits=waits).answered(listening, silence.unanswered)
    silence.answered()
    return transport
