"""The demo itself: the same system twice over the same log, once undisturbed, once with its mapper killed."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Literal

from holdfast import (
    ActorRef,
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
from .grid import USABLE_RANGE, Geometry
from .killer import Killer, schedule
from .log import Survey, survey
from .planner import Position
from .questions import PATIENCE, Questions
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


def tree(geometry: Geometry, recovery: Method, kills: int) -> ChildSpec:
    """The supervision tree. Only the mapper's child spec knows that it has a process, and how it comes back."""
    mapper = child("mapper", start(Mapper, geometry), isolation="process", recovery=recovery)
    planner = child("planner", start(Planner), bindings={"mapper": MAPPER})
    reader = child("reader", start(Reader))
    return supervisor(
        "robot", strategy="one_for_one", intensity=2 * kills + 3, period=10.0, children=[mapper, planner, reader]
    )


def recovery_of(plan: DemoPlan) -> Method:
    """The recovery method that the plan names."""
    match plan.method:
        case "hybrid":
            return hybrid(interval=plan.interval)
        case "fresh":
            return fresh()


async def compare(plan: DemoPlan, watcher: Watcher) -> DemoReport:
    """Run both, and report.

    Raises:
        LogError: there is not one scan in the log.
    """
    began = monotonic()
    found = survey(plan.log)
    if found.problem is not None:
        watcher.notice(f"{found.problem}; the {found.scans:,} scans before are used")
    undisturbed = await DemoRun(plan, found, watcher, "undisturbed", kills=0).drive()
    disturbed = await DemoRun(plan, found, watcher, f"{plan.method}, {plan.kills} kills", kills=plan.kills).drive()
    return DemoReport(undisturbed, disturbed, plan.method, monotonic() - began)


class DemoRun:
    """One system from its start to its end: it reads the log, asks, kills, and collects what it holds at the end."""

    def __init__(self, plan: DemoPlan, found: Survey, watcher: Watcher, name: str, *, kills: int) -> None:
        self._plan, self._found, self._watcher, self._name = plan, found, watcher, name
        self._moments = schedule(kills, found.scans, plan.seed)
        self._recoveries: list[MapperRecovery] = []
        self._heard = asyncio.Event()

    async def drive(self) -> RunOutcome:
        """Start the system, let the log run through it, stop it."""
        self._watcher.begin(self._name, self._found.scans)
        found = self._found
        geometry = Geometry.covering(found.x_min, found.y_min, found.x_max, found.y_max)
        # Its log would run through the display, which shows the same events.
        async with ActorSystem("demo", log=False) as system:
            events = asyncio.create_task(self._listen(system))
            try:
                await system.start(tree(geometry, recovery_of(self._plan), len(self._moments)))
                return await self._inside(system)
            finally:
                await _cancel(events)

    async def _inside(self, system: ActorSystem) -> RunOutcome:
        mapper = system.ref(MAPPER, Mapper)
        planner = system.ref(PLANNER, Planner)
        began = monotonic()

        def find_pid() -> int | None:
            try:
                return system.pid_of(mapper)
            except NoSuchActor:
                return None

        def learn() -> None:
            killer.saw(questions.last_scan)
            self._watcher.progress(self._progress(questions, find_pid()))

        killer = Killer(self._moments, find_pid, self._watcher.killed)
        questions = Questions(mapper, planner, self._found, self._plan.seed, learn)
        asking = asyncio.create_task(questions.keep_asking())
        try:
            read = await self._read(system.ref(READER, Reader), questions, killer)
        finally:
            await _cancel(asking)
        await questions.drain()
        path = await self._path(planner, questions)
        state = await mapper.ask(GetMap(), timeout=PATIENCE)
        seconds = monotonic() - began
        await self._hear_the_last(killer)
        return self._outcome(state, questions, killer.kills, read, path, seconds)

    async def _read(self, reader: ActorRef[Reader], questions: Questions, killer: Killer) -> LogRead:
        """Let the log be read, and all kills be done, while the questions go on."""
        read = await reader.ask(ReadLog(str(self._plan.log), self._plan.speed), timeout=LONGEST_READING)
        await questions.ask_one()  # It queues behind the last scan.
        # A mapper without recovery may have lost that answer, or the very scan after which it was to be killed again.
        killer.saw(self._found.scans)
        with suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE):
                await killer.finish()
        return read

    async def _path(self, planner: ActorRef[Planner], questions: Questions) -> list[Position]:
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

    def _progress(self, questions: Questions, pid: int | None) -> Progress:
        return Progress(
            run=self._name,
            scans=questions.last_scan,
            total=self._found.scans,
            sent=questions.sent,
            answered=len(questions.answers),
            waiting=questions.waiting,
            pid=pid,
        )

    async def _listen(self, system: ActorSystem) -> None:
        with system.events() as events:
            async for event in events:
                if isinstance(event, Recovered) and event.address == MAPPER:
                    recovery = MapperRecovery(event.phases, event.replayed)
                    self._recoveries.append(recovery)
                    self._heard.set()
                    self._watcher.recovered(recovery)

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
