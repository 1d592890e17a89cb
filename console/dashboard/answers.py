"""Who answers the page: the system in this process, or one behind its control endpoint; the same requests to both."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any, Final, Protocol, TypeAlias

from ...actors.errors import HoldfastError, RemoteCrash, SpecError, error_text, type_name
from ...system.system import ActorSystem
from ..client_session import ClientSession
from ..remote import CHANGES, NotReached, RemoteSystem
from ..wire import AnyRequest

MOST_CONNECTIONS: Final = 8
"""Connections to a control endpoint at a time; it serves 32, and the commands of operators need some."""
FRESH: Final = 300.0
"""Seconds after which an idle connection is not used again: the endpoint closes it after ten minutes."""


Endpoint: TypeAlias = "str | os.PathLike[str] | Callable[[], Path]"
"""Where the control endpoint of a system is, or who finds it."""


class Answers(Protocol):
    """Answers the requests that the control endpoint answers."""

    async def ask(self, request: AnyRequest, timeout: float) -> Any:
        """Ask, and wait at most `timeout` seconds. Raises HoldfastError: what the system says, or that it is away."""
        ...

    def session(self) -> AbstractAsyncContextManager[Answers]:
        """A session of its own, for requests that belong together; what it has switched on ends with it."""
        ...

    async def close(self) -> None:
        """Give back what was opened; nobody asks any more."""
        ...


class OwnAnswers:
    """Asks a system of this process, in the way in which its control endpoint does."""

    def __init__(self, system: ActorSystem) -> None:
        self._system = system
        self._session = ClientSession(system, time.time())

    async def ask(self, request: AnyRequest, timeout: float) -> Any:
        """Carry out a request in a task of its own. Raises HoldfastError: what the system says, or that it is late."""
        if not self._system._node.is_own_thread():
            raise SpecError("dashboard", "is served by another thread than the system: serve it on the system's loop")
        work = asyncio.create_task(self._session.carry_out(request), name="holdfast dashboard request")
        try:
            async with asyncio.timeout(timeout):
                return await work
        except TimeoutError as late:
            raise SpecError("dashboard", f"the system has not answered within {timeout:g} s: try again") from late
        except HoldfastError:
            raise
        except Exception as error:  # Whatever a user's code raises is told as over the control endpoint.
            raise RemoteCrash(type_name(type(error)), error_text(error)) from error

    @contextlib.asynccontextmanager
    async def session(self) -> AsyncGenerator[OwnAnswers]:
        """A session of its own, for requests that belong together; what it has switched on ends with it."""
        own = OwnAnswers(self._system)
        try:
            yield own
        finally:
            await own.close()

    async def close(self) -> None:
        """Give back what was switched on."""
        await self._session.close()


class SocketAnswers:
    """Asks a system over its control endpoint, on a few connections.

    Args:
        where: the path of the endpoint, or a function that finds it: the next program of that name has another one.
    """

    def __init__(self, where: Endpoint) -> None:
        self._where = where
        self._free = asyncio.Semaphore(MOST_CONNECTIONS)
        self._idle: list[tuple[float, RemoteSystem]] = []
        self._is_closed = False

    async def ask(self, request: AnyRequest, timeout: float) -> Any:
        """Ask over a connection that is free. Raises HoldfastError: what the system answers, or that it is away."""
        async with self._free:
            while (kept := self._kept()) is not None:
                try:
                    return await self._asked(kept, request, timeout)
                except NotReached:  # It was closed, perhaps long ago: what only looks is asked again.
                    if isinstance(request, CHANGES):
                        raise
            return await self._asked(await self._connected(), request, timeout)

    async def _connected(self) -> RemoteSystem:
        """A new connection; the kernel may have it wait."""
        connecting = asyncio.ensure_future(asyncio.to_thread(self._reach))
        try:
            return await asyncio.shield(connecting)
        except asyncio.CancelledError:
            connecting.add_done_callback(_close)  # The thread goes on, and nobody would close what it brings.
            raise

    def _reach(self) -> RemoteSystem:
        """Connect, in a thread of its own."""
        where = self._where
        return RemoteSystem(where() if callable(where) else where)

    def _kept(self) -> RemoteSystem | None:
        """A connection that was used a short time ago."""
        while self._idle:
            used, remote = self._idle.pop()
            if time.monotonic() - used < FRESH:
                return remote
            remote.close()
        return None

    async def _asked(self, remote: RemoteSystem, request: AnyRequest, timeout: float) -> Any:
        is_good = False
        try:
            value = await remote.call(request, timeout)
            is_good = True
            return value
        except HoldfastError as error:
            is_good = not isinstance(error, NotReached)
            raise
        finally:
            if is_good and not self._is_closed:
                self._idle.append((time.monotonic(), remote))
            else:
                remote.close()

    @contextlib.asynccontextmanager
    async def session(self) -> AsyncGenerator[Answers]:
        """A session of its own, for requests that belong together: one connection, which ends with it."""
        own = SocketAnswers(self._where)
        own._free = asyncio.Semaphore(1)
        try:
            yield own
        finally:
            await own.close()

    async def close(self) -> None:
        """Close the idle connections; those in use close when their request is over."""
        self._is_closed = True
        for _, remote in self._idle:
            remote.close()
        self._idle.clear()


def _close(connecting: asyncio.Future[RemoteSystem]) -> None:
    if not connecting.cancelled() and connecting.exception() is None:
        connecting.result().close()
