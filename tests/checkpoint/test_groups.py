"""Several actors go back to one cut, with what was under way between them (R78)."""

from __future__ import annotations

import asyncio
import contextlib
import random
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Note, Seen, start, until

MEMBERS, EACH, HOPS = 4, 100, 60
SEED = 20_260_801
RECOVERY = hf.hybrid(interval=0.05)


class Pass(hf.Message):
    """Some of the sum goes on to another member, `hops` times."""

    amount: int
    hops: int
    ring: list[hf.ActorRef[Any]]


class Look(hf.Message[list[int]]): ...


class Purse(hf.Actor):
    def __init__(self, index: int) -> None:
        self.index, self.sum, self.moves = index, EACH, 0

    @hf.on(Pass)
    def hand_on(self, message: Pass) -> None:
        self.sum += message.amount
        self.moves += 1
        if message.hops:
            amount = min(self.sum, 1 + self.moves % 7)
            self.sum -= amount
            message.ring[(self.index + 1) % len(message.ring)].tell(Pass(amount, message.hops - 1, message.ring))

    @hf.on(Look, readonly=True)
    def read(self, message: Look) -> list[int]:
        return [self.sum, self.moves]


async def purses(system: hf.ActorSystem, isolation: str) -> list[hf.ActorRef[Any]]:
    return [await start(system, isolation, f"purse{n}", hf.start(Purse, n), recovery=RECOVERY) for n in range(MEMBERS)]


def running(store: str | None) -> hf.ActorSystem:
    return hf.ActorSystem("app", log=False, intensity=1000, store=store)


async def total(ring: list[hf.ActorRef[Any]], moves: int) -> int:
    """The sum when so many moves have been made: nothing is under way any more."""
    async with asyncio.timeout(60.0):
        while True:
            seen = [await one.ask(Look(), timeout=30.0) for one in ring]
            assert sum(count for _, count in seen) <= moves
            if sum(count for _, count in seen) == moves:
                return sum(amount for amount, _ in seen)
            await asyncio.sleep(0.01)


@pytest.mark.some(3)
async def test_no_sum_is_lost_or_doubled_whenever_the_cut_is_made(isolation: str, store: str | None) -> None:
    moments = random.Random(SEED)
    async with running(store) as system:
        ring = await purses(system, isolation)
        for one in ring:
            for _ in range(5):
                one.tell(Pass(0, HOPS, ring))
        for attempt in range(3):
            await asyncio.sleep(moments.uniform(0.0, 0.05))
            await system.checkpoint_group(ring, name=f"cut {attempt}")
        moves = MEMBERS * 5 * (HOPS + 1)
        assert await total(ring, moves) == MEMBERS * EACH
        for attempt in (1, 0, 2):
            await system.restore_group(f"cut {attempt}")
            assert await total(ring, moves) == MEMBERS * EACH, f"seed {SEED}, attempt {attempt}"


async def test_all_that_came_later_is_undone_and_nothing_else(isolation: str, store: str | None) -> None:
    async with running(store) as system:
        one = await start(system, isolation, "one", hf.start(Doer), recovery=RECOVERY)
        two = await start(system, isolation, "two", hf.start(Doer), recovery=RECOVERY)
        other = await start(system, isolation, "other", hf.start(Doer), recovery=RECOVERY)
        await one.ask(Do(["add a", "tell b", "after 0.3"], two))
        assert await two.ask(Note("c")) == 2
        await system.checkpoint_group([one, two], name="here")
        for late in (one, two, other):
            await late.ask(Do(["add late", "cancel" if late is one else "add later"]))
        await system.restore_group("here")
        assert await two.ask(Seen(), timeout=20.0) == ["b", "c"]
        assert await other.ask(Seen()) == ["late", "later"]
        async with asyncio.timeout(20.0):  # The timer that was cancelled since runs again.
            while await one.ask(Seen(), timeout=20.0) != ["a", "tick"]:
                await asyncio.sleep(0.02)
        one.kill()
        assert await one.ask(Do(["add on"]), timeout=20.0) == "3"


async def test_an_ask_under_way_is_answered_once_more(isolation: str, store: str | None, gate: Path) -> None:
    async with running(store) as system:
        one = await start(system, isolation, "one", hf.start(Doer), recovery=RECOVERY)
        two = await start(system, isolation, "two", hf.start(Doer), recovery=RECOVERY)
        two.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        one.tell(Do(["ask hello"], two))  # It waits behind the gate.
        await until(lambda: any(switch.calls.asks for switch in system._homes))
        await system.checkpoint_group([one, two], name="asking")
        Path(f"{gate}.open").touch()
        assert await one.ask(Seen(), timeout=20.0) == ["hello:1"]
        await system.restore_group("asking")
        assert await one.ask(Seen(), timeout=20.0) == ["hello:1"]
        assert await two.ask(Seen(), timeout=20.0) == ["hello"]


class Crier(Doer):
    async def step(self, verb: str, arg: str, peer: hf.ActorRef[Any] | None) -> Any:
        if verb == "publish":
            return await self.ctx.publish("/words", Note(arg))
        return await super().step(verb, arg, peer)


class Late(Doer):
    """Takes long to start."""

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(0.2)

    @hf.on(Note)
    @hf.subscribe("/words")
    def note(self, message: Note) -> int | hf.ReplyHandle[int]:
        return super().note(message)


@pytest.mark.pairs
@pytest.mark.parametrize("way", ["ask", "publish"])
async def test_nobody_begins_before_all_are_there(isolation: str, store: str | None, gate: Path, way: str) -> None:
    """Else the first one publishes what the second one, who is still to be started, does not hear."""
    async with running(store) as system:
        one = await start(system, isolation, "one", hf.start(Crier), recovery=RECOVERY)
        two = await start(system, isolation, "two", hf.start(Late), recovery=RECOVERY)
        one.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        one.tell(Do([f"{way} hello"], two))  # It waits behind the gate.
        asked = one.ask(Do([]), timeout=20.0)
        await system.checkpoint_group([one, two], name="before")
        Path(f"{gate}.open").touch()
        await asked
        await system.restore_group("before")
        await one.ask(Do([]), timeout=20.0)  # Behind what was under way.
        assert await two.ask(Seen(), timeout=20.0) == ["hello"]


async def test_the_way_back_leads_over_restarts_of_the_root(isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        ring = await purses(system, isolation)
        ring[0].tell(Pass(0, HOPS, ring))
        await system.checkpoint_group(ring, name="early")
        ring[0].tell(Pass(1000, 0, ring))
        assert await total(ring, HOPS + 2) == MEMBERS * EACH + 1000
    async with running(store) as system:
        ring = await purses(system, isolation)
        assert await total(ring, HOPS + 2) == MEMBERS * EACH + 1000
        await system.restore_group("early")
        assert await total(ring, HOPS + 1) == MEMBERS * EACH


async def test_a_root_that_dies_on_the_way_back_finishes_it_at_its_next_start(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    step, died = 0, True
    while died:
        step += 1
        async with running(store) as system:
            ring = [await system.start(hf.child(f"p{step}-{n}", hf.start(Purse, n), recovery=RECOVERY)) for n in (0, 1)]
            await system.checkpoint_group(ring, name="cut")
            for one in ring:
                one.tell(Pass(7, 0, ring))
            assert await total(ring, 2) == 2 * EACH + 14
        async with running(store) as system:
            engine: Any = Mortal(system._homes.journal.engine, step)
            system._homes.journal.engine = engine
            with contextlib.suppress(OSError):
                system._homes.groups.replace("cut")
            died, system._homes.journal.engine = engine.is_dead, engine.real
        async with running(store) as system:
            ring = [await system.start(hf.child(f"p{step}-{n}", hf.start(Purse, n), recovery=RECOVERY)) for n in (0, 1)]
            undone = step > 1  # Before its first word nothing was begun.
            moves = 0 if undone else 2
            assert await total(ring, moves) == 2 * EACH + 7 * moves, f"step {step}"
    assert step > 4


async def test_what_is_not_wanted_any_more_is_forgotten_for_good(store: str | None) -> None:
    async with running(store) as system:
        ring = await purses(system, "task")
        for name in ("b", "a", "c", "b"):  # The last one takes the place of the first.
            await system.checkpoint_group(ring, name=name)
        assert system.group_snapshots() == ["a", "c", "b"]
        await system.forget_group("c")
        with pytest.raises(hf.errors.NoSuchGroup, match="'c'"):
            await system.forget_group("c")
        assert system.group_snapshots() == ["a", "b"]
    if store is not None:
        async with running(store) as system:
            assert system.group_snapshots() == ["a", "b"]
            ring = await purses(system, "task")
            with pytest.raises(hf.errors.NoSuchGroup):
                await system.restore_group("c")
            await system.restore_group("a")


class Left(hf.Actor):
    right: hf.Binding[Doer]

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.right.tell(message)
        return 0


async def test_members_with_bindings_are_started_as_their_supervisors_do(
    system: hf.ActorSystem, isolation: str
) -> None:
    right = await start(system, isolation, "right", hf.start(Doer), recovery=RECOVERY)
    left = await system.start(
        hf.child("left", hf.start(Left), bindings={"right": right.path}, recovery=RECOVERY),
    )
    await left.ask(Note("a"))
    assert await right.ask(Seen()) == ["a"]
    await system.checkpoint_group([left, right.path, left], name="cut")
    await left.ask(Note("b"))
    assert await right.ask(Seen()) == ["a", "b"]
    await system.restore_group("cut")
    assert await right.ask(Seen(), timeout=20.0) == ["a"]
    await left.ask(Note("c"), timeout=20.0)
    assert await right.ask(Seen()) == ["a", "c"]


class Mortal:
    """An engine whose process dies before its n-th writing call."""

    def __init__(self, real: Any, steps: int) -> None:
        self.real, self.left, self.is_dead = real, steps, False

    def __getattr__(self, name: str) -> Any:
        method = getattr(self.real, name)
        if name not in ("cut", "append", "note"):
            return method

        def call(*args: Any, **options: Any) -> Any:
            self.left -= 1
            if self.left <= 0:
                self.is_dead = True
                raise OSError("it dies here")
            return method(*args, **options)

        return call


async def test_what_cannot_be_done_is_said(system: hf.ActorSystem) -> None:
    plain = await system.start(hf.child("plain", hf.start(Doer)))
    with pytest.raises(hf.HoldfastError, match="only actors with recovery"):
        await system.checkpoint_group([plain], name="x")
    with pytest.raises(hf.errors.NoSuchGroup, match="'x'"):
        await system.restore_group("x")
    for actors, name in (([], "x"), ([plain], "")):
        with pytest.raises(hf.SpecError, match="needs actors and a name"):
            await system.checkpoint_group(actors, name=name)
