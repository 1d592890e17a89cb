"""A client of the board that keeps its connection: it comes back by itself, and nobody waits for ever."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from types import TracebackType
from typing import TypeVar
from urllib.parse import urlsplit

from ...actors.backoff import Backoff
from ...actors.errors import HoldfastError
from ...actors.streams import connect
from .board_frames import (
    Answer,
    AskMeasurements,
    AskSpecification,
    AuthenticateFrame,
    BadBoardFrame,
    BoardDecoder,
    Broadcast,
    DoneFrame,
    Measurements,
    RefusedFrame,
    Request,
    SetDefaults,
    Specification,
    SwitchFrame,
    encode,
)
from .board_tls import check_token, client_tls

A = TypeVar("A", bound=Answer)

MOST_WAITING = 64
"""Requests under way at a time."""
SILENT_REQUESTS = 3
"""So many requests in a row without an answer, and the connection is made anew: the other side may be gone."""
MISSED_BROADCASTS = 3
"""So many broadcasts may be missing before the connection is made anew."""
PIECE = 4096


class BoardError(HoldfastError):
    """Something did not go well with the board."""


class BoardUnreachable(BoardError, text="the board at {url} cannot be reached: {why}; nothing was sent"):
    """There was no connection: nothing was sent."""

    url: str
    why: str


class BoardLost(
    BoardError, text="the connection to the board at {url} ended before it had answered; it may have done it"
):
    """The connection ended before the answer: it may have been done. To ask for the same again does no harm."""

    url: str


class BoardSilent(BoardError, text="the board at {url} did not answer within {seconds:g} s; it may have done it"):
    """No answer came in time: it may have been done. To ask for the same again does no harm."""

    url: str
    seconds: float


class BoardRefused(BoardError, text="the board at {url} refuses: {why}"):
    """The board, or the client itself, says no, and why: nothing was done."""

    url: str
    why: str


class Board:
    """The board at `tcp://host:port` or `tls://host:port`, as an async context manager; it need not be there yet.

    Args:
        url: where it is; with `tls` what is sent is encrypted, and the board's certificate is checked.
        timeout: seconds for a connection, and for each request with the wait for a connection.
        broadcast: seconds between two broadcasts, asked for with each new connection; 0 is none.
        backoff: between two attempts to connect.
        rng: for the jitter of the back-off.
        token: is said first over each connection; None: the board has none.
        ca: a file with the certificates of who signs that of the board; None: those that the system trusts.
        certificate, key: files with a certificate of ours and its private key, if the board asks for one.
        insecure: whether a token may go to another machine in clear, by `tcp`.

    Raises:
        ValueError: the address is none, a number is out of range, or the token would go over a network in clear.
        SpecError: the certificates cannot be read.
    """

    def __init__(
        self,
        url: str,
        *,
        timeout: float = 2.0,
        broadcast: float = 0.0,
        backoff: Backoff | None = None,
        rng: random.Random | None = None,
        token: str | None = None,
        ca: str | Path | None = None,
        certificate: str | Path | None = None,
        key: str | Path | None = None,
        insecure: bool = False,
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("tcp", "tls") or not parts.hostname or not parts.port or parts.path or parts.query:
            raise ValueError(f"a board is at tcp://host:port or tls://host:port, not {url!r}")
        check_token(parts.hostname, token, is_encrypted=parts.scheme == "tls", insecure=insecure)
        self._tls = client_tls(ca, certificate, key) if parts.scheme == "tls" else None
        if not timeout > 0:
            raise ValueError(f"timeout must be > 0 seconds, not {timeout!r}")
        self.url, self._host, self._port = url, parts.hostname, parts.port
        self._timeout, self._backoff, self._rng = timeout, backoff or Backoff(), rng or random.Random()
        self._milliseconds, self._token = _milliseconds(broadcast), token
        self._keeper: asyncio.Task[None] | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._connected = asyncio.Event()
        self._waiting: dict[int, asyncio.Future[Answer]] = {}
        self._sequence = self._silent = 0
        self._problem = "it has not been tried"
        self._watchers: set[asyncio.Future[Measurements]] = set()

    async def __aenter__(self) -> Board:
        """Begin to connect, which goes on in the background."""
        if self._keeper is not None:
            raise RuntimeError("a Board is entered once")
        self._keeper = asyncio.get_running_loop().create_task(self._keep(), name=f"connection to {self.url}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the connection; who waits for an answer gets BoardLost, who waits for measurements ends."""
        assert self._keeper is not None
        self._keeper.cancel()
        await asyncio.wait((self._keeper,))
        self._problem = "it is closed"
        for watcher in self._watchers:
            watcher.cancel()

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self._connected.is_set()

    async def connected(self, timeout: float | None = None) -> None:
        """Wait for a connection. Raises BoardUnreachable if there is none in time (by default the board's)."""
        self._check_open()
        seconds = self._timeout if timeout is None else timeout
        try:
            async with asyncio.timeout(seconds):
                await self._connected.wait()
        except TimeoutError:
            raise BoardUnreachable(self.url, f"{self._problem} ({seconds:g} s)") from None

    async def specification(self) -> Specification:
        """What the board is. This and the other requests raise a BoardError if it does not answer as it should."""
        return await self._ask(AskSpecification(), Specification)

    async def measure(self) -> Measurements:
        """Ask the board what its channels measure now."""
        return await self._ask(AskMeasurements(), Measurements)

    async def switch(self, channel: int, on: bool) -> None:
        """Switch a channel, 0 to 9. That it says so does not mean that it is: measure."""
        await self._ask(SwitchFrame(channel, on), DoneFrame)

    async def broadcast(self, interval: float) -> None:
        """Have the measurements told every `interval` seconds, also over new connections; 0: no more."""
        frame = Broadcast(_milliseconds(interval))
        await self._ask(frame, DoneFrame)
        self._milliseconds = frame.milliseconds

    async def set_defaults(self, channels: Iterable[int]) -> None:
        """Which channels are on after the board's own power-up."""
        await self._ask(SetDefaults(frozenset(channels)), DoneFrame)

    async def measurements(self) -> AsyncIterator[Measurements]:
        """What is broadcast from now on, until the board is closed; who is slow gets the newest only."""
        self._check_open()
        while True:
            watcher = asyncio.get_running_loop().create_future()
            self._watchers.add(watcher)
            try:
                await asyncio.wait((watcher,))
            finally:
                self._watchers.discard(watcher)
            if watcher.cancelled():
                return
            yield watcher.result()

    def _check_open(self) -> None:
        if self._keeper is None or self._keeper.done():
            raise BoardUnreachable(
                self.url, "it is closed" if self._keeper else "enter it first: async with Board(...)"
            )

    async def _ask(self, request: Request, kind: type[A]) -> A:
        try:
            encode(1, request)  # Refused before anybody waits.
        except BadBoardFrame as error:
            raise BoardRefused(self.url, error.why) from error
        loop = asyncio.get_running_loop()
        began = loop.time()
        await self.connected()
        if len(self._waiting) >= MOST_WAITING:
            raise BoardRefused(self.url, f"{MOST_WAITING} requests are under way already")
        sequence, answer = self._send(request)  # Without a wait since the check: nobody else got the place.
        try:
            async with asyncio.timeout_at(began + self._timeout):
                got = await answer
        except TimeoutError:
            self._silent += 1
            if self._silent >= SILENT_REQUESTS and self._writer is not None:
                self._writer.transport.abort()
            raise BoardSilent(self.url, self._timeout) from None
        finally:
            self._waiting.pop(sequence, None)
        match got:
            case RefusedFrame(why):
                raise BoardRefused(self.url, why)
            case _ if isinstance(got, kind):
                return got
            case _:
                raise BoardRefused(self.url, f"it answers {type(got).__name__} to {type(request).__name__}")

    def _send(self, request: Request) -> tuple[int, asyncio.Future[Answer]]:
        """What is sent fits the transport's buffer: requests are small, and there are not many."""
        if self._writer is None or self._writer.transport.is_closing():
            raise BoardUnreachable(self.url, self._problem)
        self._sequence = self._sequence % 0xFFFF + 1  # 0 is for broadcasts
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[self._sequence] = answer
        self._writer.write(encode(self._sequence, request))
        return self._sequence, answer

    def _send_unasked(self, request: Request) -> None:
        """Send what nobody waits for."""
        sequence, answer = self._send(request)
        answer.add_done_callback(lambda done: self._waiting.pop(sequence, None))

    async def _keep(self) -> None:
        """Connect again whenever the connection is lost, with growing delays."""
        attempt = 0
        while True:
            try:
                async with asyncio.timeout(self._timeout):
                    reader, writer = await connect((self._host, self._port), limit=PIECE, tls=self._tls)
            except (OSError, TimeoutError) as error:
                self._problem = str(error) or "it does not answer"
            else:
                if await self._converse(reader, writer):
                    attempt = 0
            await asyncio.sleep(self._backoff.delay(attempt, self._rng))
            attempt += 1

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """One connection, until it ends. Whether the board has said anything that made sense."""
        self._writer, self._silent = writer, 0
        has_spoken = False
        self._problem = "the connection was lost"
        try:
            if self._token is not None:  # Frames are answered in order: what is sent behind it finds us known.
                self._send_unasked(AuthenticateFrame(self._token))
            if self._milliseconds:
                self._send_unasked(Broadcast(self._milliseconds))
            self._connected.set()
            decoder = BoardDecoder()
            while data := await self._read(reader):
                decoder.feed(data)
                while (taken := decoder.take()) is not None:
                    self._heard(*taken)
                    has_spoken = True
        except (OSError, TimeoutError) as error:
            self._problem = str(error) or "it has fallen silent"
        except BadBoardFrame as error:
            self._problem = str(error)
        finally:
            self._lose()
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
        return has_spoken

    async def _read(self, reader: asyncio.StreamReader) -> bytes:
        silence = self._timeout + MISSED_BROADCASTS * self._milliseconds / 1000 if self._milliseconds else None
        async with asyncio.timeout(silence):
            return await reader.read(PIECE)

    def _heard(self, sequence: int, frame: object) -> None:
        if not isinstance(frame, Answer):
            raise BadBoardFrame(f"{type(frame).__name__} is not for a board to say")
        self._silent = 0
        if sequence == 0 and isinstance(frame, RefusedFrame):
            raise BadBoardFrame(f"the board ends it: {frame.why}")
        if sequence == 0 and isinstance(frame, Measurements):
            for watcher in self._watchers:
                if not watcher.done():
                    watcher.set_result(frame)
            return
        answer = self._waiting.pop(sequence, None)
        if answer is not None and not answer.done():  # Else it comes too late, and nobody waits any more.
            answer.set_result(frame)

    def _lose(self) -> None:
        self._writer = None
        self._connected.clear()
        waiting, self._waiting = self._waiting, {}
        for answer in waiting.values():
            if not answer.done():
                answer.set_exception(BoardLost(self.url))
                answer.exception()  # Of what the client itself has asked nobody may know.


def _milliseconds(seconds: float) -> int:
    if not 0 <= seconds < 1e9:
        raise ValueError(f"an interval is >= 0 seconds, not {seconds!r}")
    return max(1, round(seconds * 1000)) if seconds else 0
