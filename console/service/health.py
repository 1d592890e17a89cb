"""How a system is, for those who start, watch and end programs: service managers, load balancers, Kubernetes."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from types import TracebackType
from typing import Final

from ...actors.errors import HoldfastError, SpecError
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef
from ...actors.seconds import check_seconds
from ...checkpoint.journal import StoreInUse
from ...supervision.admin import CountChildren
from ...supervision.supervisor import Supervisor
from ...system.system import ActorSystem
from ..overview import silent_at_root
from .notify import Notifier
from .probe_server import ProbeServer

PROBE_TIMEOUT: Final = 2.0
"""Seconds that the root has to answer, unless somebody says otherwise."""
LOOK_AGAIN: Final = 0.1
"""Seconds until it is looked again whether a store is free: its holder tells nobody when it ends."""


@dataclasses.dataclass(frozen=True, slots=True)
class Health:
    """How a system is found: good, or with sentences that say what is wrong."""

    problems: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether nothing is wrong, so that a probe succeeds."""
        return not self.problems

    @property
    def status(self) -> int:
        """The HTTP status of the answer to a probe: 200, or 503 if something is wrong."""
        return HTTPStatus.OK if self.is_good else HTTPStatus.SERVICE_UNAVAILABLE

    @property
    def text(self) -> str:
        """The body of the answer to a probe: "ok", or a sentence in each line."""
        return "\n".join(self.problems) or "ok"


class Service:
    """Run a system as a part of a program that others start, watch and end: `async with Service(system) as service`.

    Entering starts the system, and leaving stops it. A service manager that has asked for it (NOTIFY_SOCKET, as systemd
    does) is told of `up()`, that the event loop turns, and of the stop.

    Args:
        system: a system that was not entered yet; or, for a server with several worker processes, a function that
            makes it from the number of the worker, so that each has a store of its own.
        workers: how many numbers there are, from 0 on: the worker gets the first whose store nobody has. The master
            process of the server talks to the service manager then, and the workers do not.
        patience: seconds that a worker waits for a number, while those before it are still stopping.
        watch: addresses of supervisors whose children have to run, as those of the root, before it is ready.
        ends_server: if the tree fails, have the program end in good order, by SIGTERM to itself. For the lifespan of an
            ASGI application, whose server would go on listening without it.
        probes: `HOST:PORT` at which `GET /livez` and `GET /readyz` are answered, for a program without a web server;
            port 0 takes a free one, which `probe_port` has.
        environment: that of the process, in which NOTIFY_SOCKET is looked for.

    Raises (on entering):
        StoreInUse: no number has become free in time. SpecError: the address of the probes is none, or in use.
    """

    def __init__(
        self,
        system: ActorSystem | Callable[[int], ActorSystem],
        *,
        workers: int = 1,
        patience: float = 30.0,
        watch: Sequence[str] = (),
        ends_server: bool = False,
        probes: str | None = None,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        if not isinstance(system, ActorSystem) and not callable(system):
            raise SpecError("Service", f"takes a system, or a function of a worker's number, not {system!r:.100}")
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
            raise SpecError("Service", f"workers must be a number from 1 on, not {workers!r}")
        if workers > 1 and isinstance(system, ActorSystem):
            raise SpecError("Service", "several workers need a store each: give lambda number: ActorSystem(...)")
        self._made = system
        self._workers = workers
        self._patience = check_seconds("Service", "patience", patience)
        if isinstance(watch, str):
            raise SpecError("Service", f"watch takes addresses, not one text {watch!r:.100}: give [{watch!r:.100}]")
        self._watch = tuple(watch)
        self._ends_server = ends_server
        self._system: ActorSystem | None = None
        self._probes = ProbeServer(probes, self._probed) if probes is not None else None
        self._is_up = self._is_stopping = False
        self.notifier = Notifier(environment if workers == 1 else {})
        """Tells the service manager; a reload is told through it, too."""
        self.number = 0
        """The number of this worker."""

    @property
    def system(self) -> ActorSystem:
        """The system that runs.

        Raises:
            HoldfastError: it is not running, because the service was not entered.
        """
        if self._system is None:
            raise HoldfastError("the service is not running: use it in `async with Service(...) as service`")
        return self._system

    @property
    def probe_port(self) -> int:
        """The port at which probes are answered; 0 if they are not."""
        return self._probes.port if self._probes is not None else 0

    async def __aenter__(self) -> Service:
        try:
            if self._probes is not None:  # First: while a long recovery runs the program is alive, and not ready.
                await self._probes.open()
            self._system = await self._begin()
        except BaseException:
            await self._close()
            raise
        return self

    async def _begin(self) -> ActorSystem:
        """The running system, with the first number whose store nobody has."""
        if isinstance(self._made, ActorSystem):
            return await self._made.__aenter__()
        until = time.monotonic() + self._patience
        while True:
            for number in range(self._workers):
                self.number = number
                try:
                    return await self._made(number).__aenter__()
                except StoreInUse:
                    if number == self._workers - 1 and time.monotonic() > until:
                        raise
            await asyncio.sleep(LOOK_AGAIN)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stopping()
        system = self.system
        if self._ends_server and system.has_failed:
            signal.raise_signal(signal.SIGTERM)
        try:
            await system.__aexit__(kind, error, trace)
        finally:
            await self._close()

    async def _close(self) -> None:
        self.notifier.close()
        if self._probes is not None:
            await self._probes.close()

    def up(self, status: str = "") -> None:
        """Say that all is started: `ready` is good from now on, and the service manager is told.

        Args:
            status: one line that `systemctl status` shows; left out, the name of the system.
        """
        self._is_up = True
        self.notifier.ready(status or f"{self.system.name} runs")

    def stopping(self) -> None:
        """Say that the program ends: `ready` is not good any more. Leaving the service says so, too; once is enough."""
        if not self._is_stopping:
            self._is_stopping = True
            self.notifier.stopping()

    async def live(self, timeout: float = PROBE_TIMEOUT) -> Health:
        """Say whether the program should go on: its loop turns, its root answers, and its store has not failed.

        If it is not good, only a new program helps. A full disk, or an actor that restarts, is no reason for that.

        Args:
            timeout: seconds that the root has to answer.
        """
        if self._system is None:  # It is being started, which may take a while.
            return Health()
        return Health(tuple(await self._fatal(self._system, timeout)))

    async def ready(self, timeout: float = PROBE_TIMEOUT) -> Health:
        """Say whether requests should come here: all is up, is not stopping, accepts, and no child of the root is away.

        So it is with the children of those that `watch` names.

        Args:
            timeout: seconds that the root has to answer.
        """
        if self._is_stopping or self._system is None or not self._is_up:
            return Health(("the system is stopping" if self._is_stopping else "the system is being started",))
        problems = await self._fatal(self._system, timeout)
        if not problems:
            problems = await self._away(self._system, timeout)
        return Health(tuple(problems))

    async def _fatal(self, system: ActorSystem, timeout: float) -> list[str]:
        """What only a new program mends."""
        if system.has_failed:
            return [f"the tree of {system.name} has failed"]
        stopped = system.store_problem(for_good=True)
        if stopped:
            return [stopped]
        try:
            await system.ref(f"/{system.name}", Supervisor).ask(CountChildren(), timeout)
        except HoldfastError as error:
            return [] if self._is_stopping else [f"the root does not answer: {error}"]
        return []

    async def _away(self, system: ActorSystem, timeout: float) -> list[str]:
        """What will be well again by itself, or by an operator."""
        blocked = system.store_problem()
        problems = [blocked] if blocked else []
        for name, path in (("the root", f"/{system.name}"), *((path, path) for path in self._watch)):
            try:
                counts = await system.ref(path, Supervisor).ask(CountChildren(), timeout)
            except HoldfastError as error:
                return [*problems, f"{name} does not answer: {error}"]
            if counts.active < counts.specs:
                problems.append(f"{counts.specs - counts.active} of {counts.specs} children of {name} do not run")
        silent, waits = await asyncio.gather(silent_at_root(system), _waits(system, timeout))
        return [*problems, *(f"the process of {path} does not answer" for path in silent), *waits]

    async def _probed(self, path: str) -> tuple[int, str] | None:
        """The answer to a probe; None: there is no such page."""
        looks = {"/livez": self.live, "/readyz": self.ready}
        if path not in looks:
            return None
        verdict = await looks[path]()
        return verdict.status, verdict.text


async def _waits(system: ActorSystem, timeout: float) -> list[str]:
    """Which supervisors have children that wait for somebody to whom they are bound, wherever in the tree they are."""
    waiting = system._node.supervised.waiting
    asked = sorted((cell for cell in waiting if not cell.is_dead), key=lambda cell: cell.path)
    waiting.clear()  # First: whoever begins to wait meanwhile is among them again.
    told = await asyncio.gather(*(_awaited(cell, timeout) for cell in asked))
    waiting.update(cell for cell, found in zip(asked, told, strict=True) if found)
    return [problem for found in told for problem in found]


async def _awaited(cell: Cell, timeout: float) -> list[str]:
    supervisor = ActorRef[Supervisor](cell)
    try:
        counts = await supervisor.ask(CountChildren(), timeout)
    except HoldfastError as error:
        return [f"{cell.path}, whose children have waited for others, does not answer: {error}"]
    awaited = sorted(counts.awaited.items())
    return [f"{count} of {counts.specs} children of {cell.path} wait for {target}" for target, count in awaited]
