"""A class that does more than to set an attribute when one is set: a state that is put back is as it was saved."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.conftest import system as system  # the fixture


class Add(hf.Message[int]):
    n: int


class Show(hf.Message[str]): ...


class Fail(hf.Message): ...


class Journaling(hf.Actor):
    """Keeps what its balance has been."""

    def __init__(self) -> None:
        self.past: list[int] = []
        self.balance = 0

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if name == "balance":
            self.past.append(value)

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        self.balance += message.n
        return self.balance

    @hf.on(Show)
    async def show(self, message: Show) -> str:
        return f"{self.past} {self.balance}"

    @hf.on(Fail)
    async def fail(self, message: Fail) -> None:
        raise RuntimeError("it fails")


class Named(Journaling):
    """Has said which variables are its state: then they are set as its own code sets them."""

    key_variables = ("balance", "past")


async def added(system: hf.ActorSystem, kind: type[Journaling], **options: Any) -> hf.ActorRef[Journaling]:
    ref = await system.start(hf.child("a", hf.start(kind), **options))
    for n in (1, 2):
        await ref.ask(Add(n))
    return ref


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("kind", [Journaling, Named])
async def test_a_restored_state_is_as_it_was_saved(
    system: hf.ActorSystem, kind: type[Journaling], isolation: Any
) -> None:
    ref = await added(system, kind, recovery=hf.hybrid(every=1), isolation=isolation)
    with pytest.raises(hf.RemoteCrash):
        await ref.ask(Fail())
    assert await ref.ask(Show()) == "[0, 1, 3] 3"


async def test_a_moved_state_is_as_it_was(system: hf.ActorSystem) -> None:
    ref = await added(system, Journaling)
    await system.set_isolation(ref, "process")
    assert await ref.ask(Show()) == "[0, 1, 3] 3"


@pytest.mark.parametrize("in_transaction", [False, True])
async def test_a_state_that_is_new_is_set_by_the_class_once(system: hf.ActorSystem, in_transaction: bool) -> None:
    ref = await added(system, Journaling)
    if in_transaction:
        async with asyncio.timeout(30), system.transaction() as change:
            change.replace_state(ref, seven)
    else:
        await system.replace_state(ref, seven)
    assert await ref.ask(Show()) == "[0, 1, 3, 7] 7"


def seven(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "balance": 7}
