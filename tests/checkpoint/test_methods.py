"""The four methods: what each promises of state, asks and outputs, by a table and by a model (R3, R8, R39, R72-R74)."""

from __future__ import annotations

import ast
import asyncio
import dataclasses
import inspect
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast as hf
from holdfast.checkpoint.recovery_file import RecoveryFile
from tests.checkpoint.players import Do, Doer, Note, Notes, Seen, Sink, start, until
from tests.checkpoint.strikes import NEVER, event, home, let_through, place_of, strike

pytestmark = pytest.mark.pairs

Ended = Literal["kept", "lost"]


@dataclasses.dataclass(frozen=True)
class Promise:
    """One row of the table in docs/recovery/methods.md."""

    state: str  # what the state is after a crash, of "snapshot" and "since" (the notes taken before and after one)
    open_ask: str  # of an ask whose turn had not ended, and had sent nothing
    open_ask_sent: str  # the same, if its turn had let something out
    queued: str
    repeats: bool  # whether an output ever leaves twice
    start: bool  # whether `on_start(False)` is called again


PROMISES = {
    "fresh": Promise("nothing", "fails", "fails", "kept", False, True),
    "checkpoint_only": Promise("snapshot", "run again", "fails", "kept", False, False),
    "replay_only": Promise("all", "run again", "run again", "kept", False, True),
    "hybrid": Promise("all", "run again", "run again", "kept", False, False),
}


def method(name: str, **options: Any) -> hf.Method:
    """The method of this name, whose snapshots are taken only on demand."""
    interval = {"interval": NEVER} if name in ("hybrid", "checkpoint_only") else {}
    made: hf.Method = getattr(hf, name)(**interval, **options)
    return made


async def snapshot(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Have one taken after the last turn, by whatever would take one."""
    from holdfast.checkpoint.protocol import SnapshotNow

    switch = home(ref)
    turn = switch.turn
    switch.life.port.to_life(SnapshotNow())
    if switch.method.snapshots:
        await until(lambda: switch.ledger.state_turn >= turn)


async def doer(system: hf.ActorSystem, isolation: str, name: str) -> hf.ActorRef[Doer]:
    return await start(system, isolation, "doer", hf.start(Doer), recovery=method(name))


async def back(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Strike, and wait for the next life."""
    life = ref._cell.life
    strike(system, ref)
    await until(lambda: ref._cell.life > life and ref._cell.host.is_up(ref._cell))


@pytest.mark.parametrize("name", PROMISES)
async def test_the_state_after_a_crash(name: str, isolation: str, store: str | None) -> None:
    expected = {"nothing": [], "snapshot": ["before"], "all": ["before", "since"]}[PROMISES[name].state]
    if isolation == "subtree" and name == "fresh":
        pytest.skip("a child of a supervisor in a process ends with it, and what is queued there too")
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await doer(system, isolation, name)
        await ref.ask(Note("before"))
        if name != "fresh":
            await snapshot(system, ref)
        await ref.ask(Note("since"))
        await back(system, ref)
        assert await ref.ask(Seen()) == expected
        await ref.ask(Note("later"))
        await back(system, ref)
        last = ["before", "since", "later"] if PROMISES[name].state == "all" else expected
        assert await ref.ask(Seen()) == last


@pytest.mark.parametrize("name", [name for name in PROMISES if name != "fresh"])
@pytest.mark.parametrize("sent", [False, True], ids=["silent", "sent"])
async def test_an_ask_whose_turn_had_not_ended(name: str, sent: bool, isolation: str, store: str, gate: Path) -> None:
    """What has left, leaves once; an ask ends with a reply or a failure, and never hangs (T19, T20)."""
    promise = PROMISES[name]
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref, notes = await doer(system, isolation, name), await system.start(hf.child("sink", hf.start(Sink)))
        await ref.ask(Do(["tell first", "add first"], notes))
        steps = ["add begun", *(["ask out"] if sent else []), f"gate {gate}", "tell end"]
        asked, behind = ref.ask(Do(steps, notes), timeout=30.0), ref.ask(Note("behind"), timeout=30.0)
        await until(gate.exists)
        gate.unlink()
        strike(system, ref)
        if (promise.open_ask_sent if sent else promise.open_ask) == "run again":
            await until(gate.exists)
            let_through(gate)
            assert await asked
            ended = ["end"]
        else:
            with pytest.raises(hf.AskFailed):
                await asked
            ended = []
        await behind
        assert await notes.ask(Notes()) == ["first", *(["out"] if sent else []), *ended]
        assert "behind" in await ref.ask(Seen()), "what was queued is kept"


@pytest.mark.parametrize("name", PROMISES)
async def test_the_document_has_the_table(name: str) -> None:
    """docs/recovery/methods.md says what is tested here."""
    text = (Path(__file__).parents[2] / "docs/recovery/methods.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    promise = PROMISES[name]
    assert cells[1:] == [
        promise.state,
        promise.open_ask,
        promise.open_ask_sent,
        promise.queued,
        "twice" if promise.repeats else "once",
        "called again" if promise.start else "not called again",
    ]


def test_the_document_has_the_settings() -> None:
    """Each setting of a method, with its default and the methods that have it; and no other."""
    text = (Path(__file__).parents[2] / "docs/recovery/methods.md").read_text()
    lines = text.partition("## Settings\n")[2].partition("\n## ")[0].splitlines()
    rows = [tuple(cell.strip(" `") for cell in line.split("|")[1:4]) for line in lines if line.startswith("| `")]
    expected: dict[str, tuple[object, str]] = {}
    for letter, make in (("h", hf.hybrid), ("c", hf.checkpoint_only), ("r", hf.replay_only)):
        for name, parameter in inspect.signature(make).parameters.items():
            default, letters = expected.get(name, (parameter.default, ""))
            assert default == parameter.default, f"{name} has two defaults"
            expected[name] = default, f"{letters} {letter}".strip()
    documented = {name: (ast.literal_eval(default), letters) for name, default, letters in rows}
    assert documented == expected
    assert len(rows) == len(documented)


def test_the_document_of_the_recovery_file_has_one_that_can_be_read() -> None:
    text = (Path(__file__).parents[2] / "docs/recovery/file.md").read_text()
    file = RecoveryFile(text.partition("```toml\n")[2].partition("```")[0], "recovery.toml")
    tested = file.method_for("/app/lab/one", Doer)
    assert tested is not None
    assert (tested.strict, tested.check_replay) == (True, True)


async def test_what_is_lost_is_counted_and_an_answer_owed_fails_at_once(isolation: str, store: str | None) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await doer(system, isolation, "checkpoint_only")
        await ref.ask(Note("kept"))
        await snapshot(system, ref)
        for n in range(3):
            await ref.ask(Note(f"lost {n}"))
        owed = ref.ask(Do(["later"]), timeout=60.0)
        await ref.ask(Seen())
        with system.events() as stream:
            strike(system, ref)
            lost = await event(stream, hf.events.TurnsLost)
        assert (lost.address, lost.count) == (ref.path, 5)
        with pytest.raises(hf.AskFailed, match="lost"):
            await owed
        assert await ref.ask(Seen()) == ["kept"]


async def test_a_root_that_starts_anew_forgets_the_same_again(tmp_path: Path) -> None:
    """The journal still has the forgotten turns: numbers go on behind them, and they are forgotten once more."""
    store = f"sqlite:{tmp_path / 'app.db'}"
    spec = hf.child("doer", hf.start(Doer), recovery=method("checkpoint_only"))
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await system.start(spec)
        await ref.ask(Note("kept"))
        await snapshot(system, ref)
        await ref.ask(Note("lost"))
        await back(system, ref)
        await ref.ask(Note("lost too"))
        switch = home(ref)
        turn, switch.method = switch.turn, hf.fresh()  # No last snapshot: the root dies here.
        place_of(ref).life.method = method("replay_only")
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await system.start(spec)
        assert await ref.ask(Seen()) == ["kept"]
        assert home(ref).turn == turn + 1


class Gambler(hf.Actor):
    deterministic = False

    def __init__(self) -> None:
        self.seen: list[str] = []

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.seen.append(message.text)
        return len(self.seen)


def test_a_class_that_is_not_deterministic_may_have_snapshots() -> None:
    assert hf.child("x", hf.start(Gambler), recovery=hf.checkpoint_only()).recovery.interval == 2.0
    with pytest.raises(hf.SpecError, match="replay_only cannot replay"):
        hf.child("x", hf.start(Gambler), recovery=hf.replay_only())


@pytest.mark.parametrize("isolation", ["task", "process"], indirect=True)
async def test_replay_alone_never_takes_a_snapshot_and_says_when_its_journal_is_full(
    system: hf.ActorSystem, isolation: str
) -> None:
    ref = await start(
        system, isolation, "doer", hf.start(Doer), recovery=hf.replay_only(journal_limit=5_000), shutdown=8.0
    )
    with system.events() as stream:
        outcomes = await asyncio.gather(*(ref.ask(Note("x")) for _ in range(100)), return_exceptions=True)
        refused = [one for one in outcomes if isinstance(one, hf.MailboxFull)]
        assert 10 < 100 - len(refused) < 5_000 / 200
        full = await event(stream, hf.events.JournalFull)
        assert "takes no snapshots" in full.way_out
        with pytest.raises(hf.MailboxFull):
            await ref.send(Note("x"))  # It would wait for ever.
        await system.stop(ref)
        assert not [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]


async def test_replay_alone_brings_everything_back_over_stops_and_moves(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    spec = hf.child("doer", hf.start(Doer), recovery=hf.replay_only())
    for n in range(3):
        async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
            ref = await system.start(spec)
            await ref.ask(Note(str(n)))
            if n == 1:
                await system.set_isolation(ref, "process")
                await ref.ask(Note("there"))
                await back(system, ref)
                await system.set_isolation(ref, "task")
            if n == 2:
                assert await ref.ask(Seen()) == ["0", "1", "there", "2"]
                with pytest.raises(hf.errors.ControlFailed, match="replay_only takes no snapshots"):
                    await system.replace_state(ref, lambda state: state)


# -- pacing -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pacing", "seconds"), [("fast", 0.0), ("original", 9.0), (3.0, 3.0), (0.5, 18.0)])
@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_replay_waits_as_long_as_there_was_between_its_messages(pacing: Any, seconds: float) -> None:
    """R39, R76: nine seconds of messages; what comes meanwhile is held, and handled behind them."""
    loop = asyncio.get_running_loop()
    async with hf.ActorSystem("app", log=False) as system:
        system._node.clock.wall = lambda: 1000.0 + loop.time()
        ref = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(NEVER, pacing=pacing)))
        for n in range(4):
            ref.tell(Do(["world", f"add {n}"]))
            await asyncio.sleep(3.0)
        seen = await ref.ask(Seen())
        before = loop.time()
        with system.events() as stream:
            ref.kill()
            ref.tell(Note("new"))
            again = await ref.ask(Seen(), timeout=100.0)
            told = [one for one in stream.take() if isinstance(one, hf.events.ReplayPaced)]
        assert loop.time() - before == pytest.approx(seconds, abs=0.01)
        assert again == [*seen, "new"], "ctx.now() is what it was (T24)"
        if seconds:
            assert told[0].turns == 3
            assert told[0].seconds == pytest.approx(seconds)
            assert [one.held for one in told] == [2] * len(told)
            assert sorted((one.seconds for one in told), reverse=True) == [one.seconds for one in told]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_handlers_that_take_their_time_do_not_make_a_paced_replay_longer() -> None:
    """R70 measured the sum of both; here a replay takes no longer than what was recorded, if handlers keep up."""
    loop = asyncio.get_running_loop()
    async with hf.ActorSystem("app", log=False) as system:
        system._node.clock.wall = lambda: 1000.0 + loop.time()
        ref = await system.start(hf.child("slow", hf.start(Slow), recovery=hf.hybrid(NEVER, pacing="original")))
        for _ in range(5):
            ref.tell(Note("x"))
            await asyncio.sleep(1.0)
        before = loop.time()
        ref.kill()
        assert await ref.ask(Note("y"), timeout=100.0) == 6
        assert loop.time() - before == pytest.approx(4.0 + 0.9 + 0.9)


class Slow(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    @hf.on(Note)
    async def note(self, message: Note) -> int:
        await asyncio.sleep(0.9)
        self.count += 1
        return self.count


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_crash_or_a_stop_in_a_paced_replay(store: str | None) -> None:
    """The next one begins again from the beginning (T17); a stop does not wait for it."""
    loop = asyncio.get_running_loop()
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        system._node.clock.wall = lambda: 1000.0 + loop.time()
        ref = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(NEVER, pacing="original")))
        for n in range(5):
            ref.tell(Note(str(n)))
            await asyncio.sleep(10.0)
        for _ in range(3):
            ref.kill()
            await asyncio.sleep(25.0)
        before = loop.time()
        assert await ref.ask(Seen(), timeout=100.0) == list("01234")
        assert loop.time() - before == pytest.approx(15.0, abs=0.01)
        ref.kill()
        await asyncio.sleep(5.0)
        before = loop.time()
        await system.stop(ref)
        assert loop.time() - before < 1.0


# -- each method against its model ------------------------------------------------------------------------------------

ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just("note"), st.integers(0, 99)),
        st.tuples(st.just("later"), st.integers(0, 99)),  # told, and perhaps still queued at the next crash
        st.just(("snapshot", 0)),
        st.just(("crash", 0)),
    ),
    max_size=25,
)


class Model:
    """A state, the last snapshot of it, and what a crash makes of the two."""

    def __init__(self, name: str) -> None:
        self.name, self.state, self.saved = name, list[str](), list[str]()

    def snapshot(self) -> None:
        if self.name in ("hybrid", "checkpoint_only"):
            self.saved = self.state[:]

    def crash(self) -> None:
        if self.name == "checkpoint_only":
            self.state = self.saved[:]
        elif self.name == "fresh":
            self.state = []


@pytest.mark.parametrize("name", PROMISES)
@given(actions=ACTIONS)
@settings(max_examples=40, deadline=None)
def test_random_messages_snapshots_and_crashes(name: str, actions: list[tuple[str, int]]) -> None:
    async def play() -> None:
        model = Model(name)
        async with hf.ActorSystem("app", log=False, intensity=1_000_000) as system:
            ref = await system.start(hf.child("doer", hf.start(Doer), recovery=method(name)))
            queued: list[str] = []
            for action, n in actions:
                if action == "note":
                    await ref.ask(Note(str(n)))
                    model.state += [*queued, str(n)]
                    queued.clear()
                elif action == "later":
                    ref.tell(Note(str(n)))
                    queued.append(str(n))
                elif action == "snapshot" and name != "fresh":
                    model.state += queued
                    queued.clear()
                    await ref.ask(Seen())
                    await snapshot(system, ref)
                    model.snapshot()
                elif action == "crash":  # Ahead of what is queued, which the next life handles.
                    model.crash()
                    await back(system, ref)
                    await ref.ask(Seen())
                    model.state += queued
                    queued.clear()
            assert await ref.ask(Seen()) == [*model.state, *queued]

    asyncio.run(play())


# -- what goes back with the state of a snapshot ----------------------------------------------------------------------


@pytest.mark.some(3)
async def test_timers_and_subscriptions_go_back_with_the_state(isolation: str, store: str | None) -> None:
    """One that was cancelled since comes back, one that was started since does not."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await doer(system, isolation, "checkpoint_only")
        await ref.ask(Do(["after 0.3", "subscribe /kept"]))
        await snapshot(system, ref)
        await ref.ask(Do(["cancel", "every 0.6", "subscribe /lost"]))
        await back(system, ref)
        assert "tick" not in await ref.ask(Seen())
        await system.publish("/lost", Note("lost"))
        await system.publish("/kept", Note("kept"))
        async with asyncio.timeout(30.0):
            while "tick" not in await ref.ask(Seen()):
                await asyncio.sleep(0.01)
        await asyncio.sleep(0.7)
        assert sorted(await ref.ask(Seen())) == ["kept", "tick"]


async def test_a_tick_that_waits_does_not_come_twice(isolation: str, store: str | None, gate: Path) -> None:
    """Its timer is still in the snapshot, and the tick is queued already."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await doer(system, isolation, "checkpoint_only")
        await ref.ask(Do(["after 0.2"]))
        await snapshot(system, ref)
        await ref.ask(Note("lost"))
        ref.tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        await until(lambda: any(source.kind == "tick" for source in home(ref).open.values()))
        gate.unlink()
        strike(system, ref)
        await until(gate.exists)
        let_through(gate)
        await ref.ask(Seen(), timeout=30.0)
        await asyncio.sleep(0.3)  # As long as a second one would take.
        assert await ref.ask(Seen()) == ["tick"]


async def test_a_move_loses_nothing(system: hf.ActorSystem) -> None:
    ref = await doer(system, "task", "checkpoint_only")
    for n, place in enumerate(("process", "task", "process")):
        await ref.ask(Note(str(n)))
        await system.set_isolation(ref, place)  # type: ignore[arg-type]
    assert await ref.ask(Seen()) == ["0", "1", "2"]


@pytest.mark.parametrize("there", ["task", "process"])
async def test_a_move_whose_snapshot_cannot_be_kept_is_given_up(
    system: hf.ActorSystem, there: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The store refuses it: the old life goes on, with all it has."""
    import holdfast.checkpoint.snapshot.snapshot_receiver as of_arrivals

    def full(*_: Any) -> None:
        raise hf.HoldfastError("the disk is full")

    ref = await doer(system, "process" if there == "task" else "task", "checkpoint_only")
    await ref.ask(Note("kept"))
    with monkeypatch.context() as broken:
        broken.setattr(of_arrivals, "cut", full)
        with pytest.raises(hf.errors.CannotMove, match="could not be kept"):
            await system.set_isolation(ref, there)
    assert await ref.ask(Seen()) == ["kept"]
    await system.set_isolation(ref, there)
    assert await ref.ask(Seen()) == ["kept"]


async def test_a_move_whose_snapshot_cannot_be_taken_is_given_up(system: hf.ActorSystem) -> None:
    ref = await doer(system, "task", "checkpoint_only")
    await ref.ask(Note("kept"))
    await ref.ask(Do(["spoil"]))
    with pytest.raises(hf.errors.CannotMove):
        await system.set_isolation(ref, "process")
    assert await ref.ask(Seen()) == ["kept"]
