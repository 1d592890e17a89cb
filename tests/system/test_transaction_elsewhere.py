"""Transactions where lives are lived elsewhere, or recorded: what can be done is, what cannot is refused beforehand."""

import asyncio
from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from tests.system.trees import Add, Boom, Client, Counter, Double, Life, Stumble, Where, counter, ref

# A refused or failed transaction ends with its block, which collects several steps.
# ruff: noqa: PT012

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A supervisor with a process of its own, and one with a process child and recorded children."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        far = [counter("a"), counter("b", 10)]
        await running.start(hf.supervisor("far", intensity=9, children=far, isolation="process"))
        near = [
            counter("own", isolation="process"),
            counter("kept", recovery=hf.hybrid()),
            counter("plain"),
            hf.child("sender", hf.start(Sender), recovery=hf.hybrid(interval=3600.0)),
        ]
        await running.start(hf.supervisor("near", intensity=9, children=near))
        await running.start(hf.supervisor("other", intensity=9))
        yield running


class Poke(hf.Message[int]):
    at: hf.ActorRef[Counter]


class Sender(Counter):
    """Sends on."""

    @hf.on(Poke)
    async def poke(self, message: Poke) -> int:
        self.count += await message.at.ask(Add())
        return self.count


async def shape(system: hf.ActorSystem) -> object:
    far = ref(system, "/app/far")
    children = await far.ask(hf.WhichChildren())
    return system.tree(), children, [await ref(system, info.path).ask(Life()) for info in children]


@pytest.mark.parametrize("verb", ["add", "reorder", "strategy", "remove"])
async def test_a_supervisor_in_another_process_is_changed_by_its_admin_messages(
    system: hf.ActorSystem, verb: str
) -> None:
    def collect(change: hf.system.Change) -> None:
        match verb:
            case "add":
                change.register("new", change.add("/app/far", counter("c", 5)))
            case "reorder":
                change.reorder("/app/far", ["b", "a"])
            case "strategy":
                change.strategy("/app/far", "one_for_all")
            case _:
                change.remove("/app/far/a")

    before = await shape(system)
    with pytest.raises(hf.TransactionFailed, match="there was a stone"):
        async with system.transaction() as change:
            collect(change)
            change.step(Stumble())
    assert await shape(system) == before
    async with system.transaction() as change:
        collect(change)
    match verb:
        case "add":
            assert await system.whereis("new").ask(Add()) == 6
        case "reorder":
            assert [info.id for info in await ref(system, "/app/far").ask(hf.WhichChildren())] == ["b", "a"]
        case "strategy":
            ref(system, "/app/far/b").tell(Boom())
            assert await ref(system, "/app/far/b").ask(Life()) == 2
            assert await ref(system, "/app/far/a").ask(Life()) == 2
        case _:
            assert [info.id for info in await ref(system, "/app/far").ask(hf.WhichChildren())] == ["b"]


async def test_its_process_comes_back_in_the_new_shape(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        change.add("/app/far", counter("c", 5))
        change.remove("/app/far/a")
        change.strategy("/app/far", "one_for_all")
    far = ref(system, "/app/far")
    far.kill()
    async with asyncio.timeout(30):
        assert [info.id for info in await far.ask(hf.WhichChildren(), 30.0)] == ["b", "c"]
    ref(system, "/app/far/b").tell(Boom())
    assert await ref(system, "/app/far/c").ask(Add()) == 6


async def test_what_cannot_be_done_there_is_refused_before_anything_is(system: hf.ActorSystem) -> None:
    before = await shape(system)
    refusals = {
        "it is changed by this very transaction": lambda change: (
            change.stop("/app/near/own"),
            change.move("/app/near", "/app/far"),
        ),
        "cannot hold another supervisor": lambda change: change.add(
            "/app/far", hf.supervisor("p", children=[], isolation="process")
        ),
        "removed by this": lambda change: (change.remove("/app/far"), change.add("/app/far", counter("p"))),
    }
    for why, step in refusals.items():
        with pytest.raises(hf.TransactionRefused, match=why):
            async with system.transaction() as change:
                change.strategy("/app/far", "one_for_all")
                step(change)
    assert await shape(system) == before


@pytest.mark.parametrize("path", ["/app/near/own", "/app/near/kept", "/app/far/a", "/app/near/plain"])
async def test_state_and_code_are_put_back_wherever_it_lives(system: hf.ActorSystem, path: str) -> None:
    one = ref(system, path)
    await one.ask(Add(3))
    before = await system.get_state(one)
    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        async with system.transaction() as change:
            change.replace_state(one, more)
            change.replace_code(one, Double)
            change.step(Stumble())
    assert failed.value.kept == ()
    assert await system.get_state(one) == before
    assert await one.ask(Add()) == before["count"] + 1


def more(state: dict[str, int]) -> dict[str, int]:
    return {**state, "count": state["count"] + 1000}


async def test_a_recorded_sender_recovers_although_its_receiver_has_moved(system: hf.ActorSystem) -> None:
    """Its replay compares what it sends with what it sent, address included."""
    plain, sender = ref(system, "/app/near/plain"), ref(system, "/app/near/sender")
    assert await sender.ask(Poke(plain)) == 1
    async with system.transaction() as change:
        change.move(plain, "/app/other")
    assert await sender.ask(Poke(plain)) == 3
    with system.events() as stream:
        sender.kill()
        assert await sender.ask(Poke(plain)) == 6
        kinds = [type(event) for event in stream.take()]
    assert hf.events.RecoveryFailed not in kinds
    assert hf.events.Recovered in kinds


async def test_a_process_is_told_where_the_actor_lives_now_that_it_is_bound_to(system: hf.ActorSystem) -> None:
    client = hf.child("client", hf.start(Client), isolation="process", bindings={"peer": "/app/near/plain"})
    await ref(system, "/app/other").ask(hf.StartChild(client))
    async with system.transaction() as change:
        change.move("/app/near/plain", "/app/other")
    assert await ref(system, "/app/other/client").ask(Where()) == "/app/other/plain"
    ref(system, "/app/other/client").kill()
    assert await ref(system, "/app/other/client").ask(Life(), 30.0) == 2


async def test_code_of_a_child_of_a_dynamic_supervisor_is_replaced(system: hf.ActorSystem) -> None:
    pool = await system.start(hf.dynamic("pool", intensity=9))
    one = await pool.ask(hf.StartChild(counter("one")))
    async with system.transaction() as change:
        change.replace_code(one, Double)
    one.tell(Boom())
    assert await one.ask(Add(3)) == 6


async def test_a_move_waits_for_recorded_actors_that_may_have_to_repeat_what_they_sent(
    system: hf.ActorSystem,
) -> None:
    plain, sender = ref(system, "/app/near/plain"), ref(system, "/app/near/sender")
    await system.suspend(plain)
    poked = sender.ask(Poke(plain))  # Its turn is not over: a replay would ask again, at the address of before.
    while not (await system.get_status(sender)).turn:
        await asyncio.sleep(0)
    with pytest.raises(
        hf.TransactionFailed,
        match="its next snapshot is waited for; a turn of /app/near/sender waits for an answer of /app/near/plain",
    ):
        async with system.transaction(timeout=0.2) as change:
            change.move(plain, "/app/other")
    assert plain.path == "/app/near/plain"
    await system.resume(plain)
    assert await poked == 1
    async with system.transaction() as change:
        change.move(plain, "/app/other")
    assert plain.path == "/app/other/plain"
