"""What a compromised worker says of the bindings of its actors is known, and grants it nothing."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import GivenName
from holdfast.actors.kernel.message import message_name
from holdfast.actors.process.wire import frames as f
from holdfast.checkpoint.protocol import AtRoot, Wanted
from holdfast.ftm.group.group_place import GroupPlace
from tests.actors.process.hostile.forging import command, frame, named, raw
from tests.actors.process.hostile.players import Add, Evil, House, Kill, Ping, Terminate, Victim, Write
from tests.actors.process.waiting import next_event, until
from tests.system.trees import Stumble

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")

HOUSE, EVIL, SUP, VICTIM = "/app/house", "/app/house/evil", "/app/sup", "/app/sup/victim"
KINDS = ["plain", "recorded", "protected"]


class Town:
    """A victim and its supervisor, and a worker that says that it is bound to that one."""

    def __init__(self, system: hf.ActorSystem) -> None:
        self.system = system
        self.victim = system.ref(VICTIM, Victim)
        self.total = 0

    async def settle(self, kind: str) -> hf.ActorRef[Evil]:
        """Who says so: an actor of this kind."""
        await self.system.start(hf.child("house", hf.start(House, kind, SUP), isolation="process"))
        return self.system.ref(EVIL, Evil)

    async def refused(self, evil: hf.ActorRef[Evil], order: hf.Message[int]) -> None:
        """It gives an order: its process ends for that, and nobody else feels anything."""
        pid = self.system.pid_of(self.system.ref("/app/other", Victim))
        with self.system.events() as events:
            evil.tell(order)
            breach = await next_event(events, hf.events.TrustBreached)
        assert breach.address.startswith(HOUSE)
        assert "has neither started nor is bound to" in breach.problem
        self.total += 1
        assert await self.victim.ask(Add(), timeout=60) == self.total
        assert self.system.pid_of(self.system.ref("/app/other", Victim)) == pid
        await self.back()

    async def back(self) -> None:
        """The worker was started again."""
        async with asyncio.timeout(60):
            while True:
                try:
                    await self.system._node.cell_at(EVIL).ref.ask(Ping(), timeout=60)
                    return
                except hf.HoldfastError:
                    await asyncio.sleep(0.01)


@pytest.fixture
async def town() -> AsyncIterator[Town]:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.supervisor("sup", intensity=1000, children=[hf.child("victim", hf.start(Victim))]))
        await system.start(hf.child("other", hf.start(Victim), isolation="process"))
        yield Town(system)


@pytest.mark.parametrize("kind", KINDS)
async def test_a_claim_is_known_and_grants_nothing(town: Town, kind: str) -> None:
    evil = await town.settle(kind)
    with pytest.raises(hf.TransactionRefused, match="binding 'port' would point at /app/sup, which is removed"):
        async with town.system.transaction() as change:
            change.remove(SUP)
    await town.refused(evil, Kill(VICTIM))


@pytest.mark.parametrize("kind", KINDS)
async def test_a_bind_that_is_undone_leaves_a_claim(town: Town, kind: str) -> None:
    evil = await town.settle(kind)
    with pytest.raises(hf.TransactionFailed):  # noqa: PT012 - a transaction is a block
        async with town.system.transaction() as change:
            change.bind(evil, "port", "/app/other")
            change.step(Stumble())
    await town.refused(evil, Kill(VICTIM))


@pytest.mark.parametrize("kind", KINDS)
async def test_the_same_binding_made_by_the_root_grants_it(town: Town, kind: str) -> None:
    evil = await town.settle(kind)
    town.system.bind(evil, "port", town.system.ref(SUP, hf.Supervisor))
    with town.system.events() as events:
        assert await evil.ask(Kill(VICTIM), timeout=60) == 1
        assert (await next_event(events, hf.events.ChildTerminated)).address == VICTIM
        assert hf.events.TrustBreached not in [type(event) for event in events.take()]


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_claim_that_moves_with_its_actor_is_still_one(town: Town, recovery: Any) -> None:
    """Into a group, whose replicas are bound so, and back."""
    children = [hf.child("evil", hf.start(Evil), recovery=recovery)]
    await town.system.start(hf.supervisor("house", isolation="process", intensity=1000, children=children))
    evil = town.system.ref(EVIL, Evil)
    claimed = command(HOUSE, "born", path=EVIL, kind=message_name(Evil), life=1, bindings={"port": SUP})
    assert await evil.ask(Write(claimed), timeout=60) == 1
    assert await evil.ask(Ping(), timeout=60) == 1
    async with town.system.transaction() as change:
        change.protect(evil, hf.ftm.PBR())
    assert evil.path + "/ftm" in town.system.tree()
    assert [cell.path for cell in evil._cell.extra().bindings.values()] == [SUP]
    await town.refused(evil, Kill(VICTIM))
    await until(lambda: not isinstance(evil._cell.host.place, GroupPlace))  # It was on probation.
    await until(lambda: [cell.path for cell in evil._cell.extra().bindings.values()] == [SUP])  # Its new life says so.
    await town.refused(evil, Kill(VICTIM))


@pytest.mark.parametrize("kind", ["plain"])
async def test_it_may_not_send_an_order_by_a_binding_that_it_claims(town: Town, kind: str) -> None:
    evil = await town.settle(kind)
    await town.refused(evil, Terminate())


async def test_an_order_among_the_outputs_of_a_turn_needs_a_binding_as_well(town: Town) -> None:
    spec = hf.child("evil", hf.start(Evil), recovery=hf.hybrid(), isolation="process")
    evil = await town.system.start(spec)
    with town.system.events() as events:
        evil.tell(Kill(VICTIM, in_turn=True))
        breach = await next_event(events, hf.events.TrustBreached)
        assert breach.problem.startswith(f"'kill' to {VICTIM}, which /app/evil has neither started nor is bound to")
        await town.system.stop(evil)
        assert await town.victim.ask(Add(), timeout=60) == 1
        assert hf.events.ActorKilled not in [type(event) for event in events.take()]


@pytest.mark.parametrize("protected", [False, True], ids=["recorded", "protected"])
async def test_what_it_wants_of_another_child_grants_nothing(town: Town, protected: bool) -> None:
    evil = await town.settle("plain")
    made = AtRoot(b"", []) if protected else None
    wanted = Wanted(1, "a:B", [], hf.hybrid(), None, made, {"port": SUP})
    await town.refused(evil, Write(frame(f.Record(f"{HOUSE}/x", raw(wanted))) + command(VICTIM, "kill")))


@pytest.mark.parametrize("told", [{"port": "nowhere"}, {str(at): "/app/sup" for at in range(300)}, {"": 5}], ids=str)
async def test_bindings_that_cannot_be_are_a_breach(town: Town, told: Any) -> None:
    evil = await town.settle("plain")
    wanted = Wanted(1, "a:B", [], hf.hybrid(), None, None, told)
    with town.system.events() as events:
        evil.tell(Write(frame(f.Record(f"{HOUSE}/x", raw(wanted)))))
        assert (await next_event(events, hf.events.TrustBreached)).address == HOUSE


async def breaches(town: Town, evil: hf.ActorRef[Evil], written: bytes) -> bool:
    """Whether a process ends for what it writes; its answers come behind that."""
    with town.system.events() as events:
        try:
            await evil.ask(Write(written), timeout=60)
            await evil.ask(Ping(), timeout=60)
        except (hf.AskFailed, hf.ActorStopped):
            return hf.events.TrustBreached in [type(event) for event in events.take()]
    return False


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("/app/other", {}),
        (HOUSE, {}),
        (f"{EVIL}//x", {}),
        (EVIL, {"name": "/app/bank"}),
        (EVIL, {"name": "x" * 2000}),
        (EVIL, {"name": 5}),
        (EVIL, {"scope": "world"}),
        (EVIL, {"kind": None}),
        (EVIL, {"answer": "x"}),
    ],
    ids=str,
)
async def test_a_name_that_it_may_not_give_is_a_breach(town: Town, path: str, told: Any) -> None:
    evil = await town.settle("plain")
    assert await breaches(town, evil, named(path, HOUSE, **told))
    with pytest.raises(hf.errors.NoSuchActor):
        town.system.whereis("bank")
    await town.back()


@pytest.mark.parametrize("name", [GivenName("/app/bank"), GivenName("x" * 2000)], ids=["address", "long"])
async def test_nor_by_what_it_wants_of_a_child(town: Town, name: GivenName) -> None:
    evil = await town.settle("plain")
    wanted = Wanted(1, "a:B", [], hf.hybrid(), None, None, {}, name)
    assert await breaches(town, evil, frame(f.Record(f"{HOUSE}/x", raw(wanted))))


async def test_a_process_without_a_supervisor_gives_no_names(town: Town) -> None:
    evil = await town.system.start(hf.child("evil", hf.start(Evil), isolation="process"))
    born = command(evil.path, "born", path=f"{evil.path}/x", kind="a:B", life=1)
    assert await breaches(town, evil, born + named(f"{evil.path}/x", evil.path))
    with pytest.raises(hf.errors.NoSuchActor):
        town.system.whereis("bank")


async def test_its_own_actors_have_what_names_nobody_has_one_at_a_time(town: Town) -> None:
    evil = await town.settle("plain")
    town.system.register("till", town.victim)
    pid = town.system.pid_of(town.system.ref(HOUSE))
    for name in ("till", "bank", "house", "a\nb"):
        assert await evil.ask(Write(named(EVIL, HOUSE, name=name)), timeout=60) == 1
        assert await evil.ask(Ping(), timeout=60) == 1
        assert town.system.whereis("till") == town.victim
    assert list(town.system._node.names) == ["till"]  # The last one was none.
    assert await evil.ask(Write(named(EVIL, HOUSE)), timeout=60) == 1
    assert await evil.ask(Ping(), timeout=60) == 1
    assert town.system.whereis("bank") == evil
    await evil.ask(Write(command(HOUSE, "undone", path=EVIL)), timeout=60)
    assert await evil.ask(Ping(), timeout=60) == 1
    assert list(town.system._node.names) == ["till"]
    assert town.system.pid_of(town.system.ref(HOUSE)) == pid
