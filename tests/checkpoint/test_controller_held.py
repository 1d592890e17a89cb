"""What comes while an actor is recovered: held, bounded, let in in order; nothing else gets out (R32-R34, T14, T15).

The message switch stands between the actor and all others (R13); what it keeps from it is held (R41). What is replayed
comes to the actor alone, as over a shadow topic (R38).
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.switch import Switch
from tests.checkpoint.guards import over, running
from tests.checkpoint.players import Do, Doer, Note, Notes, Seen, Tick, start, until
from tests.checkpoint.strikes import doer, event, let_through, sink, strike, struck

pytestmark = pytest.mark.pairs


class Held:
    """A recovery that stands still before it is released, until it is let go on."""

    def __init__(self, point: str = "release") -> None:
        self.reached, self.go_on = asyncio.Event(), asyncio.Event()
        self.hooks = hf.checkpoint.recovery_hooks(before={point: self._wait}, timeout=30.0)  # type: ignore[dict-item]

    async def _wait(self, step: hf.checkpoint.RecoveryStep) -> None:
        self.reached.set()
        await self.go_on.wait()

    async def strike(self, system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
        """Strike, and wait until the recovery stands still."""
        strike(system, ref)
        await self.reached.wait()

    async def let_go(self, system: hf.ActorSystem) -> None:
        """Let it go on, and see that it comes to its end."""
        self.go_on.set()
        await until(lambda: not system._homes.recoveries.all())
        self.go_on.clear()
        self.reached.clear()


@pytest.mark.parametrize(
    ("overflow", "kept", "refused"),
    [
        ("block", ["0", "1", "2"], 3),
        ("reject", ["0", "1", "2"], 3),
        ("latest", ["5"], 0),
        ("drop_oldest", ["3", "4", "5"], 0),
        ("drop_newest", ["0", "1", "2"], 0),
    ],
)
async def test_tells_beyond_the_capacity(
    store: str | None, isolation: str, overflow: Any, kept: list[str], refused: int
) -> None:
    """What waited before the crash does not count; what is dropped is a dead letter, and stays dropped (T15)."""
    held = Held()
    capacity = 1 if overflow == "latest" else 3
    async with running(store, recovery_hooks=held.hooks) as system:
        ref = await doer(system, isolation, held=hf.checkpoint.held(capacity, overflow=overflow))
        await ref.ask(Note("before"))
        await system.suspend(ref)
        ref.tell(Note("waits"))
        await held.strike(system, ref)
        failures = 0
        with system.events() as stream:
            for n in range(6):
                try:
                    ref.tell(Note(str(n)))
                except hf.MailboxFull:
                    failures += 1
            dead = [one for one in stream.take() if isinstance(one, hf.events.DeadLetter)]
            letters = [one.message.text for one in dead]
            assert all(one.why.startswith("there was no room while messages were held") for one in dead)
            if store is not None:  # What a root would find that is started now.
                home: Any = ref._cell.host.home.switch  # type: ignore[attr-defined]
                stored = Switch(system._homes, ref._cell, hf.hybrid(), system._homes.journal)
                assert list(stored.open) == list(home.open), "drops are journaled"
            await held.let_go(system)
            told = await event(stream, hf.events.HeldMessages)
        expected = ["before", "waits", *kept]
        assert await ref.ask(Seen(), timeout=30.0) == expected
        assert failures == refused
        assert letters == [n for n in map(str, range(6)) if n not in kept][: 6 - refused - len(kept)]
        assert (told.held, told.dropped, told.refused) == (len(kept), len(letters), refused)
        held.go_on.set()
        await struck(system, ref)
        assert await ref.ask(Seen(), timeout=30.0) == expected, "the replay is the same"
    if store is not None:
        async with running(store) as system:
            ref = await doer(system, isolation)
            assert await ref.ask(Seen(), timeout=30.0) == expected, "also from the store"


async def test_sends_and_asks_wait_at_block_and_come_behind_what_is_held(isolation: str) -> None:
    held = Held()
    async with running(recovery_hooks=held.hooks) as system:
        ref = await doer(system, isolation, held=hf.checkpoint.held(2))
        await held.strike(system, ref)
        ref.tell(Note("1"))
        ref.tell(Note("2"))
        asked = ref.ask(Note("asked"), timeout=30.0)
        late = ref.ask(Note("late"), timeout=0.05)
        sending = asyncio.ensure_future(ref.send(Note("sent")))
        with pytest.raises(hf.AskTimeout) as late_error:
            await late
        assert late_error.value.handled is False, "it waited for room and was never begun"
        assert not asked.done()
        assert not sending.done()
        await held.let_go(system)
        await sending
        assert await asked == 3
        assert await ref.ask(Seen()) == ["1", "2", "asked", "sent"]


async def test_held_asks_keep_their_deadline(isolation: str) -> None:
    """T20: in time it is answered, else not run."""
    held = Held()
    async with running(recovery_hooks=held.hooks) as system:
        ref = await doer(system, isolation, held=hf.checkpoint.held(10))
        await held.strike(system, ref)
        late, patient = ref.ask(Note("late"), timeout=0.05), ref.ask(Note("patient"), timeout=30.0)
        with pytest.raises(hf.AskTimeout):
            await late
        await held.let_go(system)
        assert await patient == 1
        assert await ref.ask(Seen()) == ["patient"]


@pytest.mark.parametrize("overflow", ["latest", "drop_oldest", "drop_newest", "reject"])
async def test_an_ask_that_loses_its_place_hears_of_it(isolation: str, overflow: Any) -> None:
    held = Held()
    async with running(recovery_hooks=held.hooks) as system:
        ref = await doer(system, isolation, held=hf.checkpoint.held(1, overflow=overflow))
        await held.strike(system, ref)
        first, second = ref.ask(Note("first"), timeout=30.0), ref.ask(Note("second"), timeout=30.0)
        loser, winner = (second, first) if overflow in ("reject", "drop_newest") else (first, second)
        with pytest.raises(hf.MailboxFull):
            await loser
        await held.let_go(system)
        assert await winner == 1


async def test_a_send_from_a_recorded_turn_waits_too(isolation: str) -> None:
    held = Held()
    hooks = held.hooks
    async with running() as system:
        system._homes.recoveries.hooks = hooks
        ref, sender = await doer(system, isolation, held=hf.checkpoint.held(2)), await doer(system, "task", "sender")
        await held.strike(system, ref)
        sent = sender.ask(Do(["send a", "send b", "add done"], ref), timeout=30.0)
        await until(lambda: ref._cell.host.home.switch.ledger.backlog(-1) >= 2)  # type: ignore[attr-defined]
        assert not sent.done()
        await held.let_go(system)
        await sent
        assert await ref.ask(Seen()) == ["a", "b"]


class Scan(hf.Message):
    number: int


class Command(hf.Message):
    text: str


class Driver(hf.Actor):
    """Sensors: the latest is enough. Commands: all of them."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    @hf.subscribe("/scan")
    @hf.on(Scan)
    def scan(self, message: Scan) -> None:
        self.seen.append(f"scan {message.number}")

    @hf.subscribe("/command")
    @hf.on(Command)
    def command(self, message: Command) -> None:
        self.seen.append(message.text)

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return list(self.seen)


class Talk(hf.Message[None]): ...


class Talker(hf.Actor):
    @hf.on(Talk)
    async def talk(self, message: Talk) -> None:
        for n in range(3):
            await self.ctx.publish("/scan", Scan(n))
            await self.ctx.publish("/command", Command(str(n)))


@pytest.mark.parametrize("publisher", ["outside", "task", "process", "recorded"])
async def test_each_topic_has_its_own_rule(store: str | None, isolation: str, publisher: str) -> None:
    held = Held()
    rules = {"/scan": hf.checkpoint.held(1, overflow="latest"), "*": hf.checkpoint.held(100, overflow="reject")}
    async with running(store) as system:
        ref = await start(system, isolation, "driver", hf.start(Driver), recovery=hf.hybrid(3600.0, held=rules))
        kind: Any = "process" if publisher == "process" else "task"
        recovery = hf.hybrid() if publisher == "recorded" else None
        talker = await system.start(hf.child("talker", hf.start(Talker), isolation=kind, recovery=recovery))
        await system.publish("/scan", Scan(-1))
        system._homes.recoveries.hooks = held.hooks
        for _ in range(2):
            await held.strike(system, ref)
            if publisher == "outside":
                for n in range(3):
                    await system.publish("/scan", Scan(n))
                    await system.publish("/command", Command(str(n)))
            else:
                await talker.ask(Talk(), timeout=30.0)
            ref.tell(Scan(7))
            await held.let_go(system)
        once = ["0", "1", "scan 2", "2", "scan 7"]
        assert await ref.ask(Seen(), timeout=30.0) == ["scan -1", *once, *once], "only what is published counts"
        await system.publish("/scan", Scan(8))
        await system.publish("/scan", Scan(9))
        assert (await ref.ask(Seen(), timeout=30.0))[-2:] == ["scan 8", "scan 9"], "outside recoveries nothing is lost"
        await system.stop(ref)
        await system.publish("/scan", Scan(10))


async def test_a_bounded_mailbox_keeps_its_own_rule_as_well(isolation: str) -> None:
    held = Held()
    async with running() as system:
        options: Any = {"mailbox": hf.bounded(2, overflow="reject")}
        recovery = hf.hybrid(3600.0, held=hf.checkpoint.held(5))
        ref = await start(system, isolation, "doer", hf.start(Doer), recovery=recovery, **options)
        system._homes.recoveries.hooks = held.hooks
        await held.strike(system, ref)
        ref.tell(Note("1"))
        ref.tell(Note("2"))
        with pytest.raises(hf.MailboxFull):
            ref.tell(Note("3"))
        await held.let_go(system)
        await until(lambda: ref._cell.host.home.switch.ledger.backlog(-1) == 0)  # type: ignore[attr-defined]
        ref.tell(Note("4"))
        assert await ref.ask(Seen(), timeout=30.0) == ["1", "2", "4"]


async def test_whoever_waits_hears_when_the_actor_is_given_up(isolation: str) -> None:
    held = Held()
    async with running(recovery_hooks=held.hooks) as system:
        ref = await doer(system, isolation, held=hf.checkpoint.held(1))
        ref.kill()
        await held.reached.wait()
        ref.tell(Note("held"))
        asked = ref.ask(Note("asked"), timeout=30.0)
        sending = asyncio.ensure_future(ref.send(Note("sent")))
        await asyncio.sleep(0)
        top = system.ref("/app/of-doer", hf.Actor) if isolation == "subtree" else None
        held_by = asyncio.ensure_future(system.stop(top or ref))
        with pytest.raises((hf.ActorStopped, hf.AskFailed)):
            await asked
        if top is None:
            with pytest.raises(hf.ActorStopped):
                await sending
        else:  # It waits for whoever is started there anew, as what was told does.
            await sending
        held.go_on.set()
        await held_by


# -- the other direction ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", ["restart", "replay", "release"])
async def test_nothing_of_a_dead_or_replaying_life_gets_out(
    store: str | None, isolation: str, gate: Path, at: str
) -> None:
    """R34: tells, topics, asks, timers and background work, wherever the recovery stands still."""
    held = Held(at)
    async with running(store) as system:
        ref, notes = await doer(system, isolation), await sink(system)
        await system.start(hf.child("listener", hf.start(Driver)))
        listener = system.ref("/app/listener", Driver)
        await ref.ask(Do(["tell one", "ask two", "send three", "after 3600", "subscribe /none"], notes), timeout=30.0)
        unfinished = ref.ask(Do(["tell four", f"pipe {gate}", f"gate {gate}x", "tell five"], notes), timeout=20.0)
        await until(lambda: Path(f"{gate}x").exists())
        system._homes.recoveries.hooks = held.hooks
        await held.strike(system, ref)
        for _ in range(20):
            await asyncio.sleep(0.005)
        assert await notes.ask(Notes()) == ["one", "two", "three"], "what had left, and nothing again"
        let_through(gate)
        let_through(Path(f"{gate}x"))
        await held.let_go(system)
        await unfinished
        await until(lambda: ref._cell.host.home.switch.ledger.backlog(-1) == 0)  # type: ignore[attr-defined]
        assert await notes.ask(Notes()) == ["one", "two", "three", "four", "five"]
        while len(seen := await ref.ask(Seen(), timeout=30.0)) < 2:
            await asyncio.sleep(0.002)  # The background work was begun anew.
        assert seen == ["two:2", "piped"]
        assert await listener.ask(Seen()) == []


class Parent(hf.Actor):
    """Publishes, and spawns children that speak for themselves."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Tick)
    async def tick(self, message: Tick) -> None:
        self.count += 1
        await self.ctx.publish("/command", Command(f"{message.text} {self.count}"))

    @hf.on(Talk)
    def talk(self, message: Talk) -> None:
        self.ctx.every(0.01, Tick("tick"))


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_timers_go_on_and_what_they_publish_is_heard_once(isolation: str) -> None:
    async with running() as system:
        listener = await system.start(hf.child("listener", hf.start(Driver)))
        ref = await start(system, isolation, "parent", hf.start(Parent), recovery=hf.hybrid(0.03))
        await ref.ask(Talk())
        for n in (3, 6, 9):
            await until(lambda n=n: len(listener._cell.actor.seen) >= n)  # type: ignore[union-attr]
            await struck(system, ref)
        await until(lambda: len(listener._cell.actor.seen) >= 12)  # type: ignore[union-attr]
        heard = await listener.ask(Seen())
        assert heard == [f"tick {n}" for n in range(1, len(heard) + 1)]
        await over(system)
