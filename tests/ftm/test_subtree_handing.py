"""Children without recovery below a supervisor in another process: they get a mechanism, or a process of their own.

They have no home before, and none afterwards: what they have goes along, there and back.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.migration.move import Move
from holdfast.actors.process.wire.peer import OutsideHost
from holdfast.checkpoint.places.subtree_place import SubtreePlace
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.migration.subtree_moves import FromSubtree
from tests.ftm.accounts import Add, Boom, Counter, Later, Load, Tags
from tests.ftm.test_failover import SEED, group_of, pid_of, two_again
from tests.ftm.test_subtree import Heard, Watch, Watcher, at, bank, bank_pid
from tests.ftm.test_subtree_changes import Bad, Slow, Wait, attach, begun, detach, kill_subtree, names_of

# A refused or failed transaction ends with its block.
# ruff: noqa: PT012


def plain(name: str = "alice", recipe: Any = None, **options: Any) -> hf.ChildSpec:
    return hf.child(name, recipe or hf.start(Counter), **options)


async def apart(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    await system.set_isolation(ref, "process", timeout=60.0)


async def together(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    await system.set_isolation(ref, "task", timeout=60.0)


WAYS = {"replicas": (attach, detach), "process": (apart, together)}
BOTH_WAYS = pytest.mark.parametrize("way", list(WAYS))
REFUSED = (hf.TransactionFailed, hf.TransactionRefused, hf.errors.CannotMove)


def is_out(system: hf.ActorSystem, ref: hf.ActorRef[Any], way: str) -> bool:
    """Whether it lives outside the process of its supervisor, as it does this way."""
    if way == "replicas":
        return isinstance(ref._cell.host.place, GroupPlace)
    return system.pid_of(ref) != bank_pid(system)


class Talk(hf.Message[int]):
    tag: int


class Sibling(hf.Actor):
    """Tells and asks from within the process."""

    @hf.on(Talk)
    async def talk(self, message: Talk) -> int:
        alice = self.ctx.find("/app/bank/alice", Counter)
        alice.tell(Add(message.tag))
        return await alice.ask(Add(message.tag + 1), timeout=30.0)


class Talking:
    """One after the other, until it is stopped."""

    def __init__(self, sibling: hf.ActorRef[Any], first: int) -> None:
        self.first = self.next = first
        self._stopping = False
        self._task = asyncio.create_task(self._talk(sibling))

    async def _talk(self, sibling: hf.ActorRef[Any]) -> None:
        while not self._stopping:
            await sibling.ask(Talk(self.next), timeout=40.0)
            self.next += 2

    async def stop(self) -> list[int]:
        self._stopping = True
        await self._task
        return list(range(self.first, self.next))


@BOTH_WAYS
async def test_there_and_back_under_load_nothing_is_lost(system: hf.ActorSystem, way: str) -> None:
    """From outside and from a sibling, once and in order; nothing is left of a home."""
    await system.start(bank(plain(mailbox=hf.bounded(64)), plain("sibling", hf.start(Sibling))))
    alice = at(system, "alice")
    load, talking = Load(alice), Talking(at(system, "sibling"), 1_000_000)
    out, home = WAYS[way]
    for _ in range(2):
        await load.reached(30)
        await out(system, alice)
        assert is_out(system, alice, way)
        await load.reached(30)
        if way == "replicas":
            await two_again(alice)
            os.kill(pid_of(system, alice, group_of(alice).membership.primary or ""), signal.SIGKILL)
            await load.reached(30)
            await two_again(alice)
        await home(system, alice)
        assert isinstance(alice._cell.host, OutsideHost)
        assert system._homes.at(alice.path) is None
    await load.reached(30)
    said = await talking.stop()
    await load.stop()
    tags = await alice.ask(Tags())
    assert [tag for tag in tags if tag >= 1_000_000] == said
    assert not load.failed
    assert sorted(tag for tag in tags if tag < 1_000_000) == list(range(load.sent))
    place = {tag: index + 1 for index, tag in enumerate(tags)}
    assert {tag: place[tag] for tag in load.answered} == load.answered
    assert system.pid_of(alice) == bank_pid(system)


def is_to_rest(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> bool:
    """Whether whoever lives there has been told to come to rest."""
    if isinstance(ref._cell.host.place, GroupPlace):
        return group_of(ref).delivery.is_stopping
    top = system._node.cell_at("/app/bank").host.place
    assert isinstance(top, SubtreePlace)
    move = system._moves._under_way.get(ref._cell)
    return top.at(ref.path).arriving is not None or (move is not None and hasattr(move.leaving, "taken"))


@BOTH_WAYS
async def test_what_waits_goes_along_in_order_both_ways(system: hf.ActorSystem, tmp_path: Path, way: str) -> None:
    file = tmp_path / "slow"
    slow = plain(recipe=hf.start(Slow, str(file)))
    await system.start(bank(slow, plain("sibling", hf.start(Sibling)), plain("other")))
    alice, sibling = at(system, "alice"), at(system, "sibling")
    tag = 0
    for change in WAYS[way]:
        file.touch()
        file.with_suffix(".begun").unlink(missing_ok=True)
        waiting: list[Any] = [asyncio.ensure_future(alice.ask(Wait(), timeout=30.0))]
        await begun(file)
        alice.tell(Add(tag))
        waiting.append(asyncio.ensure_future(sibling.ask(Talk(tag + 1), timeout=30.0)))
        changing = asyncio.ensure_future(change(system, alice))
        waiting.append(asyncio.ensure_future(alice.ask(Add(tag + 3), timeout=30.0)))
        async with asyncio.timeout(30):
            while not is_to_rest(system, alice):
                await asyncio.sleep(0.005)
        await at(system, "other").ask(Tags())  # It has been told by now; there is one turn that it waits for.
        file.unlink()
        await asyncio.gather(changing, *waiting)
        tag += 4
    tags = await alice.ask(Tags())
    assert sorted(tags) == list(range(8))
    for first in (0, 4):
        assert tags.index(first) < tags.index(first + 3)
        assert tags.index(first + 1) < tags.index(first + 2)


class Odd(hf.Message[int]):
    """Goes to a sibling in the same process, and nowhere else."""

    what: Any


class Odder(Counter):
    @hf.on(Odd)
    def odd(self, message: Odd) -> int:
        return 0


class Say(hf.Message[None]): ...


class Outcome(hf.Message[list[str]]): ...


class Speaker(hf.Actor):
    """A sibling that tells and asks what cannot leave the process."""

    @hf.on(Say)
    def say(self, message: Say) -> None:
        alice = self.ctx.find("/app/bank/alice", Odder)
        alice.tell(Add(0))
        alice.tell(Odd(object()))
        self.asked = [alice.ask(one, timeout=30.0) for one in (Odd(object()), Add(1))]

    @hf.on(Outcome)
    async def outcome(self, message: Outcome) -> list[str]:
        return [type(one).__name__ for one in await asyncio.gather(*self.asked, return_exceptions=True)]


async def test_a_message_that_cannot_leave_the_process_is_refused_and_all_others_go_along(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They come when it is at rest; of those that were there before, one would have kept it where it is."""
    let_go = FromSubtree.let_go
    await system.start(bank(plain(recipe=hf.start(Odder)), plain("sibling", hf.start(Speaker))))
    alice, sibling = at(system, "alice"), at(system, "sibling")

    async def lets_go(leaving: FromSubtree) -> None:
        await sibling.ask(Say())
        await let_go(leaving)

    monkeypatch.setattr(FromSubtree, "let_go", lets_go)
    with system.events() as events:
        await attach(system, alice)
        assert await sibling.ask(Outcome(), timeout=30.0) == ["BadMessage", "int"]
        assert await alice.ask(Tags()) == [0, 1]
        letters = [one for one in events.take() if isinstance(one, hf.events.DeadLetter)]
    assert [one.address for one in letters] == [alice.path]
    assert "a value of type object cannot be sent" in letters[0].why


class Unheard(hf.Message[None]): ...


async def test_what_is_sent_when_it_is_about_to_leave_is_held_or_refused_as_ever(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    await system.start(bank(plain()))
    alice, say, asked = at(system, "alice"), Move.say_now, list[asyncio.Future[int]]()

    def said(move: Move, worker: Any, which: str, **told: Any) -> None:
        if which == "leave":
            with pytest.raises(hf.UnknownMessage):
                alice.tell(Unheard())
            alice.tell(Add(0))
            asked.append(asyncio.ensure_future(alice.ask(Add(1), timeout=30.0)))
        say(move, worker, which, **told)

    monkeypatch.setattr(Move, "say_now", said)
    await attach(system, alice)
    assert await asyncio.gather(*asked) == [2]
    assert await alice.ask(Tags()) == [0, 1]


@BOTH_WAYS
@pytest.mark.parametrize("whom", ["/app/target", "/app/bank/target"])
async def test_timers_and_ties_go_along(system: hf.ActorSystem, way: str, whom: str) -> None:
    """Who watches it, inside or outside, hears once of its end; it hears of those it watches."""
    await system.start(bank(plain(recipe=hf.start(Watching)), plain("inside", hf.start(Watcher)), plain("target")))
    outside = await system.start(hf.child("outside", hf.start(Watcher)))
    alice, inside = at(system, "alice"), at(system, "inside")
    await system.start(hf.child("target", hf.start(Counter)))
    target = system.ref(whom, Counter)
    await inside.ask(Watch("monitor"))
    await outside.ask(Watch("monitor"))
    await alice.ask(See(whom))
    await alice.ask(Later(0.3, 7))
    out, home = WAYS[way]
    await out(system, alice)
    await system.terminate(target)
    await seen(alice, [whom])
    await ticked(alice, [7])
    await alice.ask(Later(0.3, 8))
    await alice.ask(See(whom))
    await home(system, alice)
    await system.terminate(target)
    await seen(alice, [whom] * 2)
    await ticked(alice, [7, 8])
    house = system.ref("/app/bank", hf.Supervisor)
    await house.ask(hf.TerminateChild("alice"))
    for watcher in (inside, outside):
        assert await watcher.ask(Heard()) == ["down False"]


class See(hf.Message[None]):
    path: str


class Seen(hf.Message[list[str]]): ...


class Watching(Counter):
    """Watches others."""

    def __init__(self) -> None:
        super().__init__()
        self.ended: list[str] = []

    @hf.on(See)
    def see(self, message: See) -> None:
        self.ctx.monitor(self.ctx.find(message.path, Counter))

    def on_down(self, source: Any, reason: hf.ExitReason, recovering: bool) -> None:
        self.ended.append(source.path)

    @hf.on(Seen, readonly=True)
    def told(self, message: Seen) -> list[str]:
        return self.ended


async def seen(ref: hf.ActorRef[Any], paths: list[str]) -> None:
    async with asyncio.timeout(20):
        while await ref.ask(Seen()) != paths:
            await asyncio.sleep(0.01)


async def ticked(ref: hf.ActorRef[Any], tags: list[int]) -> None:
    async with asyncio.timeout(20):
        while await ref.ask(Tags()) != tags:
            await asyncio.sleep(0.01)


async def test_what_was_attached_or_detached_holds_over_restarts(system: hf.ActorSystem) -> None:
    """Each life begins afresh, as its spec says then."""
    await system.start(bank(hf.supervisor("inner", children=[plain("deep")], intensity=1000)))
    ref = at(system, "inner/deep")
    assert await ref.ask(Add(0)) == 1
    await attach(system, ref, LFR())
    assert await ref.ask(Add(1)) == 2
    await system.terminate(ref)
    assert await ref.ask(Add(2), timeout=30.0) == 1
    assert names_of(ref) == ["lfr"]
    await kill_subtree(system)
    ref = at(system, "inner/deep")
    assert await ref.ask(Add(3), timeout=30.0) == 1
    assert names_of(ref) == ["lfr"]
    await detach(system, ref)
    assert await ref.ask(Add(4)) == 2
    with pytest.raises(hf.RemoteCrash, match="boom"):
        await ref.ask(Boom())
    assert await ref.ask(Add(5), timeout=30.0) == 1
    assert system.pid_of(ref) == bank_pid(system)


class Keep(hf.Message[int]):
    tag: int


class Follow(hf.Message[None]): ...


class News(hf.Message[None]):
    text: str


class Read(hf.Message[list[str]]): ...


class Open(hf.Message[None]): ...


class Keeper(hf.Actor):
    """Puts aside what comes until it is opened, and follows the news."""

    def __init__(self) -> None:
        self.is_open = False
        self.read: list[str] = []

    @hf.on(Keep)
    def keep(self, message: Keep) -> int:
        if not self.is_open:
            self.ctx.stash()
        self.read.append(str(message.tag))
        return message.tag

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.read.clear()
        self.ctx.unstash()

    @hf.on(Follow)
    def follow(self, message: Follow) -> None:
        self.ctx.subscribe("/news")

    @hf.on(News)
    def news(self, message: News) -> None:
        self.read.append(message.text)

    @hf.on(Read, readonly=True)
    def said(self, message: Read) -> list[str]:
        return [one for one in self.read if not one.isdigit()] if not self.is_open else self.read


@BOTH_WAYS
async def test_what_is_put_aside_and_subscribed_to_goes_along(system: hf.ActorSystem, way: str) -> None:
    await system.start(bank(plain(recipe=hf.start(Keeper))))
    alice = at(system, "alice")
    await alice.ask(Follow())
    kept = []
    for tag, change in enumerate((*WAYS[way], None)):
        kept.append(asyncio.ensure_future(alice.ask(Keep(tag), timeout=30.0)))
        await system.publish("/news", News("abc"[tag]))
        assert await alice.ask(Read()) == list("abc"[: tag + 1])
        if change is not None:
            await change(system, alice)
    await alice.ask(Open())
    assert await asyncio.gather(*kept) == [0, 1, 2]
    assert await alice.ask(Read()) == ["0", "1", "2"]


class Listing(Keeper):
    @hf.on(News)
    def news(self, message: News) -> None:
        if not self.is_open:
            self.ctx.stash()
        self.read.append(f"{message.text} of {self.ctx.sender and self.ctx.sender.path}")


class Reporter(hf.Actor):
    @hf.on(Keep)
    async def keep(self, message: Keep) -> int:
        alice = self.ctx.find("/app/bank/alice", Listing)
        for text in ("one", "two"):
            alice.tell(News(text))
        return await alice.ask(message, timeout=30.0)


async def test_what_is_put_aside_keeps_its_order_and_its_sender(system: hf.ActorSystem) -> None:
    await system.start(bank(plain(recipe=hf.start(Listing)), plain("sibling", hf.start(Reporter))))
    alice = at(system, "alice")
    kept = asyncio.ensure_future(at(system, "sibling").ask(Keep(3), timeout=30.0))
    async with asyncio.timeout(20):
        while len(await alice.ask(Read())) < 2:  # The ask behind them was sent in the same turn.
            await asyncio.sleep(0.005)
    await attach(system, alice)
    assert len(await alice.ask(Read())) == 2, "it is not handed the same again"
    await alice.ask(Open())
    assert await kept == 3
    assert await alice.ask(Read()) == ["one of /app/bank/sibling", "two of /app/bank/sibling", "3"]


@pytest.mark.parametrize(
    ("way", "victim"), [("replicas", "subtree"), ("replicas", "replica"), ("process", "subtree"), ("process", "own")]
)
async def test_whatever_dies_while_it_is_handed_over_it_is_there_again(
    system: hf.ActorSystem, way: str, victim: str
) -> None:
    """With a replica nothing is lost; with the subtree the child begins afresh, as the specs say then."""
    rng = random.Random(f"{SEED} {victim}" if way == "replicas" else f"{SEED} {way} {victim}")
    out, home = WAYS[way]
    await system.start(bank(plain()))
    tag = 0
    for change in (out, home, out, home):
        alice = at(system, "alice")
        before = await alice.ask(Tags(), timeout=30.0)
        answering = [asyncio.ensure_future(alice.ask(Add(tag + number), timeout=30.0)) for number in range(5)]
        changing = asyncio.ensure_future(change(system, alice))
        await asyncio.sleep(rng.random() * 0.4)
        replica = f"/app/bank/alice/ftm/{rng.choice(['r1', 'r2'])}"
        path = {"subtree": "/app/bank", "own": "/app/bank/alice", "replica": replica}[victim]
        pid = system._workers.processes().get(path)
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):  # It has just ended.
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(*REFUSED):
            await changing
        async with asyncio.timeout(30):
            while pid is not None and system._workers.processes().get(path) == pid:
                await asyncio.sleep(0.005)
        said = await asyncio.gather(*answering, return_exceptions=True)
        alice = await back(system)
        tags = await alice.ask(Tags(), timeout=30.0)
        assert len(set(tags)) == len(tags)
        if victim == "replica":
            assert said == [len(before) + 1 + number for number in range(5)]
            assert tags == [*before, *range(tag, tag + 5)]
        tag += 5
        with contextlib.suppress(hf.TransactionRefused):  # Then it is as it should be already.
            await change(system, alice)
        assert is_out(system, alice, way) is (change is out)


@BOTH_WAYS
@pytest.mark.parametrize("step", ["take", "leave", "come", "settle"])
async def test_the_process_dies_at_a_step_and_the_child_begins_afresh(
    system: hf.ActorSystem, step: str, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing of what was begun is left if it was not to be, and nobody who has asked waits for ever."""
    (out, home), say = WAYS[way], Move.say_now
    change = out if step in ("take", "leave") else home
    there: dict[str, Any] = {"mechanism": PBR()} if way == "replicas" else {"isolation": "process"}
    await system.start(bank(plain(**({} if change is out else there))))
    alice, pid = at(system, "alice"), bank_pid(system)
    asking: list[asyncio.Future[int]] = []

    async def ask(tag: int) -> int:
        return await alice.ask(Add(tag), timeout=30.0)

    def said(move: Move, worker: Any, which: str, **told: Any) -> None:
        if which == step and worker.pid == pid and not asking:  # Else it is done again, of the next life.
            asking.extend(asyncio.ensure_future(ask(tag)) for tag in (1, 2))
            os.kill(pid, signal.SIGKILL)
        say(move, worker, which, **told)

    monkeypatch.setattr(Move, "say_now", said)
    assert await alice.ask(Add(0)) == 1
    with contextlib.suppress(*REFUSED):
        await change(system, alice)
    said_to = await asyncio.gather(*asking, return_exceptions=True)
    assert not [one for one in said_to if isinstance(one, hf.AskTimeout)]
    alice = await back(system)
    tags = await alice.ask(Tags())
    assert tags in ([], [1], [2], [1, 2])
    monkeypatch.undo()
    if not is_out(system, alice, way):  # Each step is done, or is not.
        async with asyncio.timeout(20):
            while [path for path in system._workers.processes() if path.startswith("/app/bank/alice")]:
                await asyncio.sleep(0.01)
        await out(system, alice)
    await home(system, alice)
    assert await alice.ask(Add(3)) == len(tags) + 1


async def back(system: hf.ActorSystem) -> hf.ActorRef[Any]:
    """Whoever lives there, when somebody does again."""
    async with asyncio.timeout(30):
        while True:
            with contextlib.suppress(hf.HoldfastError):
                await at(system, "alice").ask(Tags(), timeout=5.0)
                return at(system, "alice")
            await asyncio.sleep(0.01)


async def test_undone_with_its_transaction_it_lives_as_before(system: hf.ActorSystem) -> None:
    await system.start(bank(plain(), plain("bob", mechanism=PBR())))
    alice, bob = at(system, "alice"), at(system, "bob")
    loads = Load(alice, clients=2), Load(bob, clients=2)
    for load in loads:
        await load.reached(10)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=30) as change:
            change.protect(alice, LFR())
            change.protect(bob, None)
            change.add("/app/bank", hf.child("bad", hf.start(Bad)))
    assert isinstance(alice._cell.host, OutsideHost)
    assert names_of(bob) == ["pbr"]
    for load, ref in zip(loads, (alice, bob), strict=True):
        await load.reached(10)
        await load.stop()
        load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("verb", ["attach", "detach", "apart", "together"])
async def test_a_turn_that_does_not_end_rolls_it_back(system: hf.ActorSystem, tmp_path: Path, verb: str) -> None:
    file = tmp_path / "slow"
    file.touch()
    places: dict[str, dict[str, Any]] = {"detach": {"mechanism": PBR()}, "together": {"isolation": "process"}}
    await system.start(bank(plain(recipe=hf.start(Slow, str(file)), **places.get(verb, {}))))
    alice = at(system, "alice")
    waiting = [asyncio.ensure_future(alice.ask(message, timeout=30)) for message in (Wait(), Add(0))]

    async def change(seconds: float) -> None:
        async with system.transaction(timeout=seconds) as collected:
            match verb:
                case "attach":
                    collected.protect(alice, PBR())
                case "detach":
                    collected.protect(alice, None)
                case _:
                    collected.isolation(alice, "process" if verb == "apart" else "task")

    await begun(file)
    with pytest.raises(hf.TransactionFailed):
        await change(1.0)
    file.unlink()
    assert await asyncio.gather(*waiting) == [0, 1]
    await change(30.0)
    assert await alice.ask(Add(1)) == 2


class Unfit(Counter):
    """Cannot begin a second time as long as there is a file."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self._file = file
        if Path(file).exists():
            raise RuntimeError("not now")


@BOTH_WAYS
async def test_a_new_life_that_cannot_begin_leaves_the_old_one(
    system: hf.ActorSystem, tmp_path: Path, way: str
) -> None:
    file = tmp_path / "veto"
    await system.start(bank(plain(recipe=hf.start(Unfit, str(file))), plain("sibling", hf.start(Sibling))))
    alice, sibling = at(system, "alice"), at(system, "sibling")
    for number, change in enumerate(WAYS[way]):
        file.touch()
        load, talking = Load(alice, clients=2), Talking(sibling, 1_000_000 * (number + 1))
        await load.reached(5)
        with pytest.raises(REFUSED, match="not now"):
            await change(system, alice)
        await load.reached(5)
        said = await talking.stop()
        await load.stop()
        assert not load.failed
        assert [tag for tag in await alice.ask(Tags()) if tag >= 1_000_000 * (number + 1)] == said
        file.unlink()
        await change(system, alice)
