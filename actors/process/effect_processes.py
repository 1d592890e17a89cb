"""Processes for the functions of effects: one may compute for long, end by itself or be killed, and takes nobody along.

Each runs one function at a time and nothing else; it is reused when that has returned, and killed when its time is over
or nobody waits for it any more. When this process ends, however it does, they are killed. There are only so many at
once, and functions wait for one in the order in which they came.
"""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any, Final, Protocol

import msgspec

from ..control.orders import pack_function
from ..effects import FunctionDied, FunctionRaised, fencing_token
from ..kernel.codec import Codec
from ..values import decode_value, encode_value
from .fork.launch import import_path
from .owed_answer import OwedAnswer

ENTRY: Final = "holdfast.actors.process.effect_main"
MOST_IDLE: Final = 4
"""Processes that are kept for the next functions."""
MOST: Final = max(MOST_IDLE, os.cpu_count() or 1)
"""Functions that may compute at once: more than there are processors would only be in each other's way."""
ENDED_WITHIN: Final = 1.0
"""Seconds until a process that has closed its socket, and does not end, is killed."""
HEADER: Final = 8
"""Bytes in front of each message, which say how long it is."""
PREPARED: Final = ("sys_path", "orig_dir", "dir", "init_main_from_name", "init_main_from_path")
"""What a process has to know of this program, so that it can import the same."""


class EffectProcess:
    """One process, and the socket to it."""

    def __init__(self) -> None:
        from multiprocessing.spawn import get_preparation_data  # only now: it brings pickle and more

        path = import_path()
        told: dict[str, Any] = get_preparation_data("effect") | {"sys_path": path}
        self._first = msgspec.msgpack.encode({key: told[key] for key in PREPARED if key in told})
        self._socket, theirs = socket.socketpair()
        try:
            self._socket.setblocking(False)
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", ENTRY, str(theirs.fileno()), str(os.getpid())],
                    pass_fds=(theirs.fileno(),),
                    stdin=subprocess.DEVNULL,
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(path)},
                )
        except BaseException:
            self._socket.close()
            raise

    async def call(self, request: bytes) -> bytes:
        """Have it answer a request.

        Raises:
            FunctionDied: it has ended.
        """
        loop = asyncio.get_running_loop()
        first, self._first = self._first, b""
        try:
            for message in (first, request) if first else (request,):
                await loop.sock_sendall(self._socket, len(message).to_bytes(HEADER, "little") + message)
            with OwedAnswer(loop, self._process.pid):
                return await self._read(loop, int.from_bytes(await self._read(loop, HEADER), "little"))
        except (OSError, EOFError):
            code = await asyncio.to_thread(self._ended)  # It may take its time, and others want the loop.
            raise FunctionDied(f"its process has ended (exit code {code})") from None

    async def _read(self, loop: asyncio.AbstractEventLoop, count: int) -> bytes:
        read = bytearray()
        while len(read) < count:
            piece = await loop.sock_recv(self._socket, min(count - len(read), 1 << 20))
            if not piece:
                raise EOFError
            read += piece
        return bytes(read)

    @property
    def is_alive(self) -> bool:
        """Whether it can be given a function."""
        return self._process.poll() is None

    def _ended(self) -> int:
        """How it has ended; its end of the socket is closed a moment before that can be seen."""
        try:
            return self._process.wait(ENDED_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def end(self) -> None:
        """Kill it, whatever it does."""
        self._socket.close()
        self._process.kill()
        self._process.wait()


class FunctionProcess(Protocol):
    """What runs functions, one after another: a process, or what stands for one in a simulated run."""

    @property
    def is_alive(self) -> bool:
        """Whether it can be given a function."""
        ...

    async def call(self, request: bytes) -> bytes:
        """Have a function run; see `EffectProcess`."""
        ...

    def end(self) -> None:
        """Kill it, whatever it does."""
        ...


class EffectProcesses:
    """The processes for effects of one process of the system: begun when first needed, `most` at once."""

    def __init__(self, codec: Codec, kind: Callable[[], FunctionProcess] = EffectProcess, most: int = MOST) -> None:
        self._codec, self._kind = codec, kind
        self._room = asyncio.Semaphore(most)
        self._idle: list[FunctionProcess] = []
        self._all: set[FunctionProcess] = set()

    async def run(self, function: Callable[..., Any], *args: Any) -> object:
        """Run a function of a module in a process, and return what it returns. Cancelled, the process is killed.

        Raises:
            SpecError: the function cannot be imported there. UnsavableValue: an argument cannot be sent there.
            HoldfastError: the function has raised it, or has returned what cannot be sent back.
            FunctionRaised: it has raised something else. FunctionDied: its process has ended.
        """
        name, first, named = pack_function(function, "effect", "isolation='process'")
        given = [encode_value(value, where="the arguments", refs=False) for value in ([*first, *args], named)]
        async with self._room:
            kind, *answer = await self._answered(msgspec.msgpack.encode((name, *given, fencing_token())))
        match kind:
            case "value":
                return decode_value(answer[0])
            case "error":
                raise self._codec.decode_error(*answer)
            case _:
                raise FunctionRaised(*answer)

    async def _answered(self, request: bytes) -> Any:
        process = self._take()
        try:
            answer = msgspec.msgpack.decode(await process.call(request))
        except BaseException:
            self._all.discard(process)
            process.end()
            raise
        if len(self._idle) < MOST_IDLE:
            self._idle.append(process)
        else:
            self._all.discard(process)
            process.end()
        return answer

    def _take(self) -> FunctionProcess:
        """One that waits for a function, or a new one."""
        while self._idle:
            process = self._idle.pop()
            if process.is_alive:
                return process
            self._all.discard(process)
            process.end()
        process = self._kind()
        self._all.add(process)
        return process

    def close(self) -> None:
        """Kill the processes that compute, and those that are idle."""
        for process in self._all:
            process.end()
        self._all.clear()
        self._idle.clear()
