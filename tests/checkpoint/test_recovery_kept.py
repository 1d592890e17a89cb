"""What an actor keeps for later comes back too: timers, stash, replies; and snapshots shorten the replay (T9-T28).

Inputs that are no messages of others are recorded with their time too (R24, R75).
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Note, Notes, Seen, Unsavable, start, until
from tests.checkpoint.strikes import NEVER, doer, event, let_through, sink, snapshot_after, strike, struck

# -- time, chance, what is kept for later -----------------------------------------------------------------------------


async def test_time_and_chance_are_the_same_under_replay(system: hf.ActorSystem, isolation: str) -> None:
    """T21."""
    ref = await doer(system, isolation)
    for _ in range(3):
        await ref.ask(Do(["world", "world"]))
    before = await ref.ask(Seen())
    assert len(set(before)) == 3 + 6 + 6, "three times; different numbers at each draw"
    await struck(system, ref)
    assert await ref.ask(Seen()) == before


async def test_timers_survive(system: hf.ActorSystem, isolation: str) -> None:
    """T22: the clock runs at the home, whoever lives; a tick that fell due in between waits."""
    ref = await doer(system, isolation)
    await ref.ask(Do(["after 0.2"]))
    await struck(system, ref)
    while await ref.ask(Seen()) == []:
        await asyncio.sleep(0.01)
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["tick"]


@pytest.mark.parametrize("interval", [0.01, NEVER])
async def test_a_cancelled_timer_ticks_no_more_not_even_from_the_queue(
    system: hf.ActorSystem, isolation: str, gate: Path, interval: float
) -> None:
    ref = await doer(system, isolation, interval=interval)
    await ref.ask(Do(["after 0.01"]))
    busy = ref.ask(Do([f"gate {gate}", "cancel"]), timeout=30.0)
    switch = ref._cell.host.home.switch  # type: ignore[attr-defined]
    await until(lambda: any(source.kind == "tick" for source in switch.open.values()))
    let_through(gate)
    await busy
    assert await ref.ask(Seen()) == []
    if interval < 1:
        await snapshot_after(system, ref, switch.turn)
    await struck(system, ref)
    assert await ref.ask(Seen()) == []


@pytest.mark.parametrize("interval", [0.01, NEVER])
async def test_the_stash_survives(system: hf.ActorSystem, isolation: str, interval: float) -> None:
    """With snapshots and without; unstashed messages come in their order, before what is queued."""
    ref = await doer(system, isolation, interval=interval)
    asked = [ref.ask(Do([f"stash {n}"]), timeout=30.0) for n in range(3)]
    await ref.ask(Seen())
    if interval < 1:
        await snapshot_after(system, ref, 3)
    await struck(system, ref)
    opened = ref.ask(Do(["unstash"]), timeout=30.0)
    last = ref.ask(Note("last"), timeout=30.0)
    assert [await one for one in (opened, *asked)] == ["1", "2", "3", "4"]
    assert await last == 5
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["open", "0", "1", "2", "last"]


class Shutter(hf.Actor):
    """Takes one note each time it is opened; the others wait."""

    def __init__(self) -> None:
        self.is_open = False
        self.taken: list[str] = []

    @hf.on(Note)
    def note(self, message: Note) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        self.is_open = False
        self.taken.append(message.text)
        return len(self.taken)

    @hf.on(Do)
    def open(self, message: Do) -> str:
        self.is_open = True
        self.ctx.unstash()
        return ""

    @hf.on(Seen)
    def read(self, message: Seen) -> list[str]:
        return list(self.taken)


@pytest.mark.parametrize("recovery", [hf.hybrid(interval=NEVER), hf.replay_only()], ids=["hybrid", "replay"])
async def test_what_was_put_aside_again_is_not_handled_twice(
    system: hf.ActorSystem, isolation: str, recovery: Any
) -> None:
    """The replay has each of its turns in the queue before the first of them has put it back."""
    ref = await start(system, isolation, "shutter", hf.start(Shutter), recovery=recovery)
    asked = [ref.ask(Note(text), timeout=30.0) for text in "abcd"]
    await ref.ask(Do([]), timeout=30.0)
    assert await asked[0] == 1
    await struck(system, ref)
    with system.events() as events:
        for n in (2, 3, 4):
            await ref.ask(Do([]), timeout=30.0)
            assert await asked[n - 1] == n
        await ref.ask(Do([]), timeout=30.0)
        assert await ref.ask(Seen(), timeout=30.0) == list("abcd")
    assert not [one for one in events.take() if isinstance(one, hf.events.ActorCrashed | hf.events.TrustBreached)]


async def test_a_stashed_message_that_crashes_later_is_not_run_again(system: hf.ActorSystem, isolation: str) -> None:
    """Replay stashes and unstashes it once more; its own turn failed, so it must not come a second time."""
    ref = await doer(system, isolation)
    bad = ref.ask(Do(["stash bad", "raise when open"]), timeout=30.0)
    good = ref.ask(Do(["stash good"]), timeout=30.0)
    await ref.ask(Do(["unstash"]), timeout=30.0)
    with pytest.raises(hf.RemoteCrash):
        await bad
    assert await good == "2"
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["open", "good"]


@pytest.mark.parametrize("interval", [0.01, NEVER])
async def test_delayed_replies_survive(system: hf.ActorSystem, isolation: str, interval: float) -> None:
    ref = await doer(system, isolation, interval=interval)
    asked = [ref.ask(Do(["later"]), timeout=30.0) for _ in range(2)]
    await ref.ask(Seen())
    if interval < 1:
        await snapshot_after(system, ref, 3)
    await struck(system, ref)
    await ref.ask(Do(["reply first"]))
    await struck(system, ref)
    await ref.ask(Do(["reply second"]))
    assert [await one for one in asked] == ["first", "second"]


async def test_results_of_background_work_come_once(system: hf.ActorSystem, isolation: str, gate: Path) -> None:
    ref = await doer(system, isolation, interval=0.01)
    await ref.ask(Do([f"pipe {gate}"]))
    await until(gate.exists)
    await struck(system, ref)
    let_through(gate)
    while await ref.ask(Seen()) == []:
        await asyncio.sleep(0.005)
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["piped"]


async def test_background_work_that_fails_crashes_the_actor_once(
    system: hf.ActorSystem, isolation: str, tmp_path: Path
) -> None:
    ref = await doer(system, isolation)
    with system.events() as stream:
        await ref.ask(Do([f"burst {tmp_path}/runs", "add kept"]))
        await event(stream, hf.events.Recovered)
    await struck(system, ref)
    assert await ref.ask(Seen()) == ["kept"]
    assert (tmp_path / "runs").read_text() == "x", "not begun again"


async def test_what_is_published_during_recovery_is_not_lost(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation)
    await ref.ask(Do(["subscribe /news"]))
    published: list[str] = []

    def publish(event: hf.events.Event) -> None:
        if isinstance(event, hf.events.ChildRestarted):  # The old life is over, the new one has not begun.
            published.append(str(len(published)))
            for cell in system._node.topics.subscribers("/news"):
                cell.ref.tell(Note(published[-1]))

    system._node.events.add_sink(publish)
    for _ in range(3):
        await struck(system, ref)
    assert await ref.ask(Seen()) == published == ["0", "1", "2"]


async def test_the_stash_is_in_the_store(tmp_path: Path) -> None:
    """A snapshot covers the turn that stashed, not the message: that must stay in the journal."""
    store = f"sqlite:{tmp_path}/app.db"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await doer(system, "task", interval=0.01)
        for n in range(3):
            ref.tell(Do([f"stash {n}"]))
        await ref.ask(Note("x"))
        await snapshot_after(system, ref, 4)
        ref.tell(Note("y"))
        await snapshot_after(system, ref, 5)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await doer(system, "task")
        await ref.ask(Do(["unstash"]))
        assert await ref.ask(Seen()) == ["x", "y", "open", "0", "1", "2"]


# -- snapshots --------------------------------------------------------------------------------------------------------


async def test_snapshots_are_taken_while_turns_are_in_flight_and_cut_the_journal(
    system: hf.ActorSystem, isolation: str
) -> None:
    """T9, T10: never in the middle of a turn, and nothing is applied twice or left out."""
    ref, notes = await doer(system, isolation, interval=0.005), await sink(system)
    for n in range(60):
        ref.tell(Do([f"add {n}", f"ask {n}", f"tell x{n}"], notes))
        if n % 20 == 19:
            strike(system, ref)
            await ref.ask(Note("-"), timeout=30.0)
    seen = [text for text in await ref.ask(Seen(), timeout=30.0) if text != "-"]
    assert seen == [text for n in range(60) for text in (str(n), f"{n}:{2 * n + 1}")]
    assert await notes.ask(Notes()) == [text for n in range(60) for text in (str(n), f"x{n}")]
    switch: Any = ref._cell.host.home.switch  # type: ignore[attr-defined]
    await snapshot_after(system, ref, switch.turn)
    assert not switch.turns
    assert not switch.ledger.outcomes
    assert switch.ledger.journal_bytes == 0


async def test_a_snapshot_that_fails_is_told_and_tried_again(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation, interval=0.02)
    await ref.ask(Note("1"))
    await snapshot_after(system, ref, 1)
    with system.events() as stream:
        await ref.ask(Do(["add 2", "spoil"]))
        assert "spoiled" in (await event(stream, hf.events.SnapshotFailed)).reason
        await event(stream, hf.events.SnapshotFailed)
        await struck(system, ref)
        assert await ref.ask(Seen()) == ["1", "2"], "the older snapshot and the journal are still there"
        await ref.ask(Do(["mend"]))
        assert (await event(stream, hf.events.SnapshotTaken)).turn >= 3
    assert ref._cell.life == 2


async def test_a_state_that_cannot_be_saved_is_refused_at_the_start(system: hf.ActorSystem, isolation: Any) -> None:
    with pytest.raises(hf.StartFailed, match=r"Unsavable\.lock.*Lock"):
        await start(system, isolation, "bad", hf.start(Unsavable), recovery=hf.hybrid())


async def test_the_journal_limit_refuses_and_a_snapshot_makes_room(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation, journal_limit=20_000)
    for n in range(30):
        while True:
            try:
                ref.tell(Note(f"{n} " + "x" * 1000))
                break
            except hf.MailboxFull:
                await ref.send(Note("room"))
    seen = [text.split(" ")[0] for text in await ref.ask(Seen(), timeout=30.0)]
    assert [text for text in seen if text != "room"] == [str(n) for n in range(30)]
    assert "room" in seen
