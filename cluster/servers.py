"""Where a system is kept on several machines, and where it is reached: real servers, or simulated ones."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Coroutine, Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

from ..actors.errors import SpecError
from ..actors.events import ServersSilent, StandingBy
from .engine_thread import EngineLoop, EngineThread
from .ports import Engine

if TYPE_CHECKING:
    from .lines.lines import Transport

T = TypeVar("T")


class JoinLoop(EngineLoop, Protocol):
    """The loop of an engine, for whoever joins a system and awaits what is done there."""

    def run(self, work: Coroutine[Any, Any, T]) -> asyncio.Future[T]:
        """Run a coroutine on that loop, for somebody on the running one; to cancel the future cancels it."""
        ...


@dataclasses.dataclass(slots=True)
class ServersSeen:
    """What was told last of the servers of a store.

    Attributes:
        standing: that another program leads.
        silent: why they do not answer, while that is so.
    """

    standing: StandingBy | None = None
    silent: ServersSilent | None = None


@runtime_checkable
class Servers(Protocol):
    """The servers of one system; `ActorSystem(store=)` and `hf.connect` take it in the place of an address."""

    @property
    def system(self) -> str:
        """What the system is called there."""
        ...

    def engine_loop(self, name: str) -> JoinLoop:
        """The loop on which an engine works."""
        ...

    async def open_engine(self, *, is_new: bool = True) -> Engine:
        """Connect, for a program that is to lead the system; on the engine's loop.

        Raises:
            StoreFailed: nothing is there of the system, and nothing is to be made.
            AccessRefused, UnsafeServer: the servers do not let this program in, or may lose something.
            Unanswered: no server can be reached.
        """
        ...

    async def open_lines(self) -> tuple[Transport, str]:
        """Connect for lines, on the running loop: a transport, and the place at which the system listens.

        Raises:
            AccessRefused: the servers do not let this program in. Unanswered: no server can be reached.
        """
        ...


class NatsServers:
    """Servers of NATS; see `Servers`.

    Args:
        at: "nats://HOST,HOST/NAME".
        settings: how the servers are reached, see `access_of`.

    Raises:
        SpecError: the address cannot be read, or the library for it is missing.
    """

    def __init__(self, at: str, settings: Mapping[str, str | bool | int]) -> None:
        kind, is_address, _ = at.partition("://")
        if not is_address or kind not in ("nats", "tls"):
            raise SpecError(
                "servers", f"{kind.partition(':')[0]}: names no servers: nats://HOST,HOST/NAME or tls://... does"
            )
        if find_spec("nats") is None:
            raise SpecError("store", f"{kind}:// needs the library nats-py: pip install 'holdfast[nats]'")
        from .nats.access import access_of  # only now: it imports that library

        self._access = access_of(at, settings)

    @property
    def system(self) -> str:
        """What the system is called there: its account, and part of every subject."""
        return self._access.system

    def engine_loop(self, name: str) -> JoinLoop:
        """A thread of the engine's own."""
        return EngineThread(name)

    async def open_engine(self, *, is_new: bool = True) -> Engine:
        """Connect to the log, the lease and the blobs; see `Servers`."""
        from .nats.nats_engine import open_engine

        return await open_engine(self._access, is_new=is_new)

    async def open_lines(self) -> tuple[Transport, str]:
        """Connect for lines; see `Servers`."""
        from .nats.nats_transport import open_transport
        from .nats.system_streams import SubjectNames

        return await open_transport(self._access), SubjectNames(self.system).inbox


def servers_of(at: str | Servers, settings: Mapping[str, str | bool | int]) -> Servers:
    """The servers that an address means, or that it is.

    Raises:
        SpecError: the address cannot be read, or the library for it is missing.
    """
    return at if isinstance(at, Servers) else NatsServers(at, settings)
