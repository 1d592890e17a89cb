"""The recovery controller as an actor: it sees each recovery through its phases (RORY, S1 to S4)."""

from __future__ import annotations

import asyncio
import inspect
from typing import Any

from ...actors.errors import error_text, type_name
from ...actors.kernel.actor import on
from ...actors.kernel.message import Message
from ..recovery_settings import Hook
from .part import RecoveryPart
from .recoveries import ENTER, LEAVE, STAGES, Point, Recovery


class LookAtRecovery(Message):
    """Something has come up: in the recovery of `address`, or ("") there are phases to tell of."""

    address: str


class StagesSeen(Message):
    """The stages of one recovery that were asked for are done."""


class RecoveryController(RecoveryPart):
    """Has receivers enter and leave safe state, calls hooks, tells of phases.

    What it does is noted with the homes before it is done. If it dies, they go on without it, and without the hooks
    that it did not come to; its next life takes up what is there.
    """

    def on_start(self, restored: bool) -> None:
        recoveries, cell = self._homes.recoveries, self.ctx._cell

        def wake(path: str) -> None:
            cell.admit(cell, LookAtRecovery(path))

        self._in_hand: set[tuple[int, int, str]] = set()
        recoveries.attach(wake)
        cell.ended().add_done_callback(lambda _: recoveries.detach(wake))
        for recovery in recoveries.all():
            self._see_to(recovery)
        recoveries.tell()

    @on(LookAtRecovery)
    def _look(self, message: LookAtRecovery) -> None:
        recovery = self._homes.recoveries.of(message.address)
        if recovery is not None:
            self._see_to(recovery)
        self._homes.recoveries.tell()

    @on(StagesSeen)
    def _seen(self, message: StagesSeen) -> None:
        self._homes.recoveries.tell()

    # -- stages -----------------------------------------------------------------------------------------------------

    def _see_to(self, recovery: Recovery) -> None:
        """Begin with what the recovery waits for."""
        for stage, is_passed in list(recovery.stages.items()):
            key = (recovery.number, recovery.attempt, stage)
            if is_passed or key in self._in_hand:
                continue
            if any(self._homes.recoveries.hooks_at(recovery, point) for point in STAGES[stage]):
                self._in_hand.add(key)
                self.ctx.pipe_to_self(self._go_through(recovery, stage), lambda _: StagesSeen())
            else:
                for point in STAGES[stage]:
                    self._do(recovery, point)
                self._homes.recoveries.passed(recovery, stage)

    async def _go_through(self, recovery: Recovery, stage: str) -> None:
        recoveries, attempt = self._homes.recoveries, recovery.attempt
        for point in STAGES[stage]:
            if not recoveries.is_current(recovery, attempt, stage):
                break  # It has crashed again, or had to go on without us.
            self._do(recovery, point)
            for index, (hooks, hook) in enumerate(recoveries.hooks_at(recovery, point)):
                if recoveries.calls(recovery, point, index):
                    await self._call(recovery, point, hook, hooks.timeout)
        self._in_hand.discard((recovery.number, attempt, stage))
        if recoveries.is_current(recovery, attempt, stage):
            recoveries.passed(recovery, stage)

    def _do(self, recovery: Recovery, point: Point) -> None:
        recoveries = self._homes.recoveries
        if point == ENTER:
            recoveries.enter_safe_state(recovery)
        elif point == LEAVE:
            recoveries.safety.leave(recovery.path)

    async def _call(self, recovery: Recovery, point: Point, hook: Hook, timeout: float) -> None:
        """Call a hook; whatever it does, the recovery goes on."""
        recoveries = self._homes.recoveries
        try:
            async with asyncio.timeout(timeout):
                result: Any = hook(recovery.step(point))
                if inspect.isawaitable(result):
                    await result
        except TimeoutError:
            recoveries.hook_failed(recovery, point, f"it took longer than {timeout:g} s")
        except asyncio.CancelledError:
            recoveries.hook_failed(recovery, point, "it was cut off: the recovery controller has ended")
            raise
        except Exception as error:
            recoveries.hook_failed(recovery, point, f"{type_name(type(error))}: {error_text(error)}")
