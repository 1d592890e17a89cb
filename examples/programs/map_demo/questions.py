"""The task that keeps asking, and what it learns from the answers: open loop, one serial number a question."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import Protocol, TypeVar

from holdfast import HoldfastError, Message

from .actors import IsWayFree, LookAt, Seen, WayAnswer
from .log import Survey

PATIENCE = 60.0  # seconds; a question outlives any recovery
EVERY = 0.005  # seconds from one question to the next
PLANNER_SHARE = 10  # every tenth question goes through the planner
FAILURES_KEPT = 5
R = TypeVar("R")
WAY = 8.0  # metres: how far apart the ends of a way are at most


class Asker(Protocol):
    """Something that can be asked: a ref, or the way to whoever leads a fleet."""

    def ask(self, message: Message[R], timeout: float) -> Awaitable[R]:
        """Ask it; `timeout` is in seconds."""
        ...


class Questions:
    """Asks mapper and planner about random places until told to stop; each question is waited for by a task."""

    def __init__(
        self,
        mapper: Asker,
        planner: Asker,
        survey: Survey,
        seed: int,
        learn: Callable[[], None],
        every: float = EVERY,
    ) -> None:
        self.sent = 0
        self.answers: dict[int, int] = {}
        self.failures: list[str] = []
        self.last_scan = 0
        self._mapper, self._planner, self._survey, self._learn = mapper, planner, survey, learn
        self._random = random.Random(seed)
        self._every = every
        self._waiting: set[asyncio.Task[None]] = set()

    @property
    def waiting(self) -> int:
        """Questions sent and not yet answered."""
        return len(self._waiting)

    async def keep_asking(self) -> None:
        """Ask at a steady rate, whether answers come or not, until cancelled."""
        while True:
            self.ask_one()
            await asyncio.sleep(self._every)

    def ask_one(self) -> asyncio.Task[None]:
        """Send the next question; the task ends with its answer, or with its failure."""
        serial = self.next_serial()
        if serial % PLANNER_SHARE:
            seen = self._mapper.ask(LookAt(serial, self._place()), timeout=PATIENCE)
            return self._await(serial, seen)
        start = self._place()
        goal = start[0] + self._random.uniform(-WAY, WAY), start[1] + self._random.uniform(-WAY, WAY)
        judged = self._planner.ask(IsWayFree(serial, start, goal), timeout=PATIENCE)
        return self._await(serial, judged)

    def next_serial(self) -> int:
        """The serial number of a question that is about to be sent; it counts as sent."""
        self.sent += 1
        return self.sent

    def note_answer(self, serial: int) -> None:
        """Count an answer, by the serial number of its question."""
        self.answers[serial] = self.answers.get(serial, 0) + 1

    def note_failure(self, serial: int, error: HoldfastError) -> None:
        """Keep the first failures: one is enough to see what went wrong."""
        if len(self.failures) < FAILURES_KEPT:
            self.failures.append(f"question {serial}: {type(error).__name__}: {error}")

    async def drain(self) -> None:
        """Wait until no question is open."""
        while self._waiting:
            await asyncio.wait(self._waiting)

    def _place(self) -> tuple[float, float]:
        here = self._survey
        return self._random.uniform(here.x_min, here.x_max), self._random.uniform(here.y_min, here.y_max)

    def _await(self, serial: int, answer: Awaitable[Seen | WayAnswer]) -> asyncio.Task[None]:
        task = asyncio.create_task(self._receive(serial, answer))
        self._waiting.add(task)
        task.add_done_callback(self._waiting.discard)
        return task

    async def _receive(self, serial: int, answer: Awaitable[Seen | WayAnswer]) -> None:
        try:
            received = await answer
        except HoldfastError as error:
            self.note_failure(serial, error)
            return
        # An answer counts for the question it names: one that went to the wrong asker shows as one lost, one doubled.
        self.note_answer(received.serial)
        self.last_scan = max(self.last_scan, received.last_scan)
        self._learn()
