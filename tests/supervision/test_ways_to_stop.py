"""The table of docs/supervision-calls.md: who starts a child again that was stopped, and by which call."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.family import Family, Life, Plan, kid

IN_TIME = 20.0


async def ref_stop(system: hf.ActorSystem, family: Family) -> None:
    family.ref("a").stop()


async def terminate(system: hf.ActorSystem, family: Family) -> None:
    await system.terminate(family.ref("a"))


async def terminate_child(system: hf.ActorSystem, family: Family) -> None:
    await family.top.ask(hf.TerminateChild("a"))


async def system_stop(system: hf.ActorSystem, family: Family) -> None:
    await system.stop(family.ref("a"))


@pytest.mark.parametrize(
    ("call", "restart", "state", "refusal"),
    [
        (ref_stop, "permanent", "running", hf.errors.ChildBusy),
        (ref_stop, "transient", "stopped", None),
        (terminate, "permanent", "running", hf.errors.ChildBusy),
        (terminate, "transient", "stopped", None),
        (terminate_child, "permanent", "stopped", hf.errors.ChildParked),
        (system_stop, "permanent", None, hf.errors.NoSuchChild),
    ],
)
@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_who_starts_it_again(
    call: Callable[[hf.ActorSystem, Family], Awaitable[None]], restart: Any, state: str | None, refusal: Any
) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        plan = Plan()
        family = await Family.start(system, plan, kid(plan, "a", restart=restart))
        await call(system, family)
        await family.rest()
        assert (await family.states()).get("a") == state
        again = family.top.ask(hf.RestartChild("a", unless_parked=True), IN_TIME)
        if refusal is None:
            assert await (await again).ask(Life(), IN_TIME) == 1
        else:
            with pytest.raises(refusal):
                await again
