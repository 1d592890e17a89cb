"""The recoveries of a root and their progress, kept with the homes so that they outlive the controller.

Nothing here waits. The controller does what a recovery asks for; while it is down, the recovery does without.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from ...actors.events import HeldMessages, RecoveryHookFailed, RecoveryPhase, SafeStateKept
from ..recovery_settings import Hook, RecoveryHooks, RecoveryStep
from .safe_states import Safety

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from ..group_commit import Commits
    from ..method import Method

Point = tuple[str, str]
"""A point of a recovery: hooks are called ("before", "isolate"), or something is done ("do", "enter")."""

ENTER, LEAVE = ("do", "enter"), ("do", "leave")
STAGES: dict[str, tuple[Point, ...]] = {
    "restart": (
        ("before", "safe_state"),
        ENTER,
        ("after", "safe_state"),
        ("before", "isolate"),
        ("after", "isolate"),
        ("before", "restart"),
        ("before", "restore"),
    ),
    "replay": (("after", "restart"), ("after", "restore"), ("before", "replay")),
    "release": (("after", "replay"), ("before", "release")),
    "over": (LEAVE, ("after", "release")),
}
"""What has to have happened, in order, before a life is begun, replayed to, and released; and when it has been."""

PATIENCE = 1.0
"""Seconds a recovery waits for the controller, besides the time its hooks may take."""
MOST = 1000
"""Events that are kept until the controller or the message switch tells of them."""


class Recovery:
    """One recovery, from the notice of a crash to the release; a crash in it begins its next attempt."""

    def __init__(self, number: int, path: str, method: Method, noticed: float) -> None:
        self.number, self.path, self.method, self.noticed = number, path, method, noticed
        self.attempt = 1
        self.has_crashed = False  # else it is only started with what it had
        self.is_safe = False  # its receivers have been told in this attempt
        self.is_isolated = False  # a life of this attempt was to begin
        self.since = noticed  # when the phase at hand has begun
        self.stages: dict[str, bool] = {}  # of this attempt that were asked for: whether they are passed
        self.waits: dict[str, asyncio.Future[None]] = {}
        self.called: set[tuple[Point, int]] = set()  # hooks of this attempt
        self.failure = ""

    def step(self, point: Point) -> RecoveryStep:
        """What a hook is told."""
        return RecoveryStep(self.path, *point, self.attempt, max(0.0, time.monotonic() - self.noticed))


class Recoveries:
    """All recoveries of a root."""

    def __init__(self, node: Node, journal: Commits, hooks: RecoveryHooks | None = None) -> None:
        self._node = node
        self._by_path: dict[str, Recovery] = {}
        self.safety = Safety(node, journal, self._by_path.__contains__)
        self.hooks = hooks  # those of the system
        self._count = 0
        self._untold: deque[RecoveryPhase] = deque(maxlen=MOST)
        self._timers: set[asyncio.TimerHandle] = set()
        self._controller: Callable[[str], None] | None = None  # None: it is down
        self.held: deque[HeldMessages] = deque(maxlen=MOST)  # nobody has told of them yet
        self.on_held: Callable[[], None] | None = None

    def of(self, path: str) -> Recovery | None:
        """The recovery of an address that is not over."""
        return self._by_path.get(path)

    def all(self) -> list[Recovery]:
        """Those that are not over."""
        return list(self._by_path.values())

    # -- what hosts tell --------------------------------------------------------------------------------------------

    def crashed(self, path: str, method: Method, noticed: float | None) -> None:
        """The life at an address that is brought back has ended abnormally."""
        recovery = self._by_path.get(path)
        if recovery is not None and "over" in recovery.stages:
            self._finish(recovery)
            recovery = None
        if recovery is None:
            recovery = self._begin(path, method, noticed)
        else:
            self._next_attempt(recovery)
        recovery.has_crashed, recovery.method = True, method
        self.phase(recovery, "detect", time.monotonic())
        if self.needs(recovery, "restart"):
            self._ask(recovery, "restart")

    def starts(self, path: str, method: Method) -> Recovery:
        """A life is to begin with what the last one has left."""
        recovery = self._by_path.get(path)
        if recovery is not None and "over" in recovery.stages:
            self._finish(recovery)
            recovery = None
        recovery = recovery or self._begin(path, method, None)
        if recovery.is_isolated:
            self._next_attempt(recovery)
        recovery.method, recovery.is_isolated, recovery.failure = method, True, ""
        return recovery

    def _begin(self, path: str, method: Method, noticed: float | None) -> Recovery:
        self._count += 1
        when = time.monotonic() if noticed is None else noticed
        recovery = self._by_path[path] = Recovery(self._count, path, method, when)
        return recovery

    def _next_attempt(self, recovery: Recovery) -> None:
        recovery.attempt += 1
        recovery.is_safe = recovery.is_isolated = False
        recovery.stages.clear()
        recovery.called.clear()
        waits, recovery.waits = recovery.waits, {}
        for wait in waits.values():
            _open(wait)

    def phase(self, recovery: Recovery, phase: str, when: float) -> None:
        """A phase is over, the next one begins: the controller tells of it."""
        since, recovery.since = recovery.since, max(recovery.since, when)
        if self._node.events.hears_unkept:
            spent, total = recovery.since - since, max(0.0, recovery.since - recovery.noticed)
            self._untold.append(RecoveryPhase(recovery.path, recovery.number, recovery.attempt, phase, total, spent))
            if len(self._untold) == 1 and self._controller is not None:
                self._controller("")

    def came_up(self, recovery: Recovery, restarted: float, live_at: float, restore_seconds: float) -> None:
        """The life has caught up: these were its phases."""
        self.phase(recovery, "restart", restarted - restore_seconds)
        self.phase(recovery, "restore", restarted)
        self.phase(recovery, "replay", live_at)

    def over(self, path: str) -> None:
        """End the recovery of an actor, which is back."""
        recovery = self._by_path.get(path)
        if recovery is None or "over" in recovery.stages:
            return
        self.phase(recovery, "release", time.monotonic())
        if self.needs(recovery, "over") or self.safety.holds(path):
            self._ask(recovery, "over")
        else:  # As it mostly is, and for the whole of a tree at once when a program begins again.
            self._finish(recovery)

    def given_up(self, path: str, why: str) -> None:
        """Nobody lives there any more: who was safe because of it stays so (T17), until it is back."""
        recovery = self._by_path.get(path)
        if recovery is None:
            return
        if "over" in recovery.stages:
            self._finish(recovery)
            return
        self.enter_safe_state(recovery)
        self._next_attempt(recovery)
        receivers = self.safety.holds(path)
        if not receivers:
            del self._by_path[path]
        elif not recovery.failure:
            recovery.failure = why
            self._node.emit(SafeStateKept(path, receivers, why))

    # -- stages -----------------------------------------------------------------------------------------------------

    def is_gated(self, recovery: Recovery) -> bool:
        """Whether it has to wait for anything at all before it is over."""
        return any(self.needs(recovery, stage) for stage in ("restart", "replay", "release"))

    def gate(self, recovery: Recovery, stage: str) -> asyncio.Future[None] | None:
        """What a recovery waits for before it goes on; None: nothing."""
        if not self.needs(recovery, stage):
            return None
        if stage not in recovery.stages:
            self._ask(recovery, stage)
        if recovery.stages[stage]:
            return None
        wait = recovery.waits.get(stage)
        if wait is None:
            wait = recovery.waits[stage] = self._node.loop.create_future()
            attempt = recovery.attempt
            longest = PATIENCE + sum(
                hooks.timeout for point in STAGES[stage] for hooks, _ in self.hooks_at(recovery, point)
            )
            self._later(longest, lambda: self._too_late(recovery, attempt, stage))
        return wait

    def needs(self, recovery: Recovery, stage: str) -> bool:
        """Whether there is anything to do at a stage."""
        if stage == "restart" and recovery.has_crashed and recovery.method.meanwhile.safe_state is not None:
            return True
        if self.hooks is None and recovery.method.meanwhile.hooks is None:
            return False
        return any(self.hooks_at(recovery, point) for point in STAGES[stage])

    def hooks_at(self, recovery: Recovery, point: Point) -> list[tuple[RecoveryHooks, Hook]]:
        """The hooks of one point: the system's, then the child's own."""
        found = (
            (hooks, hooks.of(*point)) for hooks in (self.hooks, recovery.method.meanwhile.hooks) if hooks is not None
        )
        return [(hooks, hook) for hooks, hook in found if hook is not None]

    def _ask(self, recovery: Recovery, stage: str) -> None:
        """Have the controller see to a stage; without one it is done here, but for its hooks."""
        recovery.stages[stage] = False
        if self._controller is None:
            self._alone(recovery, stage)
        else:
            self._controller(recovery.path)

    def _alone(self, recovery: Recovery, stage: str) -> None:
        """A stage without the controller: all but the hooks."""
        for point in STAGES[stage]:
            if point == ENTER:
                self.enter_safe_state(recovery)
            for index, _ in enumerate(self.hooks_at(recovery, point)):
                if (point, index) not in recovery.called:
                    recovery.called.add((point, index))
                    self.hook_failed(recovery, point, "it was not called: the recovery controller is down, or too late")
        self.passed(recovery, stage)

    def _too_late(self, recovery: Recovery, attempt: int, stage: str) -> None:
        if self.is_current(recovery, attempt, stage):
            self._alone(recovery, stage)

    def _later(self, delay: float, then: Callable[[], None]) -> None:
        def due() -> None:
            self._timers.discard(timer)
            then()

        timer = self._node.loop.call_later(delay, due)
        self._timers.add(timer)

    # -- what the controller does -----------------------------------------------------------------------------------

    def attach(self, wake: Callable[[str], None]) -> None:
        """The controller is up: it is woken with the address of a recovery, or "" when there are events to tell."""
        self._controller = wake

    def detach(self, wake: Callable[[str], None]) -> None:
        """It is not any more: what it had in hand goes on without it."""
        if self._controller is not wake:
            return
        self._controller = None
        for recovery in self.all():
            for stage, is_passed in list(recovery.stages.items()):
                if not is_passed:
                    self._alone(recovery, stage)

    def is_current(self, recovery: Recovery, attempt: int, stage: str) -> bool:
        """Whether a recovery still waits for this stage."""
        here = self._by_path.get(recovery.path) is recovery and recovery.attempt == attempt
        return here and recovery.stages.get(stage) is False

    def enter_safe_state(self, recovery: Recovery) -> None:
        """S1, once in an attempt. Only a crash is a reason for it."""
        state = recovery.method.meanwhile.safe_state
        if state is not None and recovery.has_crashed and not recovery.is_safe:
            recovery.is_safe = True
            self.safety.enter(recovery.path, state, recovery.method.meanwhile.safe_state_timeout)
            self.phase(recovery, "safe_state", time.monotonic())

    def calls(self, recovery: Recovery, point: Point, index: int) -> bool:
        """Whether a hook is to be called now: each once in an attempt."""
        if (point, index) in recovery.called:
            return False
        recovery.called.add((point, index))
        return True

    def hook_failed(self, recovery: Recovery, point: Point, why: str) -> None:
        """A hook did not do its work; the recovery goes on."""
        self._node.emit(RecoveryHookFailed(recovery.path, " ".join(point), why))

    def passed(self, recovery: Recovery, stage: str) -> None:
        """A stage is done: the recovery goes on."""
        recovery.stages[stage] = True
        _open(recovery.waits.pop(stage, None))
        if stage == "over":
            self._finish(recovery)

    def _finish(self, recovery: Recovery) -> None:
        """Nothing is left to do for it: who was safe because of it need not be any more."""
        if self._by_path.get(recovery.path) is recovery:
            del self._by_path[recovery.path]
            self.safety.leave(recovery.path)

    def tell(self) -> None:
        """Put the phases that are over on the stream."""
        while self._untold:
            self._node.emit(self._untold.popleft())

    def close(self) -> None:
        """Wait for nothing any more: the system ends."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self.safety.close()


def _open(wait: asyncio.Future[None] | None) -> None:
    if wait is not None and not wait.done():
        wait.set_result(None)
