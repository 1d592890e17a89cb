"""Replies that an actor has promised when it is moved are given by whoever lives its life then."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import pytest

import holdfast as hf
from tests.ftm.test_failover import group_of
from tests.migration.travellers import Give, Later, Open, Traveller, path, take, tree

IN_TIME = 60.0
PLACES = ["a task", "a process", "a process, below its supervisor", "a process, two deep"]


class Avoid(hf.Message[bool]):
    """Do not start in this place any more."""

    place: str


class Choosy(Traveller):
    """Its start fails in a place that it was told of."""

    def __init__(self, root: int) -> None:
        super().__init__()
        self.root, self.avoided = root, ""

    async def on_start(self, restored: bool) -> None:
        if restored and self.avoided == ("task" if os.getpid() == self.root else "process"):
            raise RuntimeError("not here")

    @hf.on(Avoid)
    def avoid(self, message: Avoid) -> bool:
        self.avoided = message.place
        return True


class Private(Traveller):
    """Keeps its handle where no snapshot looks."""

    @hf.on(Later)
    def later(self, message: Later) -> Any:
        self._handle = self.ctx.reply_handle()
        return self._handle


class Got(hf.Message):
    n: int


class Asker(hf.Actor):
    """Asks the one who promises the reply."""

    owing: hf.Binding[Traveller]

    def __init__(self) -> None:
        self.reply = 0

    @hf.on(Open)
    def begin(self, message: Open) -> bool:
        self.ctx.pipe_to_self(self.owing.ask(Later(), timeout=IN_TIME), lambda n: Got(n))
        return True

    @hf.on(Got)
    def got(self, message: Got) -> None:
        self.reply = message.n

    @hf.on(Give)
    def has_got(self, message: Give) -> bool:
        return self.reply == message.n


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_move_that_fails_in_the_new_life_breaks_no_promise(system: hf.ActorSystem, place: Any) -> None:
    other: Any = "process" if place == "task" else "task"
    ref = await system.start(hf.child("one", hf.start(Choosy, os.getpid()), isolation=place))
    promised = ref.ask(Later(), IN_TIME)
    await ref.ask(Avoid(other))
    with pytest.raises(hf.errors.CannotMove, match="not here"):
        await system.set_isolation(ref, other)
    assert not promised.done()
    assert await ref.ask(Give(9))
    assert await promised == 9


async def test_a_promise_whose_handle_no_snapshot_has_keeps_it_from_being_protected(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("one", hf.start(Private)))
    promised = ref.ask(Later(), IN_TIME)
    with pytest.raises(hf.TransactionFailed, match="reply handles are not in its state"):
        await take(system, ref, "protect")
    assert not promised.done()


def replica(system: hf.ActorSystem, ref: hf.ActorRef[Any], name: str) -> int:
    """The process of a replica."""
    return system.pid_of(system.ref(f"{ref.path}/ftm/{name}", hf.Actor))


@pytest.mark.parametrize("place", PLACES)
async def test_a_promise_outlives_the_replica_that_leads(system: hf.ActorSystem, place: str) -> None:
    await system.start(tree(place, "plain"))
    ref = system.ref(path(place), Traveller)
    promised = ref.ask(Later(), IN_TIME)
    await take(system, ref, "protect")
    group = group_of(ref)
    os.kill(replica(system, ref, str(group.membership.primary)), signal.SIGKILL)
    assert await ref.ask(Give(9), IN_TIME)
    assert await promised == 9


@pytest.mark.parametrize("place", PLACES)
async def test_a_promise_ends_with_the_last_replica(system: hf.ActorSystem, place: str) -> None:
    await system.start(tree(place, "plain"))
    ref = system.ref(path(place), Traveller)
    promised = ref.ask(Later(), IN_TIME)
    await take(system, ref, "protect")
    group = group_of(ref)
    for name in group.membership.names:
        os.kill(replica(system, ref, name), signal.SIGKILL)
    with pytest.raises(hf.AskFailed):
        await promised
    await ref.ask(Give(9), IN_TIME)  # The next life is there, and the handle in its state answers nobody any more.


@pytest.mark.parametrize("is_below", [False, True])
@pytest.mark.parametrize("times", [1, 3])
async def test_who_asks_from_beside_it_gets_what_was_promised(
    system: hf.ActorSystem, times: int, is_below: bool
) -> None:
    """Also from inside a process, and over several moves there and back."""
    children = [
        hf.child("one", hf.start(Traveller)),
        hf.child("asker", hf.start(Asker), bindings={"owing": "/app/here/one"}),
    ]
    await system.start(
        hf.supervisor("here", children=children, isolation="process" if is_below else "task", intensity=9)
    )
    one, asker = system.ref("/app/here/one", Traveller), system.ref("/app/here/asker", Asker)
    assert await asker.ask(Open())
    for _ in range(times):
        await take(system, one, "protect")
        await take(system, one, "unprotect")
    assert await one.ask(Give(9))
    async with asyncio.timeout(IN_TIME):
        while not await asker.ask(Give(9)):
            pass
