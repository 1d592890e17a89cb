"""The demo itself: the same system twice over the same log, once undisturbed, once with its mapper killed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Literal, TypeAlias

from holdfast import (
    ActorSystem,
    ChildSpec,
    HoldfastError,
    Method,
    child,
    fresh,
    hybrid,
    start,
    supervisor,
)
from holdfast.errors import NoSuchActor
from holdfast.events import Recovered

from .actors import FindPath, GetMap, LogRead, Mapper, MapperState, NoWay, Planner, Reader, ReadLog, as_grid
from .desk import Desk
from .grid import USABLE_RANGE, Geometry
from .killer import Killer, schedule
from .log import Survey, survey
from .planner import Position
from .questions import EVERY, PATIENCE, Asker, Questions
from .report import DemoReport, MapperKill, MapperRecovery, RunOutcome, judge_asks
from .show import Progress, Watcher

MethodName = Literal["hybrid", "fresh"]

MAPPER, PLANNER, READER = "/demo/robot/mapper", "/demo/robot/planner", "/demo/robot/reader"
LONGEST_READING = 3600.0  # seconds
LAST_EVENTS = 2.0  # seconds to wait for the report of a recovery that is already over


@dataclass(frozen=True)
class DemoPlan:
    """What to do. `speed` is a multiple of the recording's pace, 0 for as fast as it goes; `interval` in seconds."""

    log: Path
    kills: int
    seed: int
    method: MethodName
    interval: float
    speed: float


def tree(geometry: Geometry, recovery: Method, kills: int, *, desk: bool = False) -> ChildSpec:
    """The supervision tree. Only the mapper's child spec knows that it has a process, and how it comes back.

    With a desk, which clients of a fleet ask, the planner is recorded, too: both go on with the next leader.
    """
    mapper = child("mapper", start(Mapper, geometry), isolation="process", recovery=recovery)
    planner = child("planner", start(Planner), bindings={"mapper": MAPPER}, recovery=recovery if desk else None)
    children: list[ChildSpec] = [mapper, planner, child("reader", start(Reader))]
    if desk:
        bindings = {"mapper": MAPPER, "planner": PLANNER}
        children.append(child("desk", start(Desk), bindings=bindings, recovery=recovery))
    return supervisor("robot", strategy="one_for_one", intensity=2 * kills + 3, period=10.0, children=children)


def recovery_of(plan: DemoPlan) -> Method:
    """The recovery method that the plan names."""
    match plan.method:
        case "hybrid":
            return hybrid(interval=plan.interval)
        case "fresh":
            return fresh()


@dataclass(frozen=True)
class Scene:
    """Where a run takes place: whom it asks, and whom it kills.

    Attributes:
        mapper, planner, reader: who is asked.
        pid: the process that is shown; None while there is none.
        victim: the process to be killed next; None while there is none.
        killed: told of each kill.
        machines: what else is shown, a line each.
        every: seconds from one question to the next.
    """

    mapper: Asker
    planner: Asker
    reader: Asker
    pid: Callable[[], int | None]
    victim: Callable[[], int | None]
    killed: Callable[[MapperKill], None] = lambda kill: None
    machines: Callable[[], Sequence[str]] = tuple
    every: float = EVERY


Stage: TypeAlias = Callable[[Callable[[MapperRecovery], None]], AbstractAsyncContextManager[Scene]]
"""Sets a scene, which tells of each recovery."""


@asynccontextmanager
async def one_process(
    plan: DemoPlan, found: Survey, kills: int, recovered: Callable[[MapperRecovery], None]
) -> AsyncGenerator[Scene]:
    """The system in this process; the mapper, in its own, is killed."""
    geometry = Geometry.covering(found.x_min, found.y_min, found.x_max, found.y_max)

    async def listen() -> None:
        with system.events() as events:
            async for event in events:
                if isinstance(event, Recovered) and event.address == MAPPER:
                    recovered(MapperRecovery(event.phases, event.replayed))

    def find_pid() -> int | None:
        try:
            return system.pid_of(mapper)
        except NoSuchActor:
            return None

    # Its log would run through the display, which shows the same events.
    async with ActorSystem("demo", log=False) as system:
        listening = asyncio.create_task(listen())
        try:
            await system.start(tree(geometry, recovery_of(plan), kills))
            mapper = system.ref(MAPPER, Mapper)
            yield Scene(mapper, system.ref(PLANNER, Planner), system.ref(READER, Reader), find_pid, find_pid)
        finally:
            await _cancel(listening)


def begin(plan: DemoPlan, watcher: Watcher) -> Survey:
    """Read through the log.

    Raises:
        LogError: there is not one scan in the log.
    """
    found = survey(plan.log)
    if found.problem is not None:
        watcher.notice(f"{found.problem}; the {found.scans:,} scans before are used")
    return found


async def undisturbed(plan: DemoPlan, found: Survey, watcher: Watcher) -> RunOutcome:
    """The run that others are compared with."""
    stage = partial(one_process, plan, found, 0)
    return await DemoRun(plan, found, watcher, "undisturbed", stage, kills=0).drive()


async def compare(plan: DemoPlan, watcher: Watcher) -> DemoReport:
    """Run both, and report.

    Raises:
        LogError: there is not one scan in the log.
    """
    began = monotonic()
    found = begin(plan, watcher)
    before = await undisturbed(plan, found, watcher)
    name, stage = f"{plan.method}, {plan.kills} kills", partial(one_process, plan, found, plan.kills)
    disturbed = await DemoRun(plan, found, watcher, name, stage, kills=plan.kills).drive()
    return DemoReport(before, disturbed, plan.method, monotonic() - began)


class DemoRun:
    """One run from its start to its end: the log is read, questions are asked, and who is to be killed is killed.

    Args:
        plan: what to do.
        found: in the log.
        watcher: told how it goes.
        name: what it is called.
        stage: sets its scene.
        kills: how many there are.
    """

    def __init__(self, plan: DemoPlan, found: Survey, watcher: Watcher, name: str, stage: Stage, *, kills: int) -> None:
        self._plan, self._found, self._watcher, self._name, self._stage = plan, found, watcher, name, stage
        self._moments = schedule(kills, found.scans, plan.seed)
        self._recoveries: list[MapperRecovery] = []
        self._heard = asyncio.Event()

    async def drive(self) -> RunOutcome:
        """Set the scene, let the log run through it, and clear it away."""
        self._watcher.begin(self._name, self._found.scans)
        async with self._stage(self._recovered) as scene:
            return await self._inside(scene)

    def _recovered(self, recovery: MapperRecovery) -> None:
        self._recoveries.append(recovery)
        self._heard.set()
        self._watcher.recovered(recovery)

    async def _inside(self, scene: Scene) -> RunOutcome:
        began = monotonic()

        def learn() -> None:
            killer.saw(questions.last_scan)
            self._watcher.progress(self._progress(questions, scene))

        def killed(kill: MapperKill) -> None:
            scene.killed(kill)
            self._watcher.killed(kill)

        killer = Killer(self._moments, scene.victim, killed)
        questions = Questions(scene.mapper, scene.planner, self._found, self._plan.seed, learn, scene.every)
        asking = asyncio.create_task(questions.keep_asking())
        try:
            read = await self._read(scene.reader, questions, killer)
        finally:
            await _cancel(asking)
        await questions.drain()
        path = await self._path(scene.planner, questions)
        state = await scene.mapper.ask(GetMap(), timeout=PATIENCE)
        seconds = monotonic() - began
        await self._hear_the_last(killer)
        return self._outcome(state, questions, killer.kills, read, path, seconds)

    async def _read(self, reader: Asker, questions: Questions, killer: Killer) -> LogRead:
        """Let the log be read, and all kills be done, while the questions go on."""
        read = await reader.ask(ReadLog(str(self._plan.log), self._plan.speed), timeout=LONGEST_READING)
        await questions.ask_one()  # It queues behind the last scan.
        # A mapper without recovery may have lost that answer, or the very scan after which it was to be killed again.
        killer.saw(self._found.scans)
        with suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE):
                await killer.finish()
        return read

    async def _path(self, planner: Asker, questions: Questions) -> list[Position]:
        found = self._found
        low = found.x_min - USABLE_RANGE, found.y_min - USABLE_RANGE
        high = found.x_max + USABLE_RANGE, found.y_max + USABLE_RANGE
        serial = questions.next_serial()
        try:
            path = await planner.ask(FindPath(serial, found.start, found.farthest, low, high), timeout=PATIENCE)
        except NoWay:
            path = []
        except HoldfastError as error:
            questions.note_failure(serial, error)
            return []
        questions.note_answer(serial)
        return path

    def _progress(self, questions: Questions, scene: Scene) -> Progress:
        return Progress(
            run=self._name,
            scans=questions.last_scan,
            total=self._found.scans,
            sent=questions.sent,
            answered=len(questions.answers),
            waiting=questions.waiting,
            pid=scene.pid(),
            machines=scene.machines(),
        )

    async def _hear_the_last(self, killer: Killer) -> None:
        """Events come a little after the fact."""
        if self._plan.method == "fresh":
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(LAST_EVENTS):
                while len(self._recoveries) < len(killer.kills):
                    self._heard.clear()
                    await self._heard.wait()

    def _outcome(
        self,
        state: MapperState,
        questions: Questions,
        kills: list[MapperKill],
        read: LogRead,
        path: list[Position],
        seconds: float,
    ) -> RunOutcome:
        return RunOutcome(
            grid=as_grid(state.whole),
            scans=state.scans,
            gaps=state.gaps,
            asks=judge_asks(questions.sent, questions.answers, state.questions),
            seconds=seconds,
            kills=kills,
            recoveries=self._recoveries,
            failures=questions.failures,
            path=path,
            problem=read.problem,
            cut_off=read.cut_off,
        )


async def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
