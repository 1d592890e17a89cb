"""A mechanism is attached to a live actor and detached from it: its life goes on, under load, with all that it had."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import signal
from pathlib import Path
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.actors.events import Moved
from holdfast.actors.process.process_host import WorkerPlace
from holdfast.checkpoint.protocol import Snapshot
from holdfast.ftm.bricks.brick_messages import Done, Work
from holdfast.ftm.bricks.bricks import After, Before
from holdfast.ftm.events import MechanismAttached, MechanismDetached
from holdfast.ftm.group.failover import FailoverManager
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.model.mechanism import Mechanism, MechanismRefused, Role
from tests.ftm.accounts import Account, Add, Closed, Counter, Fussy, Later, Load, Pay, Purse, Tags, Total
from tests.ftm.test_failover import METHODS, group_of, pid_of, two_again

# A refused or failed transaction ends with its block.
# ruff: noqa: PT012


class FaultyAfter(After):
    async def after(self, done: Done) -> Done:
        raise ValueError("a bug")


async def attach(system: hf.ActorSystem, ref: hf.ActorRef[Any], mechanism: Any = None) -> None:
    async with system.transaction(timeout=30) as change:
        change.protect(ref, mechanism or PBR())


async def detach(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=30) as change:
        change.protect(ref, None)


@pytest.fixture(params=METHODS)
def recovery(request: pytest.FixtureRequest) -> Any:
    return METHODS[request.param]()


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.some(4)
async def test_attached_and_detached_under_load_nothing_is_lost(
    system: hf.ActorSystem, recovery: Any, isolation: Any
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery, isolation=isolation))
    load, events = Load(ref), system.events()
    for _ in range(2):
        await load.reached(30)
        await attach(system, ref)
        assert isinstance(ref._cell.host.place, GroupPlace)
        await load.reached(30)
        await detach(system, ref)
        assert isinstance(ref._cell.host.place, WorkerPlace) is (isolation == "process")
        assert not [path for path in system.tree() if path.startswith(f"{ref.path}/ftm")] or await gone(system, ref)
    await load.reached(30)
    await load.stop()
    load.check(await ref.ask(Tags()))
    seen = [type(event) for event in events.take() if isinstance(event, (MechanismAttached, MechanismDetached))]
    assert seen == [MechanismAttached, MechanismDetached] * 2
    assert ref._cell.life == 1
    events.close()


async def gone(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> bool:
    async with asyncio.timeout(10):
        while any(path.startswith(f"{ref.path}/ftm") for path in system.tree()):
            await asyncio.sleep(0.005)
    return True


async def test_a_bounded_mailbox_is_one_again(system: hf.ActorSystem, recovery: Any) -> None:
    """What was taken out of it makes room."""
    spec = hf.child("alice", hf.start(Counter), recovery=recovery, mechanism=PBR(), mailbox=hf.bounded(2))
    ref = await system.start(spec)
    await detach(system, ref)
    assert [await ref.ask(Add(tag)) for tag in range(6)] == [1, 2, 3, 4, 5, 6]
    with pytest.raises(hf.MailboxFull):
        for tag in range(6, 12):
            ref.tell(Add(tag))


async def test_an_attached_actor_survives_the_death_of_its_primary(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery))
    load = Load(ref)
    await load.reached(30)
    await attach(system, ref)
    primary = group_of(ref).membership.primary
    assert primary is not None
    os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    await load.reached(30)
    await two_again(ref)
    await detach(system, ref)
    await load.reached(30)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_an_attach_whose_replica_dies_while_it_starts_leaves_the_life(system: hf.ActorSystem) -> None:
    """It goes on in its first life, with its state."""
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    assert await ref.ask(Add(0)) == 1
    attaching = asyncio.ensure_future(attach(system, ref))
    async with asyncio.timeout(10):
        while f"{ref.path}/ftm/r1" not in system._workers.processes():
            await asyncio.sleep(0)
    os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
    with pytest.raises(hf.TransactionFailed, match="could not be started"):
        await attaching
    assert await gone(system, ref)
    assert await ref.ask(Add(1)) == 2
    assert ref._cell.life == 1


async def test_detached_while_nobody_leads_and_nothing_is_inside(system: hf.ActorSystem, recovery: Any) -> None:
    """Nothing has to come out, and yet it waits until somebody can say what the state is."""
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery, mechanism=PBR()))
    for number in range(5):
        await ref.ask(Add(number))
    group = group_of(ref)
    await two_again(ref)
    os.kill(pid_of(system, ref, group.membership.primary or ""), signal.SIGKILL)
    async with asyncio.timeout(10):
        while group.membership.primary is not None:
            await asyncio.sleep(0)
    await detach(system, ref)
    assert await ref.ask(Tags()) == list(range(5))


async def test_detached_while_whoever_leads_is_deposed_when_nothing_is_inside(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the word that nothing is inside and the question for the state: what did not come is not taken."""
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    for number in range(5):
        await ref.ask(Add(number))
    group = group_of(ref)
    await two_again(ref)
    epoch, quiet = group.membership.epoch, group.quiet

    def suspected(done: asyncio.Future[None]) -> None:
        primary, manager = group.membership.primary, system._node.cell_at(f"{ref.path}/ftm/failover").actor
        assert primary is not None
        assert isinstance(manager, FailoverManager)
        group.replicas.suspect(primary, group.membership.members[primary], "a test wants it")
        manager._depose(primary)

    def quiet_until_suspected() -> asyncio.Future[None]:
        monkeypatch.undo()
        future = quiet()
        future.add_done_callback(suspected)  # Before whoever waits for it goes on.
        return future

    monkeypatch.setattr(group, "quiet", quiet_until_suspected)
    await detach(system, ref)
    assert group.membership.epoch > epoch
    assert await ref.ask(Tags()) == list(range(5))


async def test_detached_while_whoever_leads_dies_with_the_question(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery, mechanism=PBR()))
    for number in range(5):
        await ref.ask(Add(number))
    group = group_of(ref)
    await two_again(ref)
    pid = pid_of(system, ref, group.membership.primary or "")
    os.kill(pid, signal.SIGSTOP)  # It gets the question, and will not answer it.
    detaching = asyncio.ensure_future(detach(system, ref))
    async with asyncio.timeout(10):
        while not group.delivery.is_stopping:
            await asyncio.sleep(0)
    os.kill(pid, signal.SIGKILL)
    await detaching
    assert await ref.ask(Tags()) == list(range(5))


async def test_a_last_snapshot_that_died_with_whoever_led_is_asked_for_again(system: hf.ActorSystem) -> None:
    """Also when the interval is far from over."""
    recovery = hf.hybrid(interval=1000.0)
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery, mechanism=PBR()))
    for number in range(5):
        await ref.ask(Add(number))
    group = group_of(ref)
    await two_again(ref)
    pid = pid_of(system, ref, group.membership.primary or "")
    os.kill(pid, signal.SIGSTOP)
    detaching = asyncio.ensure_future(detach(system, ref))
    async with asyncio.timeout(10):
        while group.switch.due.asked_at < 0 or group.delivery.inward:
            await asyncio.sleep(0)
    os.kill(pid, signal.SIGKILL)
    await detaching
    assert await ref.ask(Tags()) == list(range(5))


class HeldUp(Before):
    """Keeps a batch without requests, as the first one of whoever leads from now on is, while a file is there."""

    async def before(self, work: Work) -> Work:
        assert isinstance(self.mechanism, SavesFirst)
        while not work.requests and os.path.exists(self.mechanism.path):
            await asyncio.sleep(0.005)
        return work


class Lets(After):
    async def after(self, done: Done) -> Done:
        assert isinstance(self.mechanism, SavesFirst)
        if any(isinstance(one, Snapshot) for one in done.more):
            os.unlink(self.mechanism.path)
        return done


@dataclasses.dataclass(frozen=True)
class SavesFirst(Mechanism):
    """Whoever leads from now on gives its snapshot before it has come to the end of what the last one has left it."""

    name: ClassVar[str] = "saves first"
    layer: ClassVar[str] = "repetition"
    roles: ClassVar[dict[str, Role]] = {"single": Role(before=HeldUp, after=Lets)}

    path: str = ""


async def test_a_last_snapshot_that_a_new_leader_keeps_back_needs_no_request_to_come_home(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    held = tmp_path / "held"
    stack = (PBR(), SavesFirst(path=str(held)))
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=hf.hybrid(interval=1000.0), mechanism=stack))
    for number in range(5):
        await ref.ask(Add(number))
    group = group_of(ref)
    await two_again(ref)
    held.touch()
    os.kill(pid_of(system, ref, group.membership.primary or ""), signal.SIGKILL)
    await detach(system, ref)
    assert not held.exists()
    assert await ref.ask(Tags()) == list(range(5))


class Gate(hf.Message[int]):
    path: str


class Gated(Counter):
    @hf.on(Gate)
    async def wait(self, message: Gate) -> int:
        while not os.path.exists(message.path):
            await asyncio.sleep(0.005)
        return 0


async def test_a_detach_that_is_not_wanted_any_more_is_undone_at_once(system: hf.ActorSystem, tmp_path: Path) -> None:
    """A turn that does not end holds it up: the transaction's time is over long before its own."""
    ref = await system.start(hf.child("alice", hf.start(Gated), mechanism=PBR()))
    waiting = ref.ask(Gate(str(tmp_path / "gate")), timeout=60)
    group = group_of(ref)
    async with asyncio.timeout(10):
        while group.delivery.out is None:
            await asyncio.sleep(0)
    with pytest.raises(hf.TransactionFailed, match="not within") as failed:
        async with system.transaction(timeout=0.5) as change:
            change.protect(ref, None)
    assert failed.value.kept == ()
    assert not group.delivery.is_stopping
    (tmp_path / "gate").touch()
    assert await waiting == 0
    assert await ref.ask(Add(1)) == 1
    assert group_of(ref) is group


async def test_its_next_lives_are_protected_too_and_not_after_a_detach(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=hf.hybrid()))
    await attach(system, ref)
    assert await ref.ask(Add(0)) == 1
    await system.terminate(ref)
    async with asyncio.timeout(30):
        while ref._cell.life < 2:
            await asyncio.sleep(0.005)
    assert await ref.ask(Add(1), timeout=30) == 2
    assert isinstance(ref._cell.host.place, GroupPlace)
    await two_again(ref)
    await detach(system, ref)
    await system.terminate(ref)
    assert await ref.ask(Add(2), timeout=30) == 3
    assert not isinstance(ref._cell.host.place, GroupPlace)


@pytest.mark.some(2)
async def test_timers_come_along(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery))
    await ref.ask(Later(1.0, 1))
    await ref.ask(Later(2.5, 2))
    await attach(system, ref)
    async with asyncio.timeout(20):
        while (await ref.ask(Tags()))[:1] != [1]:
            await asyncio.sleep(0.01)
    await detach(system, ref)
    async with asyncio.timeout(20):
        while await ref.ask(Tags()) != [1, 2]:
            await asyncio.sleep(0.01)


async def test_a_transaction_that_fails_behind_it_detaches_it_again(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery))
    load = Load(ref)
    await load.reached(10)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=30) as change:
            change.protect(ref, PBR())
            change.add("/app", hf.child("bad", hf.start(Failing)))
    assert not isinstance(ref._cell.host.place, GroupPlace)
    assert ref._cell.spec.mechanism is None
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))


class Failing(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise RuntimeError("no")


class Hidden(Counter):
    """Keeps what no other process could take over."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = asyncio.Lock()


async def test_an_actor_that_cannot_leave_goes_on_as_it_was(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Hidden)))
    load = Load(ref)
    await load.reached(10)
    with pytest.raises(hf.TransactionFailed, match="lock"):
        await attach(system, ref)
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert not isinstance(ref._cell.host.place, GroupPlace)


async def test_what_a_mechanism_needs_is_checked_before_anything_is_done(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Closed)))
    with pytest.raises(hf.TransactionRefused, match="state_access"):
        await attach(system, ref)
    with pytest.raises(MechanismRefused, match="state_access"):
        hf.child("bob", hf.start(Closed), mechanism=PBR())
    with pytest.raises(hf.TransactionRefused, match=r"cannot go along.*in its spec"):
        await attach(system, ref, LFR())
    with pytest.raises(hf.SpecError, match=r"mechanism must be .*find\(name\)"):
        hf.child("bob", hf.start(Counter), mechanism="pbr")  # type: ignore[arg-type]
    with pytest.raises(hf.SpecError, match="supervisor"):
        hf.child("bob", hf.start(hf.Supervisor), mechanism=PBR())
    await detach(system, ref)  # It has none.
    assert not isinstance(ref._cell.host.place, GroupPlace)


async def test_protected_twice_is_protected_once_and_a_dry_run_changes_nothing(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    async with system.transaction(dry_run=True) as change:
        change.protect(ref, PBR())
    assert "protect /app/alice by PBR" in change.describe()
    assert not isinstance(ref._cell.host.place, GroupPlace)
    await attach(system, ref)
    config = (await system.protection(ref)).config
    await attach(system, ref)
    assert (await system.protection(ref)).config == config
    assert await ref.ask(Total()) == 0


async def test_if_the_new_life_cannot_begin_the_old_one_goes_on(
    system: hf.ActorSystem, recovery: Any, tmp_path: Path
) -> None:
    veto = tmp_path / "veto"
    ref = await system.start(hf.child("alice", hf.start(Fussy, str(veto)), recovery=recovery))
    load = Load(ref)
    await load.reached(10)
    veto.touch()
    with pytest.raises(hf.TransactionFailed):
        await attach(system, ref)
    assert not isinstance(ref._cell.host.place, GroupPlace)
    await load.reached(10)
    veto.unlink()
    await attach(system, ref)
    await load.reached(10)
    veto.touch()
    with pytest.raises(hf.TransactionFailed, match="could not begin"):
        await detach(system, ref)
    assert isinstance(ref._cell.host.place, GroupPlace)
    await load.reached(10)
    veto.unlink()
    await detach(system, ref)
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert ref._cell.life == 1


async def test_a_protected_actor_is_not_moved_by_anything_else(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    with pytest.raises(hf.TransactionRefused, match="`protect` it by None"):
        async with system.transaction() as change:
            change.replace_state(ref, dict)
    assert await ref.ask(Add(0)) == 1


@pytest.mark.parametrize("how", ["at once", "in a transaction", "with the attachment"])
async def test_where_a_protected_actor_lives_is_where_it_lives_after(system: hf.ActorSystem, how: str) -> None:
    ref = await system.start(
        hf.child("alice", hf.start(Counter), mechanism=None if how == "with the attachment" else PBR())
    )
    assert await ref.ask(Add(0)) == 1
    if how == "at once":
        await system.set_isolation(ref, "process")
    else:
        async with system.transaction(timeout=30) as change:
            change.isolation(ref, "process")
            if how == "with the attachment":
                change.protect(ref, PBR())
    assert isinstance(ref._cell.host.place, GroupPlace)
    assert await ref.ask(Add(1), timeout=30) == 2
    await detach(system, ref)
    assert await ref.ask(Add(2), timeout=30) == 3
    assert isinstance(ref._cell.host.place, WorkerPlace)


async def test_a_binding_is_that_of_every_replica_from_now_on(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account, 0)))
    two = await system.start(hf.child("two", hf.start(Account, 1000)))
    ref = await system.start(hf.child("alice", hf.start(Purse), mechanism=PBR(), bindings={"account": one.path}))
    assert await ref.ask(Pay(1)) == 1
    system.bind(ref, "account", two)
    assert await ref.ask(Pay(1)) == 1001
    for total in (1002, 1003):
        primary = group_of(ref).membership.primary
        assert primary is not None
        os.kill(pid_of(system, ref, primary), signal.SIGKILL)
        assert await ref.ask(Pay(1), timeout=30) == total
        await two_again(ref)


class Hold(hf.Message[bool]):
    seconds: float


class Busy(Counter):
    """Takes its time, and traps exits once it has been told to."""

    @hf.on(Hold)
    async def hold(self, message: Hold) -> bool:
        await asyncio.sleep(message.seconds)
        had, self.ctx.trap_exits = self.ctx.trap_exits, True
        return had


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
async def test_whether_it_traps_exits_comes_along(system: hf.ActorSystem, method: str, isolation: Any) -> None:
    ref = await system.start(hf.child("alice", hf.start(Busy), recovery=METHODS[method](), isolation=isolation))
    assert await ref.ask(Hold(0.0)) is False
    await attach(system, ref)
    assert await ref.ask(Hold(0.0)) is True
    primary = group_of(ref).membership.primary
    assert primary is not None
    os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    assert await ref.ask(Hold(0.0), timeout=30) is True
    await two_again(ref)
    await detach(system, ref)
    assert await ref.ask(Hold(0.0), timeout=30) is True


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_recorded_actor_goes_between_its_process_and_a_group_in_one_move(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=hf.hybrid(), isolation="process"))
    assert await ref.ask(Add(1)) == 1
    with system.events() as events:
        await attach(system, ref)
        assert await ref.ask(Add(2)) == 2
        await detach(system, ref)
        assert await ref.ask(Add(3)) == 3
        assert not [one for one in events.take() if isinstance(one, Moved)]  # to a task and from there
    assert system.pid_of(ref) != os.getpid()
    os.kill(system.pid_of(ref), signal.SIGKILL)
    assert await ref.ask(Tags(), timeout=30) == [1, 2, 3]


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
async def test_those_that_wait_for_room_come_along(system: hf.ActorSystem, method: str) -> None:
    spec = hf.child("alice", hf.start(Busy), mailbox=hf.bounded(2), recovery=METHODS[method]())
    ref = await system.start(spec)
    held = asyncio.ensure_future(ref.ask(Hold(0.3)))
    asks = [asyncio.ensure_future(ref.ask(Add(tag), timeout=30)) for tag in range(8)]
    await asyncio.sleep(0.05)
    await attach(system, ref)
    assert isinstance(ref._cell.host.place, GroupPlace)
    await held
    assert sorted(await asyncio.gather(*asks)) == list(range(1, 9))
    assert sorted(await ref.ask(Tags())) == list(range(8))


class Bare(Counter):
    """Its state cannot be saved, from the beginning."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = asyncio.Lock()


@dataclasses.dataclass(frozen=True)
class Faulty(PBR):
    """Has a brick with a bug."""

    roles: ClassVar[dict[str, Role]] = {"primary": Role(after=FaultyAfter), "backup": Role()}


async def test_what_has_ended_a_replica_is_told(system: hf.ActorSystem) -> None:
    """Not only that its process has ended: what the brick has raised, and which it was."""
    with pytest.raises(hf.StartFailed, match=r"its proceed has ended: .*Bare\.lock.* cannot be saved; make it a key"):
        await system.start(hf.child("bare", hf.start(Bare), mechanism=PBR()))
    with pytest.raises(hf.StartFailed, match=r"on_start raised .*Bare\.lock.* cannot be saved"):
        await system.start(hf.child("bare", hf.start(Bare), mechanism=LFR()))
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    with pytest.raises(hf.TransactionFailed, match=r"its after has ended: ValueError: a bug"):
        await attach(system, ref, Faulty())
    assert await ref.ask(Total()) == 0


@pytest.mark.parametrize("mechanism", [None, PBR()], ids=["first", "another"])
async def test_a_change_that_the_end_of_the_system_overtakes_fails(mechanism: Any) -> None:
    """With an error: nobody has cancelled whoever waits for it."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=mechanism))

        async def change() -> None:
            async with system.transaction(timeout=30) as step:
                step.protect(ref, LFR())

        changing = asyncio.create_task(change())
        with system.events() as events:
            async for event in events:
                if isinstance(event, hf.events.TransactionBegan):
                    break
    with pytest.raises(hf.TransactionFailed, match="the system ends"):
        async with asyncio.timeout(20):
            await changing


@pytest.mark.parametrize("place", ["task", "process", "subtree"])
async def test_who_waits_for_room_is_let_in_by_whoever_lives_there_next(
    system: hf.ActorSystem, recovery: Any, place: Any
) -> None:
    """Sends and asks: attached, and detached again."""
    isolation: Any = "process" if place == "process" else "task"
    spec = hf.child("alice", hf.start(Counter), recovery=recovery, isolation=isolation, mailbox=hf.bounded(2))
    if place == "subtree":
        await system.start(hf.supervisor("top", children=[spec], isolation="process"))
        ref = system.ref("/app/top/alice", Counter)
    else:
        ref = await system.start(spec)
    for move in (attach, detach):
        await system.suspend(ref)
        first = len((await system.get_state(ref))["tags"])
        sends = [asyncio.ensure_future(ref.send(Add(tag))) for tag in range(6)]
        asks = [ref.ask(Add(tag), timeout=60.0) for tag in range(6, 9)]
        await asyncio.sleep(0)  # All have found it full, or wait.
        assert not all(send.done() for send in sends)
        await move(system, ref)
        await system.resume(ref)
        async with asyncio.timeout(60):
            await asyncio.gather(*sends, *asks)
        assert await ref.ask(Total(), timeout=60.0) == first + 9
