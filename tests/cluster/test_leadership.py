"""Who leads, step by step: what each side of a takeover does when the other, or the servers, behave badly."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from holdfast.actors.errors import HoldfastError
from holdfast.checkpoint.journal import StaleEpoch, StoreFailed
from holdfast.cluster.engine_thread import EngineThread
from holdfast.cluster.leadership import MOMENT_SECONDS, Follower, LeaderElsewhere, Leading, lead
from holdfast.cluster.log_records import CHANGES, DamagedLog, RecordMaker
from holdfast.cluster.log_writer import Deposed
from holdfast.cluster.ports import Unanswered
from holdfast.cluster.replicated_journal import CLOSE_SECONDS, ReplicatedJournal
from holdfast.testing.fleet.broker import BrokerFaults, SimBroker
from holdfast.testing.fleet.same_loop import SameLoop, WouldWait
from holdfast.testing.fleet.sim_engine import SimEngine
from tests.cluster.fleets import LARGE, Judge, everything_in, small_sizes

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])
A = "/app/a"
FAST = (0.001, 0.001)


class Leader:
    """A leader on simulated servers.

    Attributes:
        lost: why it leads no more.
    """

    def __init__(self, engine: SimEngine, leading: Leading) -> None:
        self.engine = engine
        self.lost: list[HoldfastError] = []
        self.journal = ReplicatedJournal(engine, SameLoop(), leading, lost=self.lost.append)

    def write(self, count: int = 1) -> None:
        self.journal.append([(A, ("in", number)) for number in range(count)])


class Stage:
    """Servers, and leaders that are closed at the end."""

    def __init__(self, broker: SimBroker) -> None:
        self.broker = broker
        self._leaders: list[Leader] = []

    async def leader(self, name: str, engine: SimEngine | None = None) -> Leader:
        engine = engine or SimEngine(self.broker)
        made = Leader(engine, await lead(engine, name, standby="warm"))
        self._leaders.append(made)
        return made

    async def close(self) -> None:
        for leader in self._leaders:
            leader.engine.link.heal()
            await leader.journal.end()


@pytest.fixture
async def stage() -> AsyncIterator[Stage]:
    with small_sizes():
        made = Stage(SimBroker(latency=FAST))
        yield made
        await made.close()


async def test_a_leader_that_is_deposed_refuses(stage: Stage) -> None:
    first = await stage.leader("first")
    first.write()
    await first.journal.synced()
    stage.broker.expire_lease()
    second = await stage.leader("second")
    first.write()
    with pytest.raises(StaleEpoch, match="epoch 1 and now has epoch 2"):
        await first.journal.synced()
    with pytest.raises(StaleEpoch):
        first.write()
    assert isinstance(first.lost[0], Deposed)
    assert "second leads, in epoch 2" in str(first.lost[0])
    second.write()
    await second.journal.synced()
    assert [entry for _, entry in second.journal.load(A).entries] == [("in", 0), ("in", 0)]


async def test_who_is_held_back_learns_that_it_is_deposed(stage: Stage) -> None:
    """Its look at the loss of the lease was accepted, for the other had not begun yet; then it writes nothing."""
    first = await stage.leader("first")
    stage.broker.expire_lease()
    await asyncio.sleep(0.6)  # It has looked.
    other = SimEngine(stage.broker)
    if not await other.lease.acquire("second"):
        stage.broker.expire_lease()
        assert await other.lease.acquire("second")
    token = await other.lease.acquire("second")
    await asyncio.sleep(1.1)
    assert token is not None
    assert not first.lost
    held = len(stage.broker.everything)
    first.write()
    promise = first.journal.synced()
    await asyncio.sleep(0.4)
    assert len(stage.broker.everything) == held, "it writes while another has the lease"
    second = await stage.leader("second", other)
    keep = asyncio.ensure_future(asyncio.wait([promise], timeout=20.0))
    await keep
    assert first.lost
    assert not second.lost
    with pytest.raises(StaleEpoch):
        await promise


async def test_who_is_held_back_goes_on_when_the_other_never_leads(stage: Stage) -> None:
    first = await stage.leader("first")
    stage.broker.expire_lease()
    await SimEngine(stage.broker).lease.acquire("second")
    await asyncio.sleep(1.2)
    first.write()
    async with asyncio.timeout(60.0):
        await first.journal.synced()
    assert stage.broker.held_by() == "first"
    assert not first.lost


async def test_whoever_is_deposed_leaves_the_lease(stage: Stage) -> None:
    first = await stage.leader("first")
    follower = Follower(SimEngine(stage.broker))
    await follower.catch_up()
    maker = RecordMaker(follower.reader.epoch + 1, follower.reader.at)
    stage.broker.append(next(maker.parts(CHANGES, [b""])), maker.after)  # somebody's, who is gone
    first.write()
    with pytest.raises(StaleEpoch):
        await first.journal.synced()
    await asyncio.sleep(2.0)
    assert stage.broker.held_by() == ""


async def test_nobody_leads_before_having_read_all(stage: Stage) -> None:
    first = await stage.leader("first")
    for _ in range(100):
        first.write()
        await first.journal.synced()
    await first.journal.end()
    stage.broker.faults = BrokerFaults(stale=0.7, silent=0.3)
    async with asyncio.timeout(600.0):
        second = await stage.leader("second")
    stage.broker.faults = BrokerFaults()
    assert len(second.journal.load(A).entries) == 100


async def test_a_leader_goes_on_over_an_outage(stage: Stage) -> None:
    """Also one that its standby has seen: whoever led goes first."""
    first = await stage.leader("first")
    waits: list[str] = []
    standby = asyncio.ensure_future(lead(SimEngine(stage.broker), "second", standby="warm", waits=waits.append))
    await asyncio.sleep(1.0)
    for seconds in (60.0, 5.1, 5.4, 5.7, 6.0, 6.3, 6.6, 6.9, 7.2):
        first.write()
        stage.broker.go_away(seconds)
        await first.journal.synced()
        await asyncio.sleep(10.0)
        assert not first.lost, f"deposed after an outage of {seconds:g} s"
    assert not standby.done()
    assert waits == ["first"]
    standby.cancel()
    await asyncio.wait([standby])


async def test_a_refused_append_that_stands_there_is_ones_own(stage: Stage) -> None:
    first = await stage.leader("first")
    stage.broker.faults = BrokerFaults(lost_answers=0.5, refused=0.3, doubled=0.3)
    for _ in range(20):
        first.write()
        await first.journal.synced()
    assert not first.lost
    judge = Judge(stage.broker)
    judge.read()
    assert len(judge.contents.entries[A]) == 20


async def test_nobody_waits_for_a_leader_unless_told_to(stage: Stage) -> None:
    await stage.leader("first")
    with pytest.raises(LeaderElsewhere, match="first leads"):
        await lead(SimEngine(stage.broker), "second", standby=None)
    stage.broker.go_away(10.0)
    with pytest.raises(Unanswered):
        await lead(SimEngine(stage.broker), "second", standby=None)


async def test_who_is_not_to_wait_bears_servers_that_are_away_for_a_moment(stage: Stage) -> None:
    """An election, or a file that they take up, is no reason to refuse a start."""
    stage.broker.go_away(MOMENT_SECONDS / 2)
    leading = await lead(SimEngine(stage.broker), "first", standby=None)
    assert leading.maker.epoch == 1


async def test_a_log_that_has_lost_its_beginning_is_refused(stage: Stage) -> None:
    first = await stage.leader("first")
    first.write()
    await first.journal.end()
    stage.broker.forget(2)
    async with asyncio.timeout(10.0):
        with pytest.raises(DamagedLog, match="begins no base"):
            await lead(SimEngine(stage.broker), "second", standby="warm")
        with pytest.raises(DamagedLog, match="begins no base"):
            await lead(SimEngine(stage.broker), "second", standby="cold")


async def test_what_an_engine_was_not_to_raise_is_told(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    first = await stage.leader("first")

    async def broken(data: bytes, after: int) -> int:
        raise ValueError("no such thing")

    monkeypatch.setattr(first.engine.log, "append", broken)
    first.write()
    with pytest.raises(StoreFailed, match="no such thing"):
        await first.journal.synced()
    assert first.journal.has_failed()
    assert isinstance(first.lost[0], StoreFailed)


async def test_the_end_tells_whoever_waits(stage: Stage) -> None:
    first = await stage.leader("first")
    stage.broker.go_away(60.0)
    first.write()
    promise = first.journal.synced()
    with pytest.raises(StoreFailed, match="1 writes may be lost"):
        await first.journal.end()
    with pytest.raises(StoreFailed, match="may be lost"):
        await promise


async def test_a_simulated_journal_says_what_it_cannot_wait_for(stage: Stage) -> None:
    first = await stage.leader("first")
    first.write()
    with pytest.raises(WouldWait, match=r"_written at .* has to wait .* await it there"):
        first.journal.sync()


async def test_whoever_reads_long_keeps_the_lease_meanwhile() -> None:
    """Or two candidates that begin with nothing would depose each other for ever."""
    stage = Stage(SimBroker(latency=(0.02, 0.02)))
    first = await stage.leader("first")
    for _ in range(600):
        first.write()
        await first.journal.synced()
    await first.journal.end()

    async def candidate(name: str) -> None:
        engine = SimEngine(stage.broker, seconds=0.3)
        while True:
            leader = Leader(engine, await lead(engine, name, standby="cold"))
            while not leader.lost:
                await asyncio.sleep(0.1)
            await leader.journal.end()

    candidates = [asyncio.ensure_future(candidate(name)) for name in ("second", "third")]
    await asyncio.sleep(20.0)
    for task in asyncio.all_tasks() - {asyncio.current_task()}:
        task.cancel()
    await asyncio.wait(candidates)
    judge = Judge(stage.broker)
    judge.read()
    assert judge.reader.epoch == 2


async def test_what_was_kept_since_is_no_orphan(stage: Stage) -> None:
    """The names of what is kept come late: what this leader has kept meanwhile is among them."""
    first = await stage.leader("first")
    await first.journal.end()
    stage.broker.blobs["left"] = b"by somebody who was killed"
    engine = SimEngine(stage.broker)
    leading = await lead(engine, "second", standby="cold")
    asked: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    names = engine.blobs.names

    async def slow() -> set[str]:
        await asyncio.sleep(1.0)
        found = await names()
        await asyncio.sleep(1.0)
        asked.set_result(None)
        return found

    engine.blobs.names = slow  # type: ignore[method-assign]
    second = Leader(engine, leading)
    snapshot = b"x" * (LARGE + 1)
    second.journal.cut(A, snapshot, [], turn=1)
    await second.journal.synced()
    await asked
    await asyncio.sleep(1.0)
    assert second.journal.load(A).snapshot == snapshot
    assert "left" not in stage.broker.blobs
    await second.journal.end()


async def test_orphans_stay_until_the_log_says_who_leads(stage: Stage) -> None:
    """Whoever has been deposed without knowing takes what its successor keeps for orphans: it may not remove it."""
    engine = SimEngine(stage.broker)
    leading = await lead(engine, "first", standby="cold")
    stage.broker.expire_lease()
    second = await stage.leader("second")
    second.journal.cut(A, b"x" * (LARGE + 1), [], turn=1)
    await second.journal.synced()
    first = Leader(engine, leading)
    await asyncio.sleep(2.0)
    assert isinstance(first.lost[0], Deposed)
    assert second.journal.load(A).snapshot == b"x" * (LARGE + 1)
    await first.journal.end()


async def test_a_follower_that_was_away_begins_again_with_a_base(stage: Stage) -> None:
    engine = SimEngine(stage.broker)
    follower = Follower(engine)
    following = asyncio.ensure_future(follower.follow())
    first = await stage.leader("first")
    for times in range(4):
        engine.link.cut()
        begins = stage.broker.records[0].sequence
        while stage.broker.records[0].sequence == begins:
            first.write(20)
            first.journal.cut(A, b"short", range(first.journal.append([(A, ("in", times))])[0]), turn=1, keep=1)
            await first.journal.synced()
        engine.link.heal()
        await asyncio.sleep(10.0)
        judge = Judge(stage.broker)
        judge.read(follower.reader.at)
        assert everything_in(follower.contents) == everything_in(judge.contents)
        assert follower.reader.at == stage.broker.records[-1].sequence
    following.cancel()
    await asyncio.wait([following])


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_a_transaction_keeps_nobody_waiting() -> None:
    """The engine's loop never waits for who writes: it sends, keeps the lease, and reads for the transaction itself."""
    thread = EngineThread("simulated servers")
    broker = SimBroker(latency=(0.0, 0.0))
    engine = SimEngine(broker)
    leading = await thread.run(lead(engine, "first", standby="cold"))
    journal = ReplicatedJournal(engine, thread, leading)
    snapshot = b"x" * (1 << 20)

    def transact() -> bytes | None:
        journal.cut(A, snapshot, [], turn=1)
        journal.sync()
        found: bytes | None = None
        for _ in range(20):
            journal.note("key", b"under way")
            with journal.together():
                journal.note("key", b"x")
                found = journal.load(A).snapshot
        journal.sync()
        return found

    assert await asyncio.to_thread(transact) == snapshot
    await asyncio.to_thread(journal.close)


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_a_large_snapshot_is_asked_for_again_until_it_comes() -> None:
    """At a takeover servers may be choosing a leader: one request that fails is no reason not to lead."""
    thread = EngineThread("simulated servers")
    engine = SimEngine(SimBroker(latency=(0.0, 0.0)))
    journal = ReplicatedJournal(engine, thread, await thread.run(lead(engine, "first", standby="cold")))
    snapshot = b"x" * (1 << 20)
    await asyncio.to_thread(journal.cut, A, snapshot, [], turn=1)
    await asyncio.to_thread(journal.sync)
    read, failures = engine.blobs.get, iter([Unanswered("servers", "no leader"), Unanswered("servers", "no leader")])

    async def get(name: str) -> bytes | None:
        for failure in failures:
            raise failure
        return await read(name)

    engine.blobs.get = get  # type: ignore[method-assign]
    assert (await asyncio.to_thread(journal.load, A)).snapshot == snapshot
    await asyncio.to_thread(journal.close)


async def test_who_is_deposed_takes_nothing_for_damaged(stage: Stage) -> None:
    """Whoever leads since has removed a large snapshot that only the deposed leader refers to: nothing is damaged."""
    first = await stage.leader("first")
    first.journal.cut(A, b"x" * (1 << 20), [], turn=1)
    await first.journal.synced()
    first.engine.link.freeze()
    stage.broker.expire_lease()
    second = await stage.leader("second")
    second.journal.erase(A)
    await second.journal.synced()
    while stage.broker.blobs:
        await asyncio.sleep(0.01)
    first.engine.link.thaw()
    with pytest.raises(StoreFailed, match="with a large snapshot"):  # It has to wait until it knows whether it leads.
        first.journal.load(A)
    loading = asyncio.to_thread(first.journal.load, A)
    with pytest.raises(StaleEpoch):
        await loading


async def test_who_has_waited_for_silent_servers_does_not_wait_once_more_at_the_end(stage: Stage) -> None:
    first = await stage.leader("first")
    loop = asyncio.get_running_loop()
    first.engine.link.cut()
    first.write()
    await asyncio.sleep(CLOSE_SECONDS + 0.5)
    before = loop.time()
    with pytest.raises(StoreFailed, match="1 writes may be lost"):
        await first.journal.end()
    assert loop.time() - before < 1.0
