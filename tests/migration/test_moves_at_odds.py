"""Changes of where one actor lives that others are in the way of: a change of somebody else, a hanging turn, ends."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.migration.subtree_moves import FromSubtree
from tests.actors.process.waiting import next_event
from tests.migration.far_places import IN_TIME, pid_of
from tests.migration.test_far_moves import Reluctant
from tests.migration.travellers import KINDS, Add, Seen, Traveller
from tests.system.trees import Stumble

# A refused or failed transaction ends with its block.


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=100_000) as running:
        yield running


def child(recipe: Any, kind: str = "plain", **options: Any) -> hf.ChildSpec:
    recovery = {} if KINDS[kind] is None else {"recovery": KINDS[kind]}
    return hf.child("one", recipe, **recovery, **options)


async def supervised(system: hf.ActorSystem, one: hf.ChildSpec, old: str = "near") -> hf.ActorRef[Any]:
    """`one` below `near`, or below `far` with a process of its own; returns it."""
    for name, isolation in (("near", "task"), ("far", "process")):
        place: Any = isolation
        children = [one] if name == old else []
        await system.start(hf.supervisor(name, children=children, isolation=place, intensity=100_000))
    return system.ref(f"/app/{old}/one", one.start.kind)


async def exists(file: str) -> None:
    async with asyncio.timeout(IN_TIME):
        while not Path(file).exists():
            await asyncio.sleep(0.005)


CHANGES: dict[str, Callable[[hf.system.Change, Any], None]] = {
    "isolation": lambda change, ref: change.isolation(ref, "process"),
    "protect": lambda change, ref: change.protect(ref, PBR()),
    "lodging": lambda change, ref: change.move(ref, "/app/far"),
}
ABOUT = pytest.mark.parametrize("about", list(CHANGES))


@ABOUT
@pytest.mark.parametrize("kind", list(KINDS))
async def test_a_transaction_that_gives_up_leaves_the_move_of_somebody_else_alone(
    system: hf.ActorSystem, kind: str, about: str, tmp_path: Path
) -> None:
    """And does not wait for it: it was not its turn yet."""
    ref = await supervised(system, child(hf.start(Reluctant, str(tmp_path / "no")), kind))
    assert await ref.ask(Add(1), IN_TIME) == 1
    (tmp_path / "no").touch()
    moved = asyncio.ensure_future(system.set_isolation(ref, "process", timeout=IN_TIME))
    await exists(f"{tmp_path}/no.met")
    with pytest.raises(hf.TransactionFailed, match=r"not within 0\.2 s") as failed:
        async with system.transaction(timeout=0.2) as change:
            CHANGES[about](change, ref)
    assert failed.value.kept == ()
    assert not moved.done()
    (tmp_path / "no").unlink()
    await moved
    assert system.pid_of(ref) != os.getpid()
    assert await ref.ask(Add(1), IN_TIME) == 2


@pytest.mark.parametrize("kind", list(KINDS))
async def test_a_move_waits_for_another_one_no_longer_than_its_time_limit(
    system: hf.ActorSystem, kind: str, tmp_path: Path
) -> None:
    ref = await supervised(system, child(hf.start(Reluctant, str(tmp_path / "no")), kind))
    (tmp_path / "no").touch()
    moved = asyncio.ensure_future(system.set_isolation(ref, "process", timeout=IN_TIME))
    await exists(f"{tmp_path}/no.met")
    async with asyncio.timeout(20.0):
        with pytest.raises(hf.errors.CannotMove, match=r"another change of it is not over within 0\.2 s"):
            await system.set_isolation(ref, "task", timeout=0.2)
    (tmp_path / "no").unlink()
    await moved
    assert system.pid_of(ref) != os.getpid()


@pytest.mark.parametrize("about", ["isolation", "lodging"])
@pytest.mark.parametrize("kind", list(KINDS))
async def test_an_order_that_cannot_be_sent_to_the_new_place_fails_alone(
    system: hf.ActorSystem, kind: str, about: str, tmp_path: Path
) -> None:
    """It was given where it could be carried out, and comes out of the queue where it cannot."""
    ref = await supervised(system, child(hf.start(Reluctant, str(tmp_path / "no")), kind))
    assert await ref.ask(Add(1), IN_TIME) == 1
    (tmp_path / "no").touch()

    async def move() -> None:
        async with system.transaction(timeout=IN_TIME) as change:
            CHANGES[about](change, ref)

    moved = asyncio.ensure_future(move())
    await exists(f"{tmp_path}/no.met")  # It is at rest: what is ordered waits.
    replaced = asyncio.ensure_future(system.replace_state(ref, lambda state: state, timeout=IN_TIME))
    await asyncio.wait((replaced,), timeout=0.1)
    assert not replaced.done()
    (tmp_path / "no").unlink()
    with pytest.raises(hf.SpecError, match="replace_state needs a function of a module"):
        await replaced
    await moved
    assert await ref.ask(Add(1), IN_TIME) == 2
    assert system.pid_of(ref) != os.getpid()


class Die(hf.Message): ...


class Sleepy(Reluctant):
    """Can crash."""

    @hf.on(Die)
    def die(self, message: Die) -> None:
        raise ValueError("it dies")


@ABOUT
async def test_a_transaction_that_gives_up_does_not_wait_for_the_next_life(
    system: hf.ActorSystem, about: str, tmp_path: Path
) -> None:
    ref = await supervised(system, child(hf.start(Sleepy, str(tmp_path / "no"))))
    assert await ref.ask(Add(1), IN_TIME) == 1
    (tmp_path / "no").touch()
    ref.tell(Die())
    await exists(f"{tmp_path}/no.met")
    with pytest.raises(hf.TransactionFailed, match=r"not within 0\.2 s") as failed:
        async with system.transaction(timeout=0.2) as change:
            CHANGES[about](change, ref)
    assert failed.value.kept == ()
    (tmp_path / "no").unlink()
    assert await ref.ask(Add(1), IN_TIME) == 1


class Mortal(hf.Actor):
    """Each life ends as soon as it has begun."""

    def on_start(self, restored: bool) -> None:
        self.ctx.ref.tell(Die())

    @hf.on(Die)
    def die(self, message: Die) -> None:
        raise ValueError("it dies")


@ABOUT
async def test_who_crashes_again_and_again_is_named_with_the_number_of_its_ends(
    system: hf.ActorSystem, about: str
) -> None:
    ended = r"its life has ended (once|[0-9]+ times)"  # (Once: on a machine that has stood still for most of it.)
    ref = await supervised(system, child(hf.start(Mortal)))
    with pytest.raises(hf.TransactionFailed, match=rf"not within 1 s.*/app/near/one: {ended}"):
        async with system.transaction(timeout=1.0) as change:
            CHANGES[about](change, ref)
    with pytest.raises(hf.errors.CannotMove, match=rf"/app/near/one.*{ended}.*mend what ends it"):
        await system.set_isolation(ref, "process", timeout=0.5)


class Hang(hf.Message[int]): ...


class Hanging(Reluctant):
    """Has turns that hang while there is a file, and tells by another file that one has begun."""

    @hf.on(Hang)
    async def hang(self, message: Hang) -> int:
        Path(f"{self.file}.hangs").touch()
        while Path(self.file).exists():
            await asyncio.sleep(0.005)
        return self.total


def hang(ref: hf.ActorRef[Any], file: Path, *, fails: bool) -> hf.system.Operation:
    """A step behind the one that has lent it a process: its next turn hangs."""

    async def do(system: hf.ActorSystem) -> None:
        file.touch()
        ref.tell(Hang())
        if fails:
            raise hf.HoldfastError("there was a stone")

    return Stumble(do)


@pytest.mark.parametrize("fails", [False, True], ids=["committed", "given up"])
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.some(3)
async def test_the_process_that_it_is_lent_keeps_a_transaction_no_longer_than_its_time_limit(
    system: hf.ActorSystem, kind: str, fails: bool, tmp_path: Path
) -> None:
    """Its turn hangs, so it stays there, which is told, and can be moved later."""
    file = tmp_path / "no"
    ref = await supervised(system, child(hf.start(Hanging, str(file)), kind))
    assert await ref.ask(Add(1), IN_TIME) == 1
    told: tuple[str, ...] = ()
    async with asyncio.timeout(20.0):
        with system.events() as events:
            try:
                async with system.transaction(timeout=2.0) as change:
                    change.move(ref, "/app/far")
                    change.step(hang(ref, file, fails=fails))
            except hf.TransactionFailed as failed:
                told = failed.kept
            else:
                told = (await next_event(events, hf.events.TransactionCommitted)).problems
    assert "one cannot be moved: " in "".join(told)
    own = system.pid_of(ref)
    assert own not in (os.getpid(), pid_of(system, "far"))
    file.unlink()
    assert await ref.ask(Add(1), IN_TIME) == 2
    assert ref.path == ("/app/near/one" if fails else "/app/far/one")
    await system.set_isolation(ref, "task", timeout=IN_TIME)
    assert await ref.ask(Add(1), IN_TIME) == 3
    assert system.pid_of(ref) == (os.getpid() if fails else pid_of(system, "far"))


async def answers(ref: hf.ActorRef[Any]) -> int:
    """The sum, of whichever life is asked first."""
    async with asyncio.timeout(20.0):
        while True:
            try:
                return int(await ref.ask(Add(0), 20.0))
            except (hf.AskFailed, hf.ActorStopped):
                await asyncio.sleep(0.005)


@pytest.mark.parametrize("kind", list(KINDS))
async def test_the_process_of_its_new_supervisor_may_end_before_it_lives_there(
    system: hf.ActorSystem, kind: str, tmp_path: Path
) -> None:
    """It still has the process that it was lent: the next life of its supervisor begins it where its spec says."""
    file = tmp_path / "no"
    ref = await supervised(system, child(hf.start(Hanging, str(file)), kind))
    assert await ref.ask(Add(1), IN_TIME) == 1
    far = pid_of(system, "far")

    async def moved() -> None:
        async with system.transaction(timeout=10.0) as change:
            change.move(ref, "/app/far")
            change.step(hang(ref, file, fails=False))

    moving = asyncio.create_task(moved())
    async with asyncio.timeout(IN_TIME):
        while ref.path != "/app/far/one":
            await asyncio.sleep(0.005)
    assert system.pid_of(ref) != far
    os.kill(far, signal.SIGKILL)
    file.unlink()
    await moving
    assert await answers(ref) == (0 if kind == "plain" else 1)
    async with asyncio.timeout(IN_TIME):
        await system.set_isolation(ref, "task", timeout=IN_TIME)
    assert system.pid_of(ref) == pid_of(system, "far") != far


@pytest.mark.parametrize("old", ["near", "far"])
@pytest.mark.parametrize("kind", list(KINDS))
async def test_a_mechanism_that_gives_way_while_somebody_detaches_it_is_gone_once(
    system: hf.ActorSystem, kind: str, old: str
) -> None:
    """One that is on probation is taken away outside all transactions: whoever comes second finds it done."""
    ref = await supervised(system, child(hf.start(Traveller), kind), old)
    assert await ref.ask(Add(1), IN_TIME) == 1
    async with system.transaction(timeout=IN_TIME) as change:
        change.protect(ref, PBR())
    gives_way = system._moves.unprotect(ref._cell, IN_TIME)

    async def detach() -> None:
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(ref, None)

    await asyncio.gather(detach(), gives_way)
    assert await ref.ask(Add(1), IN_TIME) == 2
    assert system.pid_of(ref) == (os.getpid() if old == "near" else pid_of(system, "far"))


@pytest.mark.parametrize("overflow", ["block", "reject", "drop_newest", "drop_oldest", "latest"])
async def test_who_finds_no_room_after_a_move_is_told_so_and_the_move_is_made(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, overflow: Any
) -> None:
    """What is sent while it is on its way out of its supervisor's process comes behind what waits in a full mailbox."""
    mailbox = hf.bounded(2, overflow=overflow)
    ref = await supervised(system, child(hf.start(Traveller), mailbox=mailbox), "far")
    await system.suspend(ref)
    asks = [ref.ask(Add(n), IN_TIME) for n in (1, 2)]
    let_go = FromSubtree.let_go

    async def let_go_late(side: FromSubtree) -> None:
        for n in (3, 4, 5):
            ref.tell(Add(n))
        await let_go(side)

    monkeypatch.setattr(FromSubtree, "let_go", let_go_late)
    await system.set_isolation(ref, "process", timeout=IN_TIME)
    await system.resume(ref)
    async with asyncio.timeout(20.0):
        told = await asyncio.gather(*asks, return_exceptions=True)
    added = (await ref.ask(Seen(), IN_TIME))["added"]
    assert [n for n in added if n < 3] == [n for n, one in enumerate(told, start=1) if isinstance(one, int)]
    assert added == [1, 2] if overflow in ("block", "reject", "drop_newest") else added[-1] == 5
    assert system.pid_of(ref) not in (os.getpid(), pid_of(system, "far"))
