"""A supervisor in another process names children in its own `init`: the root knows how they are bound."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf


class Hello(hf.Message[str]):
    pass


class Where(hf.Message[str]):
    pass


class Echo(hf.Actor):
    def __init__(self, name: str) -> None:
        self.name = name

    @hf.on(Hello)
    def hello(self, message: Hello) -> str:
        return self.name


class Front(hf.Actor):
    out: hf.Binding[Any]

    @hf.on(Where)
    async def where(self, message: Where) -> str:
        answer: str = await self.out.ask(Hello())
        return answer


class House(hf.Supervisor):
    def __init__(self, recovery: Any) -> None:
        self.recovery = recovery

    def init(self) -> hf.Plan:
        bound = {"out": f"{self.ctx.path}/a"}
        front = hf.child("front", hf.start(Front), bindings=bound, recovery=self.recovery)
        return hf.Plan([hf.child("a", hf.start(Echo, "a")), hf.child("b", hf.start(Echo, "b")), front])


def refuse(state: Any) -> Any:
    raise ValueError("no")


async def in_vain(system: hf.ActorSystem, target: str) -> None:
    """Bind it elsewhere, in a transaction that fails behind that."""
    with pytest.raises(hf.TransactionFailed):  # noqa: PT012 - a transaction is a block
        async with system.transaction() as change:
            change.bind("/app/house/front", "out", target)
            change.replace_state("/app/house/a", refuse)


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_change_that_is_undone_leads_back_to_where_init_has_bound_it(
    system: hf.ActorSystem, recovery: Any
) -> None:
    await system.start(hf.child("house", hf.start(House, recovery), isolation="process"))
    front = system.ref("/app/house/front", Front)
    assert await front.ask(Where()) == "a"
    await in_vain(system, "/app/house/b")
    assert await front.ask(Where()) == "a"
    async with system.transaction() as change:
        change.bind(front, "out", "/app/house/b")
    assert await front.ask(Where()) == "b"
    await in_vain(system, "/app/house/a")
    assert await front.ask(Where()) == "b"
