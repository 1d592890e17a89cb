"""A transaction that has actors live elsewhere: with state and messages there, and back when a later step fails."""

import asyncio
import os

import pytest

import holdfast as hf
from tests.system.trees import Add, Life, Stumble, counter, ref

# A refused or failed transaction ends with its block, which collects several steps.
# ruff: noqa: PT012


@pytest.fixture(params=[None, hf.hybrid()], ids=["plain", "recorded"])
async def one(system: hf.ActorSystem, request: pytest.FixtureRequest) -> hf.ActorRef[hf.Actor]:
    """A counter that stands at 5, in this process."""
    actor = await system.start(counter("one", recovery=request.param))
    assert await actor.ask(Add(5)) == 5
    return actor


async def test_it_lives_there_with_its_state_and_its_messages(
    system: hf.ActorSystem, one: hf.ActorRef[hf.Actor]
) -> None:
    async with system.transaction() as change:
        change.isolation(one, "process")
        asked = [asyncio.ensure_future(one.ask(Add(1))) for _ in range(50)]
    assert await asyncio.gather(*asked) == list(range(6, 56))
    pid = system.pid_of(one)
    assert pid != os.getpid()
    async with system.transaction() as change:
        change.isolation(one, "task")
    assert system.pid_of(one) == os.getpid()
    assert await one.ask(Add(0)) == 55


async def test_a_later_failure_brings_it_back(system: hf.ActorSystem, one: hf.ActorRef[hf.Actor]) -> None:
    pids: list[int] = []

    async def look_and_fail(running: hf.ActorSystem) -> None:
        pids.append(running.pid_of(one))
        one.tell(Add(2))
        raise hf.HoldfastError("there was a stone")

    with pytest.raises(hf.TransactionFailed, match="there was a stone"):
        async with system.transaction() as change:
            change.isolation(one, "process")
            change.step(Stumble(look_and_fail))
    assert pids == [os.getpid()], "it lives where it did until all is in force"
    assert system.pid_of(one) == os.getpid()
    assert await one.ask(Add(0)) == 7, "with what has come meanwhile"
    assert one._cell.spec.isolation == "task"
    before = await one.ask(Life())
    one.kill()
    assert await one.ask(Life()) == before + 1
    assert system.pid_of(one) == os.getpid(), "and is restarted here"


class Spawn(hf.Message): ...


class Parent(hf.Actor):
    @hf.on(Spawn)
    def spawn(self, message: Spawn) -> None:
        self.ctx.spawn(hf.start(Parent))


async def test_who_cannot_live_there_undoes_the_steps_before(
    system: hf.ActorSystem, one: hf.ActorRef[hf.Actor]
) -> None:
    parent = await system.start(hf.child("parent", hf.start(Parent)))
    await parent.ask(Spawn())
    with pytest.raises(hf.TransactionFailed, match="/app/parent") as failed:
        async with system.transaction() as change:
            change.isolation(one, "process")
            change.isolation(parent, "process")
    assert isinstance(failed.value.__cause__, hf.errors.CannotMove)
    assert system.pid_of(one) == os.getpid()
    assert await one.ask(Add(0)) == 5


async def test_a_class_that_no_process_can_import_is_refused_before_anything_is_done(
    system: hf.ActorSystem, one: hf.ActorRef[hf.Actor]
) -> None:
    class Local(hf.Actor): ...

    await system.start(hf.child("local", hf.start(Local)))
    life = await one.ask(Life())
    with pytest.raises(hf.TransactionRefused, match="cannot import"):
        async with system.transaction() as change:
            change.isolation(one, "process")
            change.isolation(ref(system, "/app/local"), "process")
    assert (system.pid_of(one), await one.ask(Life())) == (os.getpid(), life)


async def test_a_dry_run_says_where_it_would_live(system: hf.ActorSystem, one: hf.ActorRef[hf.Actor]) -> None:
    async with system.transaction(dry_run=True) as change:
        change.isolation(one, "process")
    assert "have /app/one live in a process" in change.describe()
    assert system.pid_of(one) == os.getpid()
