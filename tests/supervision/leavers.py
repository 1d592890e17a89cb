"""An actor that raises, where it is told to, what would end the whole program."""

from __future__ import annotations

import asyncio
from typing import Any

import holdfast as hf

LEAVING = {kind.__name__: kind for kind in (KeyboardInterrupt, SystemExit, GeneratorExit, asyncio.CancelledError)}
PHASES = (
    *("__init__", "on_start", "on_start later", "turn", "turn later", "def turn", "on_stop"),
    *("task", "pipe", "ended task", "ended pipe"),
)


class Go(hf.Message[str]):
    """Raise, if that is the phase for it."""


class GoNow(hf.Message[str]):
    """The same in a plain `def` handler."""


class Gone(hf.Message): ...


class Leaver(hf.Actor):
    """Raises in one phase, of its first life or of every one."""

    def __init__(self, phase: str, error: str) -> None:
        self.phase, self.error = phase, error
        self.leave("__init__")

    def leave(self, phase: str) -> None:
        if self.phase == phase:
            raise LEAVING[self.error]("it leaves")

    async def leave_later(self, phase: str) -> None:
        if self.phase == phase:
            await asyncio.sleep(0.001)
            self.leave(phase)

    async def leave_when_cancelled(self, phase: str) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            self.leave(phase)

    async def on_start(self, restored: bool) -> None:
        self.leave("on_start")
        await self.leave_later("on_start later")

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        self.leave("turn")
        await self.leave_later("turn later")
        if self.phase == "task":
            self.ctx.create_task(self.leave_later("task"))
        if self.phase == "pipe":
            self.ctx.pipe_to_self(self.leave_later("pipe"), lambda _: Gone())
        if self.phase == "ended task":
            self.ctx.create_task(self.leave_when_cancelled("ended task"))
        if self.phase == "ended pipe":
            self.ctx.pipe_to_self(self.leave_when_cancelled("ended pipe"), lambda _: Gone())
        return "still here"

    @hf.on(GoNow)
    def go_now(self, message: GoNow) -> str:
        self.leave("def turn")
        return "still here"

    @hf.on(Gone)
    def gone(self, message: Gone) -> None: ...

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.leave("on_stop")

    def get_state(self) -> Any:
        return []

    def set_state(self, state: Any) -> None: ...
