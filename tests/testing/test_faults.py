"""Faults: at each point they strike, and what is promised of that point holds all the same.

The table of points in docs/testing.md is compared with `POINTS` here, and every point has a test of its name.
"""

import asyncio
import random
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel import loop
from holdfast.testing import POINTS, Faults, GuardedSystem, Probe, UnexpectedEnd, idle
from holdfast.testing.damage import damaged
from holdfast.testing.faults import InjectedCrash
from holdfast.testing.fleet.sim_fleet import SimFleet, SimProgram
from tests.testing.players import Add, Counter, Linger, Total

virtual = pytest.mark.asyncio(loop_factories=["virtual"])
Ref = hf.ActorRef[Counter]


@pytest.fixture
def faults() -> Faults:
    return Faults(17)


@pytest.fixture
async def counter(actor_system: GuardedSystem) -> Ref:
    """Supervised, in this process."""
    return await actor_system.start(hf.child("counter", hf.start(Counter)))


def now() -> float:
    return asyncio.get_running_loop().time()


# -- choosing --------------------------------------------------------------------------------------------------------


async def test_the_same_seed_strikes_the_same_chances(actor_system: GuardedSystem) -> None:
    ref = actor_system.spawn(hf.start(Counter))

    def struck(seed: int) -> list[int]:
        with Faults(seed).on(ref, at="admit", drop=0.3) as strikes:
            for _ in range(50):
                ref.tell(Add(1))
        return [strike.number for strike in strikes.struck]

    runs = [struck(seed) for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]
    assert 5 < len(runs[0]) < 30


async def test_after_and_times_choose_the_chances(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="admit", drop=1.0, after=2, times=3) as strikes:
        for _ in range(10):
            counter.tell(Add(1))
    assert [strike.number for strike in strikes.struck] == [3, 4, 5]
    assert await counter.ask(Total()) == 7
    assert str(faults.strikes[0]) == "drop at 'admit' of /app/counter, chance 3: Add(n=1)"


@pytest.mark.parametrize(
    ("at", "odds", "text"),
    [
        ("nowhere", {"drop": 1.0}, "at must be one of admit, turn begin"),
        ("admit", {"crash": 1.0}, "at 'admit' there can be drop, delay, duplicate, reorder, corrupt, not 'crash'"),
        ("admit", {}, "give at least one probability"),
        ("admit", {"drop": 0.7, "delay": 0.7}, "together at most 1"),
        ("frame out", {"drop": 0.1}, "/app/counter has no process of its own"),
        ("journal append", {"fail": 0.1}, "/app/counter has no journal in a durable store"),
        ("process start", {"fail": 0.1}, "'process start' is a point of a system"),
    ],
)
async def test_what_cannot_strike_is_refused(
    counter: Ref, faults: Faults, at: str, odds: dict[str, Any], text: str
) -> None:
    with pytest.raises(hf.SpecError, match=text):
        faults.on(counter, at=at, **odds)


async def test_only_turns_are_handled_again_in_a_replay(counter: Ref, faults: Faults) -> None:
    with pytest.raises(hf.SpecError, match="replays=True is for 'turn begin' and 'turn end', not for 'admit'"):
        faults.on(counter, at="admit", drop=1.0, replays=True)


async def test_a_failure_lists_what_struck(counter: Ref, faults: Faults) -> None:
    async def lose() -> None:
        async with faults.on(counter, at="admit", drop=1.0, times=1):
            counter.tell(Add(1))
            assert await counter.ask(Total()) == 1

    with pytest.raises(AssertionError) as failure:
        await lose()
    assert failure.value.__notes__ == ["faults that struck:\n  drop at 'admit' of /app/counter, chance 1: Add(n=1)"]


async def test_the_end_puts_everything_back(counter: Ref, faults: Faults) -> None:
    cell = counter._cell
    admit, table = cell.admit, cell.table
    run_turns = loop.run_turns
    faults.on(counter, at="admit", drop=1.0)
    faults.on(counter, at="turn begin", crash=1.0)
    faults.on(counter, at="reply", drop=1.0)
    faults.end()
    faults.end()
    assert (cell.admit, cell.table, loop.run_turns) == (admit, table, run_turns)
    assert await counter.ask(Add(5)) == 5


@virtual
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
@pytest.mark.parametrize("first", ["admit", "reply", "turn begin"])
@pytest.mark.parametrize("second", ["admit", "reply", "turn end"])
async def test_faults_strike_only_within_their_contexts_which_end_in_any_order(
    actor_system: GuardedSystem, faults: Faults, first: str, second: str, recovery: hf.Method | None
) -> None:
    counter = await actor_system.start(hf.child("counter", hf.start(Counter), recovery=recovery))
    one = faults.on(counter, at=first, delay=1.0, seconds=9.0)
    two = faults.on(counter, at=second, delay=1.0, seconds=20.0)
    assert await counter.ask(Add(1), timeout=60.0) == 1
    assert now() == pytest.approx(29.0)
    one.end()
    assert await counter.ask(Add(1), timeout=60.0) == 2
    assert now() == pytest.approx(49.0), "the other one still strikes"
    two.end()
    assert await counter.ask(Add(1), timeout=60.0) == 3
    assert now() == pytest.approx(49.0)
    assert [strike.at for strike in faults.strikes].count(first) == 1 + (first == second) * 2


@virtual
@pytest.mark.parametrize("at", ["admit", "reply"])
async def test_what_is_delayed_goes_on_when_the_faults_end(counter: Ref, faults: Faults, at: str) -> None:
    async with faults.on(counter, at=at, delay=1.0, seconds=9.0):
        answer = counter.ask(Add(1), timeout=60.0)
        await asyncio.sleep(2.0)
        assert not answer.done()
    assert (await answer, now()) == (1, 2.0)


# -- admit -----------------------------------------------------------------------------------------------------------


@virtual
async def test_admit_drop_ends_an_ask_at_its_deadline_surely_not_handled(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="admit", drop=1.0):
        with pytest.raises(hf.AskTimeout) as late:
            await counter.ask(Add(1), timeout=30.0)
    assert late.value.handled is False
    assert now() == 30.0
    assert await counter.ask(Total()) == 0


@virtual
async def test_admit_delay_comes_later(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="admit", delay=1.0, seconds=3.0, times=1):
        asked = counter.ask(Add(1))
        assert await counter.ask(Add(10)) == 10
        assert await asked == 11
        assert now() == 3.0


async def test_admit_duplicate_is_handled_twice_and_answered_once(
    actor_system: GuardedSystem, counter: Ref, faults: Faults
) -> None:
    async with faults.on(counter, at="admit", duplicate=1.0, times=1):
        assert await counter.ask(Add(1)) == 1
    assert await counter.ask(Total()) == 2
    assert actor_system.late_replies == 1


async def test_admit_reorder_comes_after_the_next(probe: Probe, faults: Faults) -> None:
    async with faults.on(probe.ref, at="admit", reorder=1.0, times=1):
        for n in range(3):
            probe.ref.tell(Add(n))
    for n in (1, 0, 2):
        await probe.expect(Add(n))
    async with faults.on(probe.ref, at="admit", reorder=1.0):
        probe.ref.tell(Add(7))
        await probe.expect_no_message()
    await probe.expect(Add(7))


async def test_a_reordered_ask_that_stays_alone_is_late_and_not_lost(
    actor_system: GuardedSystem, faults: Faults
) -> None:
    counter = actor_system.spawn(hf.start(Counter))
    async with faults.on(counter, at="admit", reorder=1.0, seconds=0.01) as strikes:
        assert await counter.ask(Add(1)) == 1
    assert [strike.kind for strike in strikes.struck] == ["reorder"]


async def test_admit_corrupt_is_another_value_of_the_same_type(probe: Probe, faults: Faults) -> None:
    async with faults.on(probe.ref, at="admit", corrupt=1.0):
        probe.ref.tell(Add(5))
    assert (await probe.expect(Add)).n != 5


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_admit_faults_stay_with_the_address_over_a_restart(
    actor_system: GuardedSystem, faults: Faults, recovery: hf.Method | None
) -> None:
    actor_system.expect_crashes(1)
    counter = await actor_system.start(hf.child("counter", hf.start(Counter), recovery=recovery))
    async with faults.on(counter, at="admit", drop=1.0, after=2) as strikes:
        counter.tell(Add(-1))
        await idle(actor_system)
        counter.tell(Add(1))
        counter.tell(Add(1))
    assert len(strikes.struck) == 1
    assert await counter.ask(Total()) == 1


# -- turns -----------------------------------------------------------------------------------------------------------


async def test_turn_begin_crash_leaves_the_state_and_the_queue(
    actor_system: GuardedSystem, faults: Faults, counter: Ref
) -> None:
    actor_system.expect_crashes(1)
    async with faults.on(counter, at="turn begin", crash=1.0, times=1):
        struck, next_one = counter.ask(Add(1)), counter.ask(Add(2))
        with pytest.raises(hf.RemoteCrash, match=r"injected crash at 'turn begin', chance 1 \(seed 17\)"):
            await struck
        assert await next_one == 2
    assert counter._cell.life == 2


@virtual
@virtual
@pytest.mark.parametrize("at", ["turn begin", "turn end"])
@pytest.mark.parametrize("replays", [False, True])
async def test_turns_of_a_replay_are_struck_only_if_that_is_said(
    actor_system: GuardedSystem, faults: Faults, at: str, replays: bool
) -> None:
    """The next life begins behind a back-off, when the fault for the message after it is there already."""
    spec = hf.child("counter", hf.start(Counter), recovery=hf.replay_only(), backoff=hf.Backoff())
    counter = await actor_system.start(spec)
    assert await counter.ask(Add(1)) == 1
    actor_system.expect_crashes()
    async with faults.on(counter, at=at, crash=1.0, times=1):
        with pytest.raises(hf.RemoteCrash):
            await counter.ask(Add(10))
    await idle(actor_system)
    assert (await actor_system.get_status(counter)).state == "restarting", "`idle` waits for no time to pass"
    async with faults.on(counter, at=at, crash=1.0, times=1, replays=replays) as strikes:
        answers = await asyncio.gather(counter.ask(Add(100)), return_exceptions=True)
    assert [strike.what for strike in strikes.struck] == ["Add(n=1)" if replays else "Add(n=100)"]
    assert isinstance(answers[0], hf.RemoteCrash) is not replays
    assert await counter.ask(Total(), timeout=60.0) == (101 if replays else 1)


async def test_turn_begin_hang_ends_with_a_kill(actor_system: GuardedSystem, counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="turn begin", hang=1.0, times=1):
        hung, queued = counter.ask(Add(1), timeout=60.0), counter.ask(Add(2), timeout=60.0)
        await idle(actor_system)
        assert not hung.done()
        counter.kill()
        with pytest.raises(hf.AskFailed, match="killed"):
            await hung
        assert await queued == 2


@virtual
async def test_turn_begin_hang_goes_on_when_the_faults_end(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="turn begin", hang=1.0):
        hung = counter.ask(Add(1))
    assert await hung == 1


@virtual
async def test_turn_begin_delay_takes_time_on_the_loop_clock(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="turn begin", delay=1.0, seconds=2.0):
        assert await counter.ask(Linger(1.0)) == 1
    assert now() == 3.0


@pytest.mark.parametrize("message", [Add(1), Linger(0.0)], ids=["def", "async def"])
async def test_turn_end_crash_comes_behind_the_handler_and_before_the_reply(
    actor_system: GuardedSystem, faults: Faults, message: Any
) -> None:
    seen: list[int] = []

    class Watched(Counter):
        def on_stop(self, reason: hf.ExitReason) -> None:
            seen.append(self.total)

    actor_system.expect_crashes(1)
    ref = await actor_system.start(hf.child("watched", hf.start(Watched)))
    async with faults.on(ref, at="turn end", crash=1.0, times=1):
        with pytest.raises(hf.RemoteCrash, match="InjectedCrash"):
            await ref.ask(message)
    assert seen == [1]
    assert await ref.ask(Total()) == 0


@virtual
async def test_turn_end_delay_and_hang_hold_the_reply(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="turn end", delay=1.0, seconds=4.0, times=1):
        assert await counter.ask(Add(1)) == 1
        assert now() == 4.0
    async with faults.on(counter, at="turn end", hang=1.0):
        with pytest.raises(hf.AskTimeout) as late:
            await counter.ask(Add(1), timeout=6.0)
        assert late.value.handled is None
    assert await counter.ask(Total()) == 2


async def test_turn_faults_of_a_recorded_actor_are_crashes_of_its_handler(
    actor_system: GuardedSystem, faults: Faults
) -> None:
    actor_system.expect_crashes(1)
    ref = await actor_system.start(hf.child("kept", hf.start(Counter), recovery=hf.hybrid()))
    assert await ref.ask(Add(5)) == 5
    async with faults.on(ref, at="turn end", crash=1.0, times=1):
        with pytest.raises(hf.RemoteCrash, match="injected crash"):
            await ref.ask(Add(1))
    assert await ref.ask(Total()) == 5  # The turn that raised left nothing behind.


# -- reply -----------------------------------------------------------------------------------------------------------


@virtual
async def test_reply_drop_ends_at_the_deadline_which_cannot_tell(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="reply", drop=1.0):
        with pytest.raises(hf.AskTimeout) as late:
            await counter.ask(Add(1), timeout=9.0)
    assert (late.value.handled, now()) == (None, 9.0)
    assert await counter.ask(Total()) == 1


@virtual
async def test_reply_delay_is_waited_for_or_late(actor_system: GuardedSystem, counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="reply", delay=1.0, seconds=2.0):
        assert await counter.ask(Add(1)) == 1
        assert now() == 2.0
        with pytest.raises(hf.AskTimeout):
            await counter.ask(Add(1), timeout=1.0)
        await asyncio.sleep(5.0)
    assert actor_system.late_replies == 1


async def test_reply_duplicate_is_one_outcome_and_one_late_reply(
    actor_system: GuardedSystem, counter: Ref, faults: Faults
) -> None:
    async with faults.on(counter, at="reply", duplicate=1.0):
        assert await counter.ask(Add(1)) == 1
        await idle(actor_system)
    assert actor_system.late_replies == 1


async def test_reply_corrupt_is_another_value(counter: Ref, faults: Faults) -> None:
    async with faults.on(counter, at="reply", corrupt=1.0):
        assert await counter.ask(Add(1)) != 1
    assert await counter.ask(Total()) == 1


# -- processes -------------------------------------------------------------------------------------------------------


async def in_process(system: GuardedSystem, **options: Any) -> Ref:
    return await system.start(hf.child("far", hf.start(Counter), isolation="process", **options))


@pytest.mark.parametrize("at", ["frame out", "frame in"])
@pytest.mark.parametrize("kind", ["crash", "corrupt"])
async def test_frame_crash_and_corrupt_lose_nothing_of_a_recorded_actor(
    actor_system: GuardedSystem, faults: Faults, at: str, kind: str
) -> None:
    actor_system.expect_crashes()
    ref = await in_process(actor_system, recovery=hf.hybrid())
    odds: Any = {kind: 1.0}
    async with faults.on(ref, at=at, after=2, times=2, **odds) as strikes:  # The second strikes the next process.
        assert [await ref.ask(Add(1), 60.0) for _ in range(5)] == [1, 2, 3, 4, 5]
        assert len(strikes.struck) == 2
    assert ref._cell.life == 3
    assert len(actor_system.crashes) == 2


@pytest.mark.parametrize("at", ["frame out", "frame in"])
async def test_frame_drop_is_a_message_lost_for_good(actor_system: GuardedSystem, faults: Faults, at: str) -> None:
    ref = await in_process(actor_system)
    await ref.ask(Add(1))
    async with faults.on(ref, at=at, drop=1.0, times=1):
        with pytest.raises(hf.AskTimeout) as late:
            await ref.ask(Linger(0.0), timeout=0.2)  # The first of its type: its name is lost with the frame.
        # What never reached the process was surely not begun there.
        assert late.value.handled is (False if at == "frame out" else None)
    assert await ref.ask(Total(), timeout=60.0) == (1 if at == "frame out" else 2)
    assert await ref.ask(Linger(0.0), timeout=60.0) == (2 if at == "frame out" else 3)


@pytest.mark.parametrize("at", ["frame out", "frame in"])
async def test_frame_delay_keeps_the_order(actor_system: GuardedSystem, faults: Faults, at: str) -> None:
    ref = await in_process(actor_system)
    async with faults.on(ref, at=at, delay=1.0, seconds=0.05, times=1) as strikes:
        began = now()
        replies = [ref.ask(Linger(0.005), 60.0) for _ in range(3)]  # They arrive one by one, in the same buffer.
        assert [await reply for reply in replies] == [1, 2, 3]
        assert now() - began >= 0.05
    assert len(strikes.struck) == 1


@pytest.mark.parametrize("kind", ["fail", "crash", "delay"])
async def test_process_start_is_tried_again(actor_system: GuardedSystem, faults: Faults, kind: str) -> None:
    actor_system.expect_crashes()
    ref = await in_process(actor_system)
    odds: Any = {kind: 1.0}
    async with faults.on(actor_system, at="process start", seconds=0.05, times=1, **odds) as strikes:
        ref.kill()
        assert await ref.ask(Add(2), timeout=60.0) == 2
        assert len(strikes.struck) == 1


async def test_process_start_fail_is_told_by_the_first_start(actor_system: GuardedSystem, faults: Faults) -> None:
    async with faults.on(actor_system, at="process start", fail=1.0):
        with pytest.raises(hf.StartFailed, match="injected fault at 'process start'"):
            await in_process(actor_system)


async def test_turns_in_another_process_are_out_of_reach(actor_system: GuardedSystem, faults: Faults) -> None:
    ref = await in_process(actor_system)
    with pytest.raises(hf.SpecError, match="in another process: use 'frame out'"):
        faults.on(ref, at="turn begin", crash=1.0)


# -- journal ---------------------------------------------------------------------------------------------------------


async def recorded(actor_systems: Any, path: Path) -> tuple[GuardedSystem, Ref]:
    system = await actor_systems(store=f"sqlite:{path}")
    return system, await system.start(hf.child("kept", hf.start(Counter), recovery=hf.hybrid(interval=3600.0)))


async def test_journal_append_fail_is_a_message_that_was_not_accepted(
    actor_systems: Any, faults: Faults, tmp_path: Path
) -> None:
    system, ref = await recorded(actor_systems, tmp_path / "store.db")
    assert await ref.ask(Add(1)) == 1
    async with faults.on(ref, at="journal append", fail=1.0, times=1):
        with pytest.raises(hf.HoldfastError, match="injected fault at 'journal append'"):
            ref.tell(Add(10))
    assert await ref.ask(Add(2)) == 3
    await system.shutdown()
    _, again = await recorded(actor_systems, tmp_path / "store.db")
    assert await again.ask(Total()) == 3


async def test_snapshot_write_fail_keeps_the_journal(actor_systems: Any, faults: Faults, tmp_path: Path) -> None:
    system, ref = await recorded(actor_systems, tmp_path / "store.db")
    with system.events() as events:
        async with faults.on(ref, at="snapshot write", fail=1.0) as strikes:
            assert await ref.ask(Add(3)) == 3
            await system.shutdown()  # It would take a snapshot as it stops.
        assert len(strikes.struck) == 1
        assert [type(event).__name__ for event in events.take() if "Snapshot" in type(event).__name__] == [
            "SnapshotFailed"
        ]
    _, again = await recorded(actor_systems, tmp_path / "store.db")
    assert await again.ask(Total()) == 3


# -- the rest --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value", [0, 7, -3, 1.5, 0.0, True, "", "bank", b"", b"ab", [1, 2], (1, "a"), {"a": 1}, Add(3)]
)
def test_damage_is_another_value_of_the_same_type(value: Any) -> None:
    for seed in range(20):
        other = damaged(value, random.Random(seed))
        assert type(other) is type(value)
        assert other != value


@pytest.mark.parametrize("value", [None, [], {}, (), Total(), object()])
def test_what_has_no_other_value_stays(value: Any) -> None:
    assert damaged(value, random.Random(0)) is value or damaged(value, random.Random(0)) == value


async def serve_counter(program: SimProgram) -> None:
    async with program.open() as system:
        await system.start(hf.child("counter", hf.start(Counter)))
        await asyncio.Event().wait()


@virtual
@pytest.mark.parametrize("kind", ["drop", "duplicate", "delay", "cut", "crash"])
async def test_post_faults_reach_the_client_of_a_program(kind: str, sim_fleet: SimFleet, faults: Faults) -> None:
    program = sim_fleet.start(serve_counter, again=1.0)
    async with hf.connect(sim_fleet.servers(), timeout=60.0) as connection:
        ref, loop = connection.ref("/app/counter", Counter), asyncio.get_running_loop()
        assert await ref.ask(Add(1), timeout=60.0) == 1
        odds: dict[str, Any] = {kind: 1.0}
        async with faults.on(program, at="post", times=1, seconds=3.0, **odds) as strikes:
            asked = loop.time()
            try:
                total = await ref.ask(Add(1), timeout=60.0)
            except hf.AskFailed:  # It was handled, or not, by a program that is dead.
                assert kind == "crash"
                return
            assert total == 2, "an ask that comes twice is handled once"
            assert len(strikes.struck) == 1
            assert (loop.time() > asked + 2.0) == (kind == "cut")


@virtual
@pytest.mark.parametrize("kind", ["drop", "cut", "split", "crash"])
async def test_request_faults_have_another_program_lead(kind: str, sim_fleet: SimFleet, faults: Faults) -> None:
    first = sim_fleet.start(serve_counter)
    async with hf.connect(sim_fleet.servers(), timeout=60.0):
        second = sim_fleet.start(serve_counter)
        await asyncio.sleep(1.0)
        odds: dict[str, Any] = {kind: 1.0}
        async with faults.on(first, at="request", times=1, seconds=20.0, after=2, **odds):
            await asyncio.sleep(15.0)
            is_left_behind = "program 2" in faults.strikes[0].what
            assert second.leads != is_left_behind


def test_an_injected_crash_names_its_seed() -> None:
    assert str(InjectedCrash("turn end", 3, 17)) == "injected crash at 'turn end', chance 3 (seed 17)"


def test_every_point_is_documented_and_tested() -> None:
    page = (Path(__file__).parents[2] / "docs" / "testing.md").read_text("utf-8")
    tests = [name for name in globals() if name.startswith("test_")]
    for point in POINTS.values():
        row = f"| `{point.name}` | {point.where} | {', '.join(point.kinds)} | {point.guarantee} |"
        assert row in page
        assert any(name.startswith(f"test_{point.name.split()[0]}_") for name in tests), point.name
    assert page.count("\n| `") >= len(POINTS)


async def test_injected_crashes_are_expected_only_if_the_test_says_so(counter: Ref, faults: Faults) -> None:
    system = GuardedSystem("guarded")
    async with system:
        ref = system.spawn(hf.start(Counter))
        async with faults.on(ref, at="turn begin", crash=1.0):
            ref.tell(Add(1))
            await idle(system)
    with pytest.raises(UnexpectedEnd, match="InjectedCrash"):
        system.verify()
