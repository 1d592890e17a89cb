"""The demo on several machines: three servers, two nodes, and what is killed of them while questions are asked.

The leading node and the server that leads the log are killed in turn. Another node stands by again soon, and the server
is started again.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncGenerator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

from tests.cluster.servers import NatsServers  # pyright: ignore[reportMissingImports]  # by the path that fleet.py adds

from .demo_runs import DemoPlan, DemoRun, Scene, begin, undisturbed
from .far import FarFleet
from .log import Survey
from .report import TAKEOVER, DemoReport, MapperKill, MapperRecovery
from .show import Watcher

SERVERS = 3
NODES = 2
EVERY = 0.02  # seconds from one question to the next: each goes to the disks of two servers, several times
LOOK = 0.2  # seconds between two looks who leads the log
AWAY = 1.0  # seconds after which a killed server is started again
PROGRAMS = Path(__file__).parents[1]


async def compare_fleet(plan: DemoPlan, watcher: Watcher) -> DemoReport:
    """Run it in one process, undisturbed, and on a fleet, whose leading node and server are killed; and report.

    Raises:
        LogError: there is not one scan in the log.
    """
    began = monotonic()
    found = begin(plan, watcher)
    before = await undisturbed(plan, found, watcher)
    name, stage = f"fleet, {plan.kills} kills", partial(fleet, plan, found)
    disturbed = await DemoRun(plan, found, watcher, name, stage, kills=plan.kills).drive()
    return DemoReport(before, disturbed, "fleet", monotonic() - began)


@asynccontextmanager
async def fleet(plan: DemoPlan, found: Survey, recovered: Callable[[MapperRecovery], None]) -> AsyncGenerator[Scene]:
    """Servers and nodes, and the way to them."""
    with TemporaryDirectory(prefix="holdfast-") as folder:
        made = DemoFleet(plan, Path(folder), lambda seconds: recovered(MapperRecovery({TAKEOVER: seconds}, 0)))
        try:
            await made.start()
            far = made.far
            yield Scene(far, far, far, made.leader, made.victim, made.killed, made.machines, EVERY)
        finally:
            await made.close()


class DemoFleet:
    """Servers, nodes, and what happens to them.

    Args:
        plan: of the demo.
        folder: for all files.
        outlived: told how many seconds a kill has kept answers away.
    """

    def __init__(self, plan: DemoPlan, folder: Path, outlived: Callable[[float], None]) -> None:
        self._plan, self._folder = plan, folder
        self._servers = NatsServers(folder, SERVERS)
        self._nodes: dict[int, asyncio.subprocess.Process] = {}
        self._log_server: int | None = None
        self._work: set[asyncio.Task[None]] = set()
        self._kills = 0
        self.far = FarFleet(folder / "fleet.sock", outlived)

    async def start(self) -> None:
        """Start everything; whoever is asked waits until somebody leads."""
        await self._servers.start()
        self._system = self._servers.new_system()
        for _ in range(NODES):
            await self._begin_node()
        self._do(self._look())

    def leader(self) -> int | None:
        """The node that leads; None before anybody has answered."""
        return self.far.leader if self.far.leader in self._nodes else None

    def victim(self) -> int | None:
        """The leading node and the leading server in turn; None while there is none, or a kill is not outlived."""
        if self.far.struck:
            return None
        if self._kills % 2 == 0:
            return self.leader() if len(self._nodes) == NODES else None
        return None if self._log_server is None else self._servers.pid(self._log_server)

    def killed(self, kill: MapperKill) -> None:
        """One of them was killed: replace it."""
        self._kills += 1
        self.far.struck = monotonic()
        if kill.pid in self._nodes:
            self._do(self._replace_node(kill.pid))
        elif self._log_server is not None:
            self._do(self._restart(self._log_server))
            self._log_server = None

    def machines(self) -> list[str]:
        """What there is of it, for the display."""
        nodes = [f"node     process {pid}, {'leads' if pid == self.far.leader else 'stands by'}" for pid in self._nodes]
        names = [plan.name for plan in self._servers.plans]
        leads = self._log_server
        return [*nodes, *(f"server   {name}{', leads the log' if n == leads else ''}" for n, name in enumerate(names))]

    async def close(self) -> None:
        """End all of it."""
        for task in self._work:
            task.cancel()
        if self._work:
            await asyncio.wait(self._work)
        await self.far.close()
        for node in self._nodes.values():
            with suppress(ProcessLookupError):
                node.kill()
            await node.wait()
        self._servers.close()

    def _do(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._work.add(task)
        task.add_done_callback(self._work.discard)

    async def _begin_node(self) -> None:
        plan = self._plan
        told = (self._servers.store(self._system), str(self._folder / "fleet.sock"), str(plan.log.resolve()))
        command = ["-m", "map_demo.node", *told, str(plan.speed), str(plan.interval)]
        environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PROGRAMS), os.environ.get("PYTHONPATH", "")])}
        node = await asyncio.create_subprocess_exec(sys.executable, *command, env=environ)
        self._nodes[node.pid] = node

    async def _replace_node(self, pid: int) -> None:
        await self._nodes.pop(pid).wait()
        await self._begin_node()

    async def _restart(self, number: int) -> None:
        await asyncio.sleep(AWAY)
        await self._servers.restart(number)

    async def _look(self) -> None:
        """Know which server leads the log: nobody tells."""
        while True:
            self._log_server = await self._servers.leader_of(self._system, f"hf-{self._system}-log")
            await asyncio.sleep(LOOK)
