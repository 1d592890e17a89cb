"""Lines over NATS: plain messages between programs, which the servers pass on and do not keep."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final, TypeVar

import nats.errors
from nats.aio.msg import Msg

from ..engine_thread import end_tasks
from .access import NatsAccess
from .connecting import ANSWER_SECONDS, SystemClient, answering
from .nats_engine import CONNECT_SECONDS

T = TypeVar("T")

INBOX: Final = "_INBOX."
"""How subjects begin at which programs get answers."""


class NatsTransport:
    """Carries the batches of lines; see `cluster.lines.lines.Transport`.

    Args:
        client: connected, and closed with the transport.
        name: what errors call the servers, without secrets.
    """

    def __init__(self, client: SystemClient, name: str) -> None:
        self._client, self._name = client, name
        self._out: deque[tuple[str, bytes, str]] = deque()
        self._has_some = asyncio.Event()
        self._is_closing = False
        self._poster = asyncio.get_running_loop().create_task(self._post_all(), name=f"lines of {name}")

    def post(self, to: str, data: bytes, back: str) -> None:
        """Send bytes to a subject, unless no server is there; see `Transport`."""
        if self._client.is_connected:
            self._out.append((to, data, back))
            self._has_some.set()

    async def _post_all(self) -> None:
        while self._out or not self._is_closing:
            await self._has_some.wait()
            self._has_some.clear()
            while self._out:
                to, data, back = self._out.popleft()
                if self._client.is_connected:  # Else it would wait for a server, and come much later.
                    with contextlib.suppress(nats.errors.Error, OSError):
                        await self._client.publish(to, data, reply=back)

    async def hear(self, at: str, take: Callable[[bytes, str], None]) -> None:
        """Listen to a subject; see `Transport`."""

        loop = asyncio.get_running_loop()

        async def taken(message: Msg) -> None:
            if message.reply and not message.reply.startswith(INBOX):
                return  # What is answered there would go where this program may write and whoever asks may not.
            try:
                take(message.data, message.reply)
            except Exception as error:  # The client would keep it to itself.
                loop.call_exception_handler({"message": f"what came at {at} was not taken", "exception": error})

        listening = asyncio.ensure_future(self._listen(at, taken))
        try:
            await asyncio.shield(listening)  # The client does not bear that what waits for its server is cancelled.
        except asyncio.CancelledError:
            await asyncio.wait((listening,), timeout=ANSWER_SECONDS)
            raise

    async def _listen(self, at: str, taken: Callable[[Msg], Awaitable[None]]) -> None:
        with answering(self._name, self._client):
            await self._client.subscribe(at, cb=taken)
            await self._client.flush(int(ANSWER_SECONDS))

    @property
    def most_bytes(self) -> int:
        """What the servers take; see `Transport`."""
        return self._client.max_payload

    def own_place(self) -> str:
        """A subject of this client's own; see `Transport`."""
        return self._client.new_inbox()

    async def unless_denied(self, work: Coroutine[Any, Any, T]) -> T:
        """Do what the servers have to allow; see `Transport`."""
        return await self._client.unless_denied(work)

    async def close(self) -> None:
        """Send what was posted, and disconnect; see `Transport`."""
        with contextlib.suppress(nats.errors.Error, TimeoutError, OSError):
            self._is_closing = True
            self._has_some.set()
            async with asyncio.timeout(1.0):
                await self._poster
                await self._client.flush(timeout=1)
        await end_tasks(self._poster)
        with contextlib.suppress(nats.errors.Error, TimeoutError, OSError):
            await self._client.close()


async def open_transport(access: NatsAccess) -> NatsTransport:
    """Connect.

    Raises:
        SpecError: a file of secrets or certificates must not be used.
        AccessRefused: the servers do not let this program in.
        Unanswered: no server can be reached.
    """
    client = SystemClient(access, "client")
    try:
        await client.enter(CONNECT_SECONDS)
    except BaseException:  # It may be connected all the same, if this was cancelled just then.
        await client.close()
        raise
    return NatsTransport(client, access.name)
