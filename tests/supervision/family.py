"""Children that do as they are told, and tell what becomes of them; for tests of supervision."""

from __future__ import annotations

import asyncio
from typing import Any

import holdfast as hf


class Boom(hf.Message): ...


class Leave(hf.Message):
    reason: hf.ExitReason | None = None

    @property
    def why(self) -> hf.ExitReason:
        """NORMAL, if nothing is said."""
        return self.reason or hf.NORMAL


class Life(hf.Message[int]): ...


class Plan:
    """What happens in each child's start, by its name: "fail", "ignore", or seconds that it takes. Kept by the test.

    The log tells starts as `+a`, starts that fail as `!a`, ignored ones as `?a`, and stops in good order as `-a`.
    """

    def __init__(self) -> None:
        self.log: list[str] = []
        self.todo: dict[str, list[str | float]] = {}

    def next(self, name: str) -> str | float:
        steps = self.todo.get(name)
        return steps.pop(0) if steps else 0.0

    def take(self) -> str:
        told, self.log[:] = " ".join(self.log), []
        return told


class Kid(hf.Actor):
    """Starts as the plan says, in `__init__` or, if `late`, in `on_start`."""

    def __init__(self, plan: Plan, late: bool = False) -> None:
        self.name = self.ctx.path.rpartition("/")[2]
        self.plan, self.late = plan, late
        if not late:
            step = plan.next(self.name)
            assert not isinstance(step, float) or not step, "only a late one can take time"
            self._begin(step)

    async def on_start(self, restored: bool) -> None:
        if self.late:
            step = self.plan.next(self.name)
            if isinstance(step, float):
                await asyncio.sleep(step)
            self._begin(step)

    def _begin(self, step: str | float) -> None:
        if step == "fail":
            self.plan.log.append(f"!{self.name}")
            raise OSError("not there yet")
        if step == "ignore":
            self.plan.log.append(f"?{self.name}")
            raise hf.Ignore("not needed here")
        self.plan.log.append(f"+{self.name}")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.plan.log.append(f"-{self.name}")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop(message.why)

    @hf.on(Life)
    def life(self, message: Life) -> int:
        return self.ctx.life


def kid(plan: Plan, id: str | None, *, late: bool = False, **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Kid, plan, late), **options)


class Family:
    """A supervisor `/app/top` with children named by letters."""

    def __init__(self, system: hf.ActorSystem, plan: Plan) -> None:
        self.system, self.plan = system, plan

    @classmethod
    async def start(cls, system: hf.ActorSystem, plan: Plan, *children: hf.ChildSpec, **options: Any) -> Family:
        options = {"intensity": 9, **options}
        await system.start(hf.supervisor("top", children=children, **options))
        plan.take()
        return cls(system, plan)

    @property
    def top(self) -> hf.ActorRef[hf.Supervisor]:
        return self.system.ref("/app/top", hf.Supervisor)

    def ref(self, name: str) -> hf.ActorRef[Kid]:
        return self.system.ref(f"/app/top/{name}", Kid)

    async def rest(self) -> str:
        """Until nothing happens any more; what was started and stopped meanwhile."""
        for _ in range(10):
            await self.system._node.settled()
        return self.plan.take()

    async def after(self, name: str, message: hf.Message[Any]) -> str:
        """What was started and stopped because of a message to one child."""
        self.ref(name).tell(message)
        return await self.rest()

    async def states(self) -> dict[str, str]:
        return {info.id: info.state for info in await self.top.ask(hf.WhichChildren())}

    @property
    def is_alive(self) -> bool:
        return "/app/top" in self.system.tree()


async def refused(call: Any) -> hf.HoldfastError:
    """The error that an ask ends with."""
    try:
        reply = await call
    except hf.HoldfastError as error:
        return error
    raise AssertionError(f"it was answered: {reply!r}")
