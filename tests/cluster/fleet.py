"""Programs that stand by and lead, as processes that tests kill and stop, and a client that asks whoever leads."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.cluster.servers import PATIENCE

ATTEMPT_SECONDS = 1.0
"""How long a client waits for an answer before it asks again, perhaps somebody else."""


class Programs:
    """Processes of one program on one store: of `tests.cluster.bank`, if nothing else is said."""

    def __init__(self, store: str, folder: Path, isolation: str = "task", command: Sequence[str] = ()) -> None:
        self.store, self.socket, self.isolation = store, folder / "bank.sock", isolation
        self.folder, self.command = folder, command
        self.processes: list[asyncio.subprocess.Process] = []
        self._started = 0

    async def start(self, *before: str, environ: Mapping[str, str] | None = None) -> asyncio.subprocess.Process:
        """Start another program; it stands by, or leads.

        Args:
            before: the command that the program is run by, if there is one.
            environ: what its environment has beside that of the tests.
        """
        bank = ("-m", "tests.cluster.bank", self.store, str(self.socket), self.isolation)
        command = [*before, sys.executable, *(self.command or bank)]
        self._started += 1  # What those who have ended wrote is kept.
        with (self.folder / f"program-{self._started:03}.err").open("wb") as errors:
            process = await asyncio.create_subprocess_exec(
                *command, stdout=asyncio.subprocess.PIPE, stderr=errors, env={**os.environ, **(environ or {})}
            )
        self.processes.append(process)
        return process

    async def leads(self, process: asyncio.subprocess.Process) -> None:
        """Wait until a program has begun to lead."""
        assert process.stdout is not None
        async with asyncio.timeout(PATIENCE):
            assert await process.stdout.readline() == b"leads\n", self.errors()

    def errors(self) -> str:
        """What the programs have written about what went wrong."""
        return "\n".join(file.read_text() for file in sorted(self.folder.glob("program-*.err")))

    def of(self, pid: int) -> asyncio.subprocess.Process:
        """The program with that pid."""
        return next(one for one in self.processes if one.pid == pid)

    async def end(self, process: asyncio.subprocess.Process, number: signal.Signals = signal.SIGKILL) -> None:
        """Send a program that signal, and wait until it has ended."""
        process.send_signal(number)
        async with asyncio.timeout(PATIENCE):
            await process.wait()
        self.processes.remove(process)

    async def close(self) -> None:
        """End all programs."""
        for process in [*self.processes]:
            with contextlib.suppress(ProcessLookupError):
                await self.end(process)


class Client:
    """Deposits 1, 2, 3, ...: each is asked for until it is answered, and then the next one follows.

    Attributes:
        leader: the pid of the program that has answered last.
        count: how many deposits were answered.
        balance: their sum, which each answer is compared with: it is as if there were one account, which never failed.
    """

    def __init__(self, socket: Path) -> None:
        self._socket = socket
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self.leader = 0
        self.count = self.balance = 0

    async def deposit(self) -> None:
        """One more deposit."""
        number = self.count + 1
        answer = await self._answered({"id": number, "amount": number})
        self.balance += number
        self.count = number
        assert answer == self.balance, f"deposit {number} was answered with {answer}, not {self.balance}"

    async def deposit_for(self, until: asyncio.Event) -> None:
        """Deposits, until the event is set."""
        while not until.is_set():
            await self.deposit()

    async def check_pid(self) -> None:
        """Find out who leads."""
        await self._answered({})

    async def check(self) -> None:
        """Compare what the account says of itself."""
        answer = await self._answered({})
        assert answer == {"balance": self.balance, "count": self.count}, answer

    async def _answered(self, request: dict[str, int]) -> object:
        async with asyncio.timeout(PATIENCE):
            while True:
                try:
                    async with asyncio.timeout(ATTEMPT_SECONDS):
                        return await self._ask(request)
                except (OSError, TimeoutError, asyncio.IncompleteReadError):
                    await self.close()
                    await asyncio.sleep(0.02)  # Nobody tells a client that somebody else leads.

    async def _ask(self, request: dict[str, int]) -> object:
        if self._streams is None:
            self._streams = await asyncio.open_unix_connection(str(self._socket))
        reader, writer = self._streams
        writer.write(json.dumps(request).encode() + b"\n")
        answer = json.loads(await reader.readuntil())
        self.leader = answer["pid"]
        return answer["answer"]

    async def close(self) -> None:
        """Let go of the connection."""
        streams, self._streams = self._streams, None
        if streams is not None:
            streams[1].close()
            with contextlib.suppress(OSError):
                await streams[1].wait_closed()
