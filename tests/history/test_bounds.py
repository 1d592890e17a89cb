"""The bounds of the history: how much it keeps, of whatever size, in memory and in a store."""

import asyncio
import gc
import random
import weakref
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import ActorCrashed, ActorStarted, ChildStopped, DeadLetter, LogLine
from holdfast.actors.exit_reasons import SHUTDOWN, Crash, crash
from holdfast.actors.kernel.codec import Parcel
from holdfast.checkpoint.store_opening import open_journal
from holdfast.system.history import recorder, tracks, writer
from holdfast.system.history.intake import alike_events as alike
from holdfast.system.history.intake import quota
from holdfast.system.history.lives import LivesByAddress
from holdfast.system.history.past_event import LONGEST, PastEvent, plain_fields
from holdfast.system.history.raised import raised_at, traceback_text
from holdfast.system.history.ring import EventRing
from holdfast.system.history.shelf import EventShelf, events_in
from holdfast.system.history.writer import prefix
from tests.history.players import Do, Worker, failed, until


def event(number: int, kind: str = "ActorStarted", address: str = "/app/one", **fields: Any) -> PastEvent:
    return PastEvent(number, float(number), kind, address, fields)


# -- what is kept of one event ----------------------------------------------------------------------------------------


class Large(hf.Message):
    data: str


def test_of_a_message_its_type_is_kept_and_its_content_only_if_wanted() -> None:
    letter = DeadLetter("/app/one", Large("x" * 10_000_000), "nobody", "/app/two")
    assert plain_fields(letter) == {
        "message": f"{__name__}.Large",
        "why": "nobody",
        "sender": "/app/two",
    }
    payload = plain_fields(letter, payloads=True)["payload"]
    assert isinstance(payload, str)
    assert len(payload) < LONGEST + 100


class Broken(hf.Message):
    data: str = ""

    def __str__(self) -> str:
        raise ValueError("no text")


def test_what_cannot_be_shown_or_written_hurts_nobody() -> None:
    payload = plain_fields(DeadLetter("/app/one", Broken(), "nobody"), payloads=True)["payload"]
    assert payload == "<its text cannot be shown: ValueError>"
    try:
        raise KeyError("half a pair: \ud800")
    except KeyError as error:
        fields = plain_fields(ActorCrashed("/app/one", 1, crash(error), DeadLetter))
    odd = PastEvent(1, 1.0, "HookFailed", "/app", {**fields, **plain_fields(LogLine("/", "\ud800", "\udfff"))})
    notes: dict[str, bytes] = {}
    EventShelf("h ", {}, lambda name, value: notes.update({name: value or b""}), 50_000).put([odd])
    assert events_in(notes) == [odd]


def test_of_a_message_whose_class_is_not_known_the_type_is_kept() -> None:
    letter = DeadLetter("/app/one", Parcel("shop:Pay", b"secret"), "nobody")
    assert plain_fields(letter)["message"] == "shop.Pay"


def test_an_error_leaves_no_frame_in_memory() -> None:
    class Held:
        pass

    def fail() -> tuple[weakref.ref[Held], dict[str, Any]]:
        held = Held()
        seen = weakref.ref(held)
        try:
            raise KeyError(held)
        except KeyError as error:
            return seen, dict(plain_fields(ActorCrashed("/app/one", 1, crash(error), None)))

    seen, fields = fail()
    gc.collect()
    assert "in fail" in fields["traceback"]
    assert seen() is None


def test_a_traceback_has_a_bounded_length_and_says_where() -> None:
    def deep(left: int) -> None:
        if left:
            deep(left - 1)
        else:
            raise ValueError("x" * 1_000_000)

    def outer() -> None:
        try:
            deep(500)
        except ValueError as error:
            raise RuntimeError("outer") from error

    with pytest.raises(RuntimeError) as raised:
        outer()
    reason = crash(raised.value)
    assert isinstance(reason, Crash)
    text = traceback_text(reason)
    assert len(text) <= 4_000
    assert text.endswith("RuntimeError: outer")
    assert "ValueError: xxx" in text
    assert raised_at(text).startswith("test_bounds.py:")
    assert raised_at("no traceback") == ""


@pytest.mark.parametrize("size", [10, 10_000, 3_000_000])
def test_a_text_of_any_size_is_kept_in_a_bounded_one(size: int) -> None:
    [why] = [
        value
        for name, value in plain_fields(ChildStopped("/a", 1, SHUTDOWN, "", "y" * size)).items()
        if name == "because"
    ]
    assert isinstance(why, str)
    assert len(why) <= min(size, LONGEST + 50)


# -- rings, lives, shelves --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_ring_keeps_the_newest_within_its_bounds(seed: int) -> None:
    chance = random.Random(seed)
    ring = EventRing[PastEvent](50, 40_000)
    told = [event(number, why="x" * chance.choice([0, 100, 5_000])) for number in range(1, 300)]
    for one in told:
        ring.add(one)
        assert len(ring) <= 50
        assert ring.bytes <= 40_000 or len(ring) == 1
        assert list(ring.after(0)) == told[: one.number][-len(ring) :]
    assert ring.dropped == len(told) - len(ring)
    assert [one.number for one in ring.after(297)] == [298, 299]


def test_one_event_that_is_too_large_is_kept_alone() -> None:
    ring = EventRing[PastEvent](50, 1_000)
    ring.add(event(1))
    ring.add(event(2, why="x" * 5_000))
    assert [one.number for one in ring.after(0)] == [2]


def test_lives_are_bounded_at_each_address_and_altogether() -> None:
    lives = LivesByAddress(most=3, most_addresses=2)
    for number in range(1, 10):
        lives.apply(event(number, life=number))
    assert [life.number for life in lives.at("/app/one")] == [7, 8, 9]
    lives.apply(event(10, address="/app/two", life=1))
    lives.apply(event(11, life=10))
    lives.apply(event(12, address="/app/three", life=1))
    assert len(lives) == 2
    assert lives.at("/app/two") == []  # for longest nothing has happened to it
    assert lives.at("/app/one")[-1].number == 10


@pytest.mark.parametrize("seed", range(5))
def test_a_shelf_keeps_the_newest_and_goes_on_behind_an_earlier_one(seed: int) -> None:
    chance = random.Random(seed)
    notes: dict[str, bytes] = {}

    def write(name: str, value: bytes | None) -> None:
        notes.pop(name, None)
        if value is not None:
            notes[name] = value

    number = 0
    for _ in range(4):
        shelf = EventShelf("h ", dict(notes), write, 200_000)
        for _ in range(50):
            batch = [event(number + i, why="x" * chance.randrange(2_000)) for i in range(1, chance.randrange(2, 20))]
            number = batch[-1].number
            shelf.put(batch)
            assert sum(map(len, notes.values())) <= 200_000 + 40_000
    kept = [one.number for one in events_in(notes)]
    assert kept == list(range(kept[0], number + 1))
    assert len(kept) > 50


def test_a_batch_larger_than_the_shelf_leaves_its_newest() -> None:
    notes: dict[str, bytes] = {}
    EventShelf("h ", {}, lambda name, value: notes.update({name: value or b""}), 50_000).put(
        [event(number, why="x" * 1_000) for number in range(1, 1_000)]
    )
    kept = [one.number for one in events_in(notes)]
    assert kept[-1] == 999
    assert 30 < len(kept) <= 50


def test_a_damaged_note_is_passed_over() -> None:
    notes: dict[str, bytes] = {}
    EventShelf("h ", {}, lambda name, value: notes.update({name: value or b""}), 50_000).put([event(1)])
    assert [one.number for one in events_in({"h 0": b"\xc1", "h 2": b"", **notes, "h 9": b"\x92\x01"})] == [1]


# -- storms -----------------------------------------------------------------------------------------------------------


def others_are(monkeypatch: pytest.MonkeyPatch, **bounds: Any) -> None:
    """Have less room for events that are neither rare nor dead letters."""
    changed = {**tracks.BOUNDS, "others": tracks.BOUNDS["others"]._replace(**bounds)}
    monkeypatch.setattr(recorder, "BOUNDS", changed)


async def test_a_storm_is_recorded_in_part_and_no_more_events_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    others_are(monkeypatch, burst=50, per_second=20.0)
    async with hf.ActorSystem("app", log=False, intensity=100_000, period=0.001) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        for _ in range(200):
            await failed(worker, "crash")
        hub = system._node.events
        assert not hub.has_listeners
        assert hub.hears_letters
        recorded = len(system.history(worker).events)
        assert 20 < recorded < 100
        assert "Events are left out at the moment" in " ".join(await system.why(worker))
        await until(lambda: system.history(kinds=["EventsLeftOut"]).events)
        assert hub.has_listeners
        await failed(worker, "crash")
        await worker.ask(Do("well"))
        assert system.lives(worker)[-1].number == 202


async def test_what_a_history_does_not_keep_is_made_for_those_who_listen() -> None:
    """The phases of a recovery: five events for each actor of a tree that comes back."""
    async with hf.ActorSystem("app", log=False) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker), recovery=hf.hybrid()))
        hub = system._node.events
        assert hub.has_listeners
        assert not hub.hears_unkept
        with system.events() as events:
            assert hub.hears_unkept
            worker.kill()
            while (await events.until(hf.events.RecoveryPhase)).phase != "release":
                pass
        assert not hub.hears_unkept


async def test_who_listens_gets_all_events_of_a_storm(monkeypatch: pytest.MonkeyPatch) -> None:
    others_are(monkeypatch, burst=10, per_second=20.0)
    async with hf.ActorSystem("app", log=False, intensity=100_000, period=0.001) as system:
        with system.events() as events:
            worker = await system.start(hf.child("worker", hf.start(Worker)))
            for _ in range(50):
                await failed(worker, "crash")
            await worker.ask(Do("well"))
            assert sum(isinstance(one, ActorStarted) and one.address == worker.path for one in events.take()) == 51


async def test_what_is_rare_is_recorded_in_the_middle_of_a_storm(monkeypatch: pytest.MonkeyPatch) -> None:
    others_are(monkeypatch, burst=10, per_second=0.001)
    async with hf.ActorSystem("app", log=False, intensity=100_000, period=0.001) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        await system.start(hf.supervisor("weak", intensity=0, children=[hf.child("one", hf.start(Worker))]))
        one = system.ref("/app/weak/one", Worker)
        for _ in range(30):
            await failed(worker, "crash")
        await failed(one, "crash")
        await until(lambda: system.history(kinds=["SupervisorGaveUp"]).events)


async def test_dead_letters_leave_the_others_alone() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        await failed(worker, "crash")
        await system.stop(worker)
        for _ in range(9_000):
            worker.tell(Do("well"))
        assert system.dead_letters == 9_000
        assert len(system.history(kinds=["DeadLetter"]).events) == alike.FIRST
        assert not system._node.events.hears_letters
        assert [one.kind for one in system.history(worker.path).events][:2] == ["ActorStarted", "ActorCrashed"]


# -- events that are alike --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
@pytest.mark.parametrize("overflow", ["drop_oldest", "drop_newest", "latest"])
async def test_what_a_mailbox_drops_by_its_policy_is_counted(tmp_path: Path, overflow: Any, recovery: Any) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        one = hf.child("worker", hf.start(Worker), mailbox=hf.bounded(1, overflow=overflow), recovery=recovery)
        worker = await system.start(one)
        await system.suspend(worker)
        for _ in range(201):
            worker.tell(Do("well"))
        dropped, why = system.dead_letters, f"mailbox full (1, {overflow})"
        assert dropped >= 199
        [letter] = system.history(kinds=["DeadLetter"]).events
        assert letter.fields["why"] == why
    async with hf.ActorSystem("app", store=store, log=False) as system:
        letters = [one for one in system.history(kinds=["DeadLetter"]).events if one.fields["why"] == why]
        assert [letter.fields.get("alike") for letter in letters] == [None, dropped - 1]
        assert [letter.fields["message"] for letter in letters] == ["tests.history.players.Do"] * 2


async def test_dead_letters_that_nobody_has_chosen_are_told_one_by_one_and_then_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorder, "EVERY", 0.05)
    async with hf.ActorSystem("app", log=False) as system:
        for name in ("one", "two"):
            worker = await system.start(hf.child(name, hf.start(Worker)))
            await system.stop(worker)
            for _ in range(alike.FIRST + 7):
                worker.tell(Do("well"))

        def counted() -> list[Any]:
            rows = [one for one in system.history(kinds=["DeadLetter"]).events if "alike" in one.fields]
            return [(row.address, row.fields["alike"], row.fields["why"]) for row in rows]

        assert len(system.history(kinds=["DeadLetter"]).events) == 2 * alike.FIRST
        await until(lambda: len(counted()) == 2)
        assert counted() == [(f"/app/{name}", 7, "the actor has stopped") for name in ("one", "two")]


@pytest.mark.parametrize(
    "told",
    [
        hf.events.TurnSlow("/app/one", "tests:Do", 0.3),
        hf.events.Masked("/app/one", "/app/one/ftm/r1", "7"),
        hf.events.FrameRefused("/app/one", "/app/one/ftm/r1", "forged", 1),
        hf.events.LoopLagged("/app", 0.3),
        hf.events.DeadLetter("/app/one", Large("x"), "refused: no"),
    ],
    ids=lambda told: type(told).__name__,
)
async def test_one_rule_holds_for_all_that_may_come_as_often_as_messages(told: hf.events.Event) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        for _ in range(400):
            system._node.emit(told)
        assert len(system.history(told.address, kinds=[type(told).__name__]).events) == alike.FIRST
        assert not system.history(kinds=["EventsLeftOut"]).events


async def test_sorts_that_are_told_apart_are_bounded_and_what_was_counted_of_them_is_told() -> None:
    counter = alike.AlikeCounter()
    letters = [
        DeadLetter(f"/app/{number}", Large("x"), "mailbox full (1, latest)") for number in range(alike.MOST_SORTS + 1)
    ]
    letter = letters[-1]
    for letter in letters:
        assert [counter.counts(letter, 0.0) for _ in range(3)] == [False, True, True]
    rows = counter.take_rows()
    assert len(rows) == alike.MOST_SORTS + 1
    assert {(kind, fields["alike"]) for kind, _, fields in rows} == {("DeadLetter", 2)}
    assert counter.take_rows() == []
    counter.counts(letter, 0.0)
    counter.forget(letter.address)
    assert counter.take_rows() == []


async def test_many_events_that_go_on_are_written_more_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "PACE", 0.01)
    monkeypatch.setattr(writer, "LONGEST_PACE", 60.0)
    monkeypatch.setattr(writer, "BURST_BYTES", 64 * 1024)
    async with hf.ActorSystem("app", log=False, history=False) as system:
        store = Refusing()
        kept = recorder.HistoryRecorder(system._node, store, log_payloads=False)
        for number in range(100):
            system._node.emit(hf.events.HookFailed(f"/app/{number}", "on_stop", SHUTDOWN))
            await asyncio.sleep(0.02)
        assert 2 < store.tries < 20
        kept.close()
        assert len(writer.stored(store)) == 102


def test_the_start_of_a_crowd_leaves_room_for_what_follows() -> None:
    bucket = quota.EventQuota(100, 1.0, 0.0)
    taken = sum(bucket.take(0.0, least=50.0) for _ in range(1_000))
    assert taken == 51
    assert sum(bucket.take(0.0) for _ in range(1_000)) == 49


async def test_a_storm_does_not_drive_out_what_is_rare(monkeypatch: pytest.MonkeyPatch) -> None:
    others_are(monkeypatch, most=20)
    async with hf.ActorSystem("app", log=False, intensity=100_000, period=0.001) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker)))
        system._node.emit(hf.events.MessageQuarantined("/app/worker", "tests:Do", 3))
        for _ in range(50):
            await failed(worker, "crash")
        events = system.history(worker).events
        assert [one.kind for one in events].count("MessageQuarantined") == 1
        assert len(events) <= 21
        assert system.history().dropped > 100


async def test_lines_and_snapshots_are_not_kept() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        before = system.history().next
        system._node.emit(LogLine("/app/one", "stdout", "hello"))
        assert system.history().next == before


# -- the store --------------------------------------------------------------------------------------------------------


async def test_the_store_has_a_bounded_part_of_it(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    for _ in range(3):
        async with hf.ActorSystem("app", store=store, log=False) as system:
            for number in range(1_500):
                system._node.emit(hf.events.HookFailed(f"/app/{number}", "on_stop " + "x" * 1_500, SHUTDOWN))
                if number % 500 == 0:
                    await asyncio.sleep(0.3)
    engine = open_journal(store, takeover=False)
    try:
        notes = engine.notes(prefix("others"))
        assert sum(map(len, notes.values())) <= tracks.BOUNDS["others"].stored_bytes + 64 * 1024
        kept = [one.number for one in events_in(notes)]
        assert kept == list(range(kept[0], kept[-1] + 1))
    finally:
        engine.close()


class Refusing:
    """Keeps notes, or refuses to."""

    def __init__(self) -> None:
        self.kept: dict[str, bytes] = {}
        self.refuses = False
        self.tries = 0

    def note(self, key: str, value: bytes | None) -> None:
        self.tries += 1
        if self.refuses:
            raise hf.errors.StoreFailed("store", "no room")
        self.kept.pop(key, None)
        if value is not None:
            self.kept[key] = value

    def notes(self, prefix: str) -> dict[str, bytes]:
        return {key: value for key, value in self.kept.items() if key.startswith(prefix)}


async def test_a_store_that_is_full_hurts_nobody_and_is_told_of_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "RETRY", 0.05)
    monkeypatch.setattr(writer, "PACE", 0.01)
    async with hf.ActorSystem("app", log=False, history=False) as system:
        store = Refusing()
        kept = recorder.HistoryRecorder(system._node, store, log_payloads=False)
        store.refuses = True
        with system.events() as events:
            worker = await system.start(hf.child("worker", hf.start(Worker)))
            await failed(worker, "crash")
            await until(lambda: store.tries > 3)
            told = [one for one in events.take() if isinstance(one, hf.events.HistoryNotKept)]
            assert [one.reason for one in told] == ["store store failed: no room"]
            assert [one.kind for one in kept.after(0)][-1] in ("HistoryNotKept", "ActorStarted")
            store.refuses = False
            await until(lambda: "HistoryNotKept" in {one.kind for one in writer.stored(store)})
        assert [one.number for one in writer.stored(store)] == [one.number for one in kept.after(0)]
        kept.close()


async def test_ends_that_never_come_are_forgotten() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        kept = system._history
        assert kept is not None
        for number in range(3_000):
            kept.expect(f"/app/{number}", "the program", "")
        assert len(kept._expected) == recorder.MOST_EXPECTED


async def test_an_address_with_the_signs_of_patterns_is_just_itself() -> None:
    async with hf.ActorSystem("app", log=False, intensity=10) as system:
        star, other = [await system.start(hf.child(name, hf.start(Worker))) for name in ("w*", "w[1]")]
        await failed(star, "crash")
        await failed(other, "crash")
        assert {one.address for one in system.history(star).events} == {"/app/w*"}
        assert {one.address for one in system.history(other).events} == {"/app/w[1]"}
        assert "/app/w* ended" in " ".join(await system.why(star))
