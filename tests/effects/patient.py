"""An actor whose turns wait, for moments and for messages, and the order in which things happen to it."""

from __future__ import annotations

from typing import Any

import holdfast as hf
from tests.effects.clerk import IN_TIME, note

__all__ = ["IN_TIME", "Call", "Count", "Go", "Look", "Patient", "patient"]


class Go(hf.Message[str]):
    """Wait, step by step: "s0.5" for seconds, "u9" until then, "c" for a Call, "c0.1" with a limit; "e": an effect."""

    steps: list[str]
    file: str = ""


class Call(hf.Message):
    word: str = ""


class Never(hf.Message): ...


class Count(hf.Message[int]): ...


class Look(hf.Message[list[str]]): ...


class Patient(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[str] = []
        self.count = 0

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        said: list[str] = []
        for step in message.steps:
            begin = self.ctx.now()
            if step.startswith("s"):
                await self.ctx.sleep(float(step[1:]))
                assert self.ctx.now() >= begin + float(step[1:])
                said.append("slept")
            elif step.startswith("u"):
                await self.ctx.sleep_until(float(step[1:]))
                said.append("slept")
            elif step == "e":
                said.append(f"effect {await self.ctx.effect(note, message.file, self.ctx.message_id)}")
            else:
                try:
                    call = await self.ctx.wait_for(Call, Never, timeout=float(step[1:]) if step[1:] else None)
                    said.append(f"call {call.word}" if isinstance(call, Call) else "never")
                except hf.errors.WaitTimeout as error:
                    said.append(str(error))
                    assert self.ctx.now() >= begin + float(step[1:])
        self.seen.append(", ".join(said))
        return self.seen[-1]

    @hf.on(Call)
    def call(self, message: Call) -> None:
        self.seen.append(f"no turn has waited for {message.word}")

    @hf.on(Never)
    def never(self, message: Never) -> None: ...

    @hf.on(Count)
    def one_more(self, message: Count) -> int:
        self.count += 1
        return self.count

    @hf.on(Look)
    def look(self, message: Look) -> list[str]:
        return self.seen


def patient(isolation: Any = "task", **options: Any) -> hf.ChildSpec[Patient]:
    method = options.pop("recovery", hf.hybrid(interval=1000.0))
    return hf.child("patient", hf.start(Patient), isolation=isolation, recovery=method, **options)
