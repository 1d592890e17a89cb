"""A fleet whose machines, network and disks fail: three servers, two programs, clients outside, and the judge."""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
import subprocess
from pathlib import Path
from typing import Literal

from nats.aio.msg import Msg

from holdfast.cluster.log_records import CHANGES, decode_changes, read_part
from holdfast.cluster.nats.access import access_of
from holdfast.cluster.nats.nats_engine import NatsEngine, open_engine
from holdfast.cluster.nats.system_streams import SubjectNames
from holdfast.cluster.ports import LogRecord
from tests.cluster.certificates import certificates
from tests.cluster.fleet import Programs
from tests.cluster.machines.namespaces import Network
from tests.cluster.machines.outside import Clients, LogWatch
from tests.cluster.machines.slow_links import SlowLinks
from tests.cluster.servers import PATIENCE, NatsServers

Kind = Literal["network", "links"]
"""Whether the machines are network namespaces, or programs reach the servers through proxies."""
DISK_BYTES = 256 << 20
"""Of the disk of a server, in memory."""
CLIENTS = 4
PLACES = ("p0", "p1")
"""The machines of the programs."""


class FleetOfMachines:
    """Three servers and two programs, one of which leads.

    Args:
        folder: for all files.
        kind: what is between programs and servers.
        seed: draws what the clients do.
        isolation: where the account lives.
    """

    def __init__(self, folder: Path, kind: Kind, seed: int, isolation: str) -> None:
        self.folder, self.kind, self.draws = folder, kind, random.Random(seed)
        self._seed, self._isolation = seed, isolation
        self._stack = contextlib.AsyncExitStack()
        self.network: Network | None = None
        self.links: SlowLinks | None = None
        self.places: dict[int, str] = {}
        self.environ: dict[str, str] = {}
        self._waiting: dict[str, asyncio.Event] = {}

    async def start(self) -> None:
        """Start all of it, and wait until clients are answered."""
        stack = self._stack
        if self.kind == "network":
            network = self.network = Network(["n0", "n1", "n2", *PLACES])
            stack.callback(network.close)
            stack.enter_context(network.on(None))  # This test is at the hub.
            tls = certificates(self.folder, *network.addresses)
            self.disks = [self.folder / f"disk-{number}" for number in range(3)]
            for disk in self.disks:
                disk.mkdir()
                subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "none", disk], check=True)
                stack.callback(subprocess.check_call, ["umount", "-l", disk])
            self.servers = NatsServers(self.folder, 3, tls, network=network, stores=self.disks)
        else:
            self.servers = NatsServers(self.folder, 3, advertise=False)
        await self.servers.start()
        stack.callback(self.servers.close)
        self.system = self.servers.new_system()
        ports: list[int] = []
        if self.kind == "links":
            links = self.links = SlowLinks(self._seed)
            await links.start([plan.port for plan in self.servers.plans])
            stack.push_async_callback(links.close)
            ports = links.ports
        self.programs = Programs(self.servers.store(self.system, ports=ports), self.folder, self._isolation)
        stack.push_async_callback(self.programs.close)
        await self.complete()
        self.clients = Clients(self.programs.socket, CLIENTS, self._seed)
        stack.push_async_callback(self.clients.close)
        await self.clients.progress(5)
        self.watch = LogWatch(self.engine)
        await self.watch.start()
        stack.push_async_callback(self.watch.close)
        watching = await self.servers.connect(self.system)
        stack.push_async_callback(watching.close)
        await watching.subscribe(SubjectNames(self.system).log, cb=self._hear)

    async def engine(self) -> NatsEngine:
        """An engine of the system, past all that is slow."""
        return await open_engine(access_of(self.servers.store(self.system)))

    async def complete(self) -> None:
        """See to it that there are two programs, and that none has ended by itself."""
        for program in self.programs.processes:
            assert program.returncode is None, self.programs.errors()
        for place in PLACES:
            if place not in self.places.values():
                await self.begin(place)

    async def begin(self, place: str) -> asyncio.subprocess.Process:
        """Start a program on a machine."""
        before = [] if self.network is None else self.network.command(place)
        program = await self.programs.start(*before, environ=self.environ)
        self.places[program.pid] = place
        return program

    async def end(self, pid: int) -> None:
        """Kill a program, whether it runs or is stopped."""
        await self.programs.end(self.programs.of(pid), signal.SIGKILL)
        del self.places[pid]
        self.socket_of(pid).unlink(missing_ok=True)

    def socket_of(self, pid: int) -> Path:
        """Where a program listens by itself, if it leads."""
        return self.folder / f"{self.programs.socket.name}.{pid}"

    def other(self, pid: int) -> int:
        """The program that is not this one."""
        return next(one for one in self.places if one != pid)

    async def log_server(self) -> int:
        """The server that leads the log; any of them, if none does now."""
        found = await self.servers.leader_of(self.system, SubjectNames(self.system).log_stream)
        return self.draws.randrange(3) if found is None else found

    async def record(self, kind: str) -> None:
        """Wait until a record of that kind is on its way to the log: "epoch", "base" or "cut"."""
        waiting = self._waiting[kind] = asyncio.Event()
        async with asyncio.timeout(PATIENCE):
            await waiting.wait()

    async def _hear(self, message: Msg) -> None:
        part = read_part(LogRecord(0, message.data))
        kinds = {part.kind}
        if part.kind == CHANGES and part.is_last and part.part == 0:
            kinds |= {name for name, _ in decode_changes(part.data)}
        for kind in kinds & self._waiting.keys():
            self._waiting[kind].set()

    async def judge(self) -> None:
        """Stop the clients, and judge what they heard and what stands in the log."""
        await self.clients.stop()
        await self.clients.judge()
        for pid in [*self.places]:
            await self.end(pid)
        await self.watch.judge()

    def said(self) -> str:
        """What programs and servers have written, for somebody who looks into a failure."""
        logs = (file.read_text("utf-8", "replace").splitlines() for file in self.folder.glob("*.log"))
        lines = [line for log in logs for line in log if "[ERR]" in line or "[FTL]" in line][-20:]
        ended = [f"program {one.pid} has ended: {one.returncode}" for one in self.programs.processes if one.returncode]
        return "\n".join([self.programs.errors(), *ended, *lines])

    async def close(self) -> None:
        """End all of it."""
        await self._stack.aclose()
