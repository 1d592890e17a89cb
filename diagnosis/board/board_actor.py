"""The board for actors: its measurements are a topic, and to switch a channel is a message."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import TypeVar

from ...actors.kernel.actor import Actor, on
from ...actors.kernel.message import Message, Refusal, RuntimeCall
from .board_frames import Measurements, Specification
from .client import Board, BoardError

T = TypeVar("T")

TOPIC = "/board_measurements"


class BoardMeasured(Message):
    """What the board measures, and the Unix time at which that came; on `/board_measurements`."""

    time: float
    measurements: Measurements


class SwitchChannel(RuntimeCall):
    """Switch a channel, 0 to 9; answered when the board has acknowledged. Refused with BoardFailed."""

    channel: int
    on: bool


class GetSpecification(Message[Specification]):
    """What is the board? Refused with BoardFailed."""


class BoardFailed(Refusal, text="the board has not done it ({kind}): {why}"):
    """The board could not be reached, did not answer, or refused; `kind` is the class of the error."""

    kind: str
    why: str


class BoardActor(Actor):
    """Holds the connection to a board, also while there is none.

    Args:
        url: `tcp://host:port` or `tls://host:port`.
        interval: seconds between two measurements.
        timeout: seconds for a request; no other is handled meanwhile.
        token, ca, certificate, key, insecure: see `Board`.

    Raises:
        ValueError, SpecError: see `Board`.
    """

    deterministic = False

    def __init__(
        self,
        url: str,
        *,
        interval: float = 1.0,
        timeout: float = 2.0,
        token: str | None = None,
        ca: str | None = None,
        certificate: str | None = None,
        key: str | None = None,
        insecure: bool = False,
    ) -> None:
        self._url, self._interval, self._timeout = url, interval, timeout
        self._token, self._ca, self._certificate, self._key, self._insecure = token, ca, certificate, key, insecure

    async def on_start(self, restored: bool) -> None:
        """Begin to connect; whether there is a board shows later."""
        self._board = Board(
            self._url,
            timeout=self._timeout,
            broadcast=self._interval,
            rng=self.ctx.random,
            token=self._token,
            ca=self._ca,
            certificate=self._certificate,
            key=self._key,
            insecure=self._insecure,
        )
        entered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.ctx.create_task(self._publish(entered))
        await entered

    async def _publish(self, entered: asyncio.Future[None]) -> None:
        """Until the life ends; as a task of it, it also ends when the actor is killed."""
        async with self._board:
            entered.set_result(None)
            async for measured in self._board.measurements():
                await self.ctx.publish(TOPIC, BoardMeasured(self.ctx.now(), measured))

    @on(SwitchChannel)
    async def _switch(self, message: SwitchChannel) -> None:
        await self._tried(self._board.switch(message.channel, message.on))

    @on(GetSpecification)
    async def _specification(self, message: GetSpecification) -> Specification:
        return await self._tried(self._board.specification())

    async def _tried(self, work: Awaitable[T]) -> T:
        try:
            return await work
        except BoardError as error:
            raise BoardFailed(kind=type(error).__name__, why=str(error)) from error
