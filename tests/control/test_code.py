"""Another class for a live actor, now and after restarts (otp.md 1.12, `change_code`)."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.process.wire import frames
from tests.control.conftest import WAYS, Starter
from tests.control.players import (
    Account,
    Add,
    Cents,
    Crash,
    Deaf,
    Euros,
    Heard,
    NewReader,
    News,
    Puts,
    Reader,
    SaidSummed,
    Sum,
    Summed,
    Tally,
    Timed,
    Total,
    Whole,
    as_sum,
    cannot,
    keep,
    with_timer,
)


async def test_code_is_replaced_for_good(system: hf.ActorSystem, start_one: Starter, way: str) -> None:
    one = await start_one(hf.start(Account))
    assert await one.ask(Add(1)) == 1
    await system.suspend(one)
    queued = one.ask(Add(2))
    await system.replace_code(one, Cents)
    assert (await system.get_status(one)).state == "suspended"
    await system.resume(one)
    assert await queued == 300
    assert await one.ask(Euros()) == 3
    assert await system.get_state(one) == {"total": 300, "seen": [1], "release": 2}
    one.kill()
    assert await one.ask(Euros(), timeout=30.0) == (3 if "recorded" in way else 0)
    assert (await system.get_status(one)).kind == "tests.control.players.Cents"
    assert await one.ask(Add(1)) == (400 if "recorded" in way else 100)


async def test_code_is_replaced_in_suspended_actors_only(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    with pytest.raises(hf.errors.NotSuspended, match="must be suspended first"):
        await system.replace_code(one, Cents)
    assert await one.ask(Add(1)) == 1


async def test_a_migration_that_fails_leaves_the_old_class(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.suspend(one)
    with pytest.raises(hf.errors.ControlFailed, match=r"replace_code of .* failed: RuntimeError: no way from there"):
        await system.replace_code(one, Cents, cannot)
    await system.resume(one)
    assert await one.ask(Add(1)) == 1
    assert (await system.get_status(one)).kind == "tests.control.players.Account"
    one.kill()
    assert await one.ask(Add(1), timeout=30.0) in (1, 2)
    assert (await system.get_status(one)).kind == "tests.control.players.Account"


async def test_a_newer_class_that_cannot_read_the_state_is_refused(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.suspend(one)
    with pytest.raises(hf.errors.ControlFailed, match=r"schema version 1, .*Deaf 2, which has no classmethod migrate"):
        await system.replace_code(one, Deaf)
    await system.replace_code(one, Deaf, keep)
    with pytest.raises(hf.errors.ControlFailed, match="an older class cannot read the state of a newer one"):
        await system.replace_code(one, Account)
    await system.resume(one)
    assert await one.ask(Add(1)) == 1


@pytest.mark.parametrize("replaces", [True, False])
async def test_one_hook_reads_older_states_of_whatever_kind(tmp_path: Path, replaces: bool) -> None:
    """The state that an actor has when it gets the class, and that which the last program has saved."""
    store = f"sqlite:{tmp_path / 'app.db'}"

    def account(kind: type[Account]) -> hf.ChildSpec[Any]:
        return hf.child("one", hf.start(kind), recovery=hf.hybrid(interval=3600.0))

    async with hf.ActorSystem("app", log=False, store=store) as system:
        one = await system.start(account(Account))
        assert await one.ask(Add(1)) == 1
        if replaces:
            await system.suspend(one)
            await system.replace_code(one, Cents)
            await system.resume(one)
            assert await one.ask(Euros()) == 1
    async with hf.ActorSystem("app", log=False, store=store) as system:
        one = await system.start(account(Cents))
        assert await one.ask(Euros()) == 1


@pytest.mark.parametrize("how", ["by itself", "in a transaction", "with a change"])
async def test_a_variable_that_only_the_new_class_has_is_what_its_init_gives(
    system: hf.ActorSystem, start_one: Starter, way: str, how: str
) -> None:
    one = await start_one(hf.start(Account, 5))
    assert await one.ask(Add(1)) == 6
    if how == "in a transaction":
        async with system.transaction() as change:
            change.replace_code(one, Tally)
    else:
        await system.suspend(one)
        await system.replace_code(one, Tally, keep if how == "with a change" else None)
        await system.resume(one)
    assert await system.get_state(one) == {"total": 6, "seen": [1], "puts": 100}
    assert await one.ask(Add(1)) == 7
    assert await one.ask(Puts()) == 101
    one.kill()
    assert await one.ask(Puts(), timeout=30.0) == (101 if "recorded" in way else 100)


async def test_a_variable_that_a_change_keeps_is_there_in_the_next_life(system: hf.ActorSystem) -> None:
    """`seen` is none that the new class begins with, and `total` was said to be another one."""
    one = await system.start(hf.child("one", hf.start(Account), recovery=hf.hybrid(interval=3600.0)))
    assert await one.ask(Add(2)) == 2
    await system.suspend(one)
    await system.replace_code(one, Sum, as_sum)
    await system.resume(one)
    one.kill()
    assert await one.ask(Add(1), timeout=30.0) == 3
    assert await system.get_state(one) == {"sum": 3, "seen": [2]}


async def test_a_variable_that_may_have_been_renamed_is_refused(
    system: hf.ActorSystem, start_one: Starter, way: str
) -> None:
    one = await start_one(hf.start(Account, 5))
    await system.suspend(one)
    with pytest.raises(hf.errors.ControlFailed, match=r"total would be lost; if it was renamed, say @hf.renamed\(sum="):
        await system.replace_code(one, Summed)
    assert (await system.get_status(one)).kind == "tests.control.players.Account"
    assert await system.get_state(one) == {"total": 5, "seen": []}
    await system.replace_code(one, SaidSummed)
    await system.resume(one)
    assert await one.ask(Add(1)) == 6
    one.kill()
    assert await one.ask(Add(1), timeout=30.0) == (7 if "recorded" in way else 6)


async def test_an_init_that_does_more_than_set_variables_is_refused(
    system: hf.ActorSystem, start_one: Starter, way: str
) -> None:
    one = await start_one(hf.start(Account, 5))
    with pytest.raises(hf.HoldfastError, match=r"Timed.__init__ says which variables are new, and it cannot run in"):
        async with system.transaction() as change:
            change.replace_code(one, Timed)
    assert await one.ask(Add(1)) == 6
    await system.suspend(one)
    with pytest.raises(hf.errors.ControlFailed, match=r"only a life that begins can do that.*give a `change` that"):
        await system.replace_code(one, Timed)
    await system.replace_code(one, Timed, with_timer)
    await system.resume(one)
    assert await system.get_state(one) == {"total": 6, "seen": [1], "timer": "said"}
    if "recorded" not in way:  # There `__init__` may set no timer at all.
        one.kill()
        assert await one.ask(Total(), timeout=30.0) == 5
        assert await system.get_state(one) == {"total": 5, "seen": [], "timer": "set"}


async def test_a_class_that_does_not_take_the_arguments_is_refused(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account, total=3))
    await system.suspend(one)
    with pytest.raises(hf.SpecError, match="Whole does not take the arguments of the old class"):
        await system.replace_code(one, Whole)
    await system.replace_code(one, hf.start(Cents, 5), keep)
    await system.resume(one)
    assert await one.ask(Total()) == 3


@pytest.mark.parametrize("way", ["task", "in a subtree"])
async def test_replaced_code_outlives_its_supervisor(system: hf.ActorSystem, way: str) -> None:
    inner = hf.supervisor("inner", children=[hf.child("one", hf.start(Account))], intensity=100)
    isolation: Any = "process" if way == "in a subtree" else "task"
    await system.start(hf.supervisor("top", children=[inner], intensity=100, isolation=isolation))
    one = system.ref("/app/top/inner/one", Account)
    await system.suspend(one)
    await system.replace_code(one, Cents, keep)
    gone = system.ref("/app/top", hf.Supervisor)._cell.ended()
    with system.events() as stream:
        system.ref("/app/top", hf.Supervisor).kill()
        await gone
        async with asyncio.timeout(30.0):
            async for event in stream:
                if isinstance(event, hf.events.ActorStarted) and event.address == "/app/top":
                    break
    assert await system.ref("/app/top/inner/one", Cents).ask(Add(1), timeout=30.0) == 100


async def test_a_process_that_dies_before_it_has_answered_comes_back_with_its_new_state_and_class(
    system: hf.ActorSystem,
) -> None:
    """The new state was saved: the old class could not go on with it."""
    one = await system.start(
        hf.child("one", hf.start(Account), recovery=hf.hybrid(interval=3600.0), isolation="process")
    )
    assert await one.ask(Add(1)) == 1
    await system.suspend(one)
    worker: Any = system._workers.of(one._cell)
    takers = worker.connection.takers

    def dies(_: frames.Reply) -> None:
        worker.forked.kill()

    takers[frames.Reply] = dies
    with pytest.raises(hf.AskFailed):
        await system.replace_code(one, Cents)
    assert await one.ask(Euros(), timeout=30.0) == 1
    assert (await system.get_status(one)).kind == "tests.control.players.Cents"
    one.kill()
    assert await one.ask(Add(1), timeout=30.0) == 200


async def test_below_a_supervisor_whose_process_dies_before_it_has_answered_the_old_class_is_back(
    system: hf.ActorSystem,
) -> None:
    """A limit: the root has not heard of the new one, and the state of the new one is refused if it does not fit."""
    child = hf.child("one", hf.start(Account))
    top = await system.start(hf.supervisor("top", children=[child], isolation="process"))
    one = system.ref("/app/top/one", Account)
    await system.suspend(one)
    worker: Any = system._workers.of(top._cell)

    def dies(_: frames.Reply) -> None:
        worker.forked.kill()

    worker.connection.takers[frames.Reply] = dies
    with pytest.raises(hf.HoldfastError):
        await system.replace_code(one, Cents)
    async with asyncio.timeout(30.0):
        while top._cell.life < 2 or one.path not in system.tree():
            await asyncio.sleep(0.005)
    back = system.ref("/app/top/one", hf.Actor)
    assert (await system.get_status(back)).kind == "tests.control.players.Account"


async def test_code_of_a_recorded_actor_below_a_process_is_replaced(system: hf.ActorSystem) -> None:
    spec = hf.child("one", hf.start(Account), recovery=hf.hybrid(interval=3600.0))
    await system.start(hf.supervisor("top", children=[spec], intensity=1000, isolation="process"))
    one = system.ref("/app/top/one", Account)
    assert await one.ask(Add(1), timeout=30.0) == 1
    await system.suspend(one)
    await system.replace_code(one, Cents)
    await system.resume(one)
    assert await one.ask(Add(1), timeout=30.0) == 200
    one.kill()
    assert await one.ask(Add(1), timeout=30.0) == 300


async def publish(system: hf.ActorSystem, number: int) -> None:
    for topic in ("/old", "/new", "/both"):
        await system.publish(topic, News(f"{topic} {number}"))


@pytest.mark.parametrize("way", [way for way in WAYS if "recorded" in way])
@pytest.mark.parametrize("by_topic", [False, True], ids=["held alike", "held by topic"])
async def test_a_recorded_actor_hears_the_topics_of_its_new_class_once_and_between_its_lives(
    system: hf.ActorSystem, start_one: Starter, by_topic: bool
) -> None:
    """Its home has subscribed, for all lives; with a rule of its own a topic comes in elsewhere than the others."""
    rules = {topic: hf.checkpoint.held(100) for topic in ("/old", "/new", "/both")} if by_topic else None
    options = {"recovery": hf.hybrid(interval=3600.0, held=rules), "backoff": hf.Backoff(initial=0.2)}
    one = await start_one(hf.start(Reader), **options)
    await publish(system, 1)
    await system.suspend(one)
    await system.replace_code(one, NewReader)
    await system.resume(one)
    await publish(system, 2)
    with system.events() as events:
        one.tell(Crash())
        await events.until(hf.events.ActorCrashed)
        await publish(system, 3)
    assert await one.ask(Heard(), timeout=30.0) == ["/old 1", "/both 1", "/new 2", "/both 2", "/new 3", "/both 3"]
    await publish(system, 4)
    assert (await one.ask(Heard(), timeout=30.0))[-2:] == ["/new 4", "/both 4"]
