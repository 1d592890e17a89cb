"""What the runtime knows, as literals: no actor here says a word about itself."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.literals import Literal, crashes, keeps_up, progress, replies, room, waits_for
from holdfast.diagnosis.observers import RuntimeObserver
from holdfast.testing import advance

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Go(hf.Message[int]):
    """Do it; "ask ADDRESS", "freeze", "crash", "stop" or nothing."""

    what: str = ""
    timeout: float = 60.0


class Sorry(hf.Refusal):
    """It cannot be done now."""


async def in_vain() -> None:
    await asyncio.sleep(3.0)
    raise OSError("nobody is there")


class Worker(hf.Actor):
    @hf.on(Go)
    async def go(self, message: Go) -> int:
        match message.what.split():
            case ["ask", address]:
                await self.ctx.find(address, Worker).ask(Go("", message.timeout), timeout=message.timeout)
            case ["wrap", address]:
                try:
                    await self.ctx.find(address, Worker).ask(Go("crash"))
                except hf.HoldfastError:
                    raise ValueError("something of ours does not work") from None
            case ["both", address]:
                await asyncio.sleep(0.05)
                async with asyncio.timeout(60.0):  # Not refused at once: it may end before.
                    await self.ctx.find(address, Worker).ask(Go("", message.timeout), timeout=message.timeout)
            case ["freeze"]:
                await asyncio.Event().wait()
            case ["crash"]:
                raise RuntimeError("broken")
            case ["stop"]:
                self.ctx.stop()
            case ["refuse"]:
                raise Sorry
            case ["refused", address]:
                await self.ctx.find(address, Worker).ask(Go("refuse"))
            case ["refused", address, "by", other]:
                await self.ctx.find(address, Worker).ask(Go(f"refused {other}"))
            case ["gone"]:
                gone = self.ctx.spawn(hf.start(Worker))
                gone.kill()
                await gone.ask(Go())
            case ["aside"]:
                self.ctx.stash()
            case ["long", seconds]:
                await asyncio.sleep(float(seconds))
            case ["retry", times]:
                for n in range(int(times)):
                    with contextlib.suppress(hf.errors.EffectFailed):
                        await self.ctx.effect(in_vain, key=f"post {n}")
                    await self.ctx.sleep(0.5)
            case _:
                pass
        return 1


class Late(Worker):
    """Its start takes until a gate is open."""

    def __init__(self, gate: asyncio.Event) -> None:
        self._gate = gate

    async def on_start(self, restored: bool) -> None:
        await self._gate.wait()


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        children = [hf.child(name, hf.start(Worker)) for name in ("a", "b", "c")]
        full = hf.child("full", hf.start(Worker), mailbox=hf.bounded(3))
        await running.start(hf.supervisor("all", intensity=100, period=1.0, children=[*children, full]))
        yield running


def worker(system: hf.ActorSystem, name: str) -> hf.ActorRef[Worker]:
    return system.ref(f"/t/all/{name}", Worker)


async def watched(system: hf.ActorSystem) -> diagnosis.Watch:
    """Diagnosis, after everybody has got on for a while."""
    watching = await diagnosis.watch(system, seconds=0.1)
    for _ in range(40):
        for name in ("a", "b", "c", "full"):
            await worker(system, name).ask(Go())
        await advance(0.1)
    assert (await watching.diagnosis()).state is State.HEALTHY
    return watching


async def asked(*asks: Any) -> None:
    """Wait for asks that come to nothing."""
    await asyncio.gather(*asks, return_exceptions=True)


async def test_a_frozen_callee_is_certain_behind_two_that_wait_for_it(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    worker(system, "c").tell(Go("freeze"))
    worker(system, "b").tell(Go("ask /t/all/c"))
    worker(system, "a").tell(Go("ask /t/all/b"))
    await advance(1.3)
    found = await watching.diagnosis()
    assert (found.certain, [one.bad for one in found.candidates]) == (("all/c",), [("all/c",)])
    observed = await watching.observed()
    assert {progress("all/c"), replies("all/c")} <= observed.negative
    assert not {progress("all/a"), progress("all/b"), replies("all/a"), replies("all/b")} & observed.negative
    await advance(1.5)  # The model has learned who asks whom.
    assert waits_for("all/b", "all/c") in (await watching.observed()).positive
    assert (await watching.diagnosis()).certain == ("all/c",)


async def test_a_time_out_names_the_callee_though_it_was_never_seen_to_get_on(system: hf.ActorSystem) -> None:
    watching = await diagnosis.watch(system, seconds=0.1)
    worker(system, "c").tell(Go("freeze"))
    await asked(worker(system, "c").ask(Go(), timeout=3.0))
    await advance(0.3)
    assert (await watching.diagnosis()).certain == ("all/c",)


@pytest.mark.parametrize("asker", ["nobody", "an actor", "a recorded actor"])
async def test_who_refuses_is_not_seen_to_work(system: hf.ActorSystem, asker: str) -> None:
    """A refusal is an answer, and no evidence that it could give another one; nor is it a fault."""
    recovery = hf.hybrid() if asker == "a recorded actor" else None
    other = await system.start(hf.child("other", hf.start(Worker), recovery=recovery))
    watching = await watched(system)
    assert replies("all/c") in (await watching.observed()).positive
    if asker == "nobody":
        await asked(worker(system, "c").ask(Go("refuse")))
    else:
        await asked(other.ask(Go("refused /t/all/c")))
    await worker(system, "c").ask(Go())  # What it has in hand is another ask, which it answers.
    await advance(0.5)
    observed = await watching.observed()
    assert replies("all/c") not in observed.positive | observed.negative
    await advance(5.0)
    await worker(system, "c").ask(Go())
    await advance(0.5)
    assert replies("all/c") in (await watching.observed()).positive


@pytest.mark.parametrize("way", ["refused /t/all/c", "refused /t/all/b by /t/all/c"])
async def test_who_only_refuses_any_more_is_named_once_turns_of_others_come_to_nothing(
    system: hf.ActorSystem, way: str
) -> None:
    watching = await watched(system)
    for turn in range(20):  # What it refuses is one thing, and what it does another.
        worker(system, "a").tell(Go(way))
        await advance(0.5)
        if turn in (1, 5, 9):
            await worker(system, "c").ask(Go())
            await advance(0.5)
        assert (await watching.diagnosis()).state is State.HEALTHY
    for _ in range(8):  # Seventeen in a row: more than four times four.
        worker(system, "a").tell(Go(way))
        await advance(0.5)
    assert (await watching.diagnosis()).certain == ("all/c",)
    assert progress("all/c") in (await watching.observed()).positive
    await worker(system, "c").ask(Go())
    await advance(5.5)
    assert (await watching.diagnosis()).state is State.HEALTHY


async def test_who_was_never_seen_to_answer_otherwise_may_refuse(system: hf.ActorSystem) -> None:
    other = await system.start(hf.child("other", hf.start(Worker)))
    watching = await watched(system)
    for _ in range(20):
        worker(system, "a").tell(Go(f"refused {other.path}"))
        await advance(0.5)
    assert (await watching.diagnosis()).state is State.HEALTHY


async def test_who_asks_one_that_has_ended_for_good_crashes_by_itself(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    for _ in range(3):
        worker(system, "a").tell(Go("gone"))
        await advance(0.5)
    assert crashes("all/a") in (await watching.observed()).positive
    await advance(1.0)
    assert (await watching.diagnosis()).certain == ("all/a",)


async def test_in_a_circle_of_asks_all_are_certain(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    worker(system, "a").tell(Go("both /t/all/b"))
    worker(system, "b").tell(Go("both /t/all/a"))
    await advance(1.5)
    assert set((await watching.diagnosis()).certain) == {"all/a", "all/b"}


async def test_a_long_turn_that_nobody_waits_for_and_one_that_is_usual_are_no_fault(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    worker(system, "a").tell(Go("long 30"))
    await advance(10.0)
    assert (await watching.diagnosis()).state is State.HEALTHY
    await advance(25.0)
    asking = asyncio.ensure_future(worker(system, "a").ask(Go("long 50"), timeout=90.0))
    await advance(40.0)
    assert (await watching.diagnosis()).state is State.HEALTHY
    await advance(20.0)
    assert await asking == 1


async def told_steadily(ref: hf.ActorRef[Worker], seconds: float, watching: diagnosis.Watch) -> set[Literal]:
    """Tell it something now and then; returns what was said against anybody."""
    against: set[Literal] = set()
    for n in range(int(10 * seconds)):
        if n % 3 == 0:
            ref.tell(Go())
        await advance(0.1)
        against |= (await watching.observed()).negative
    return against


async def test_of_who_is_only_told_things_it_is_not_said_that_it_does_not_answer(system: hf.ActorSystem) -> None:
    watching, told = await watched(system), worker(system, "a")
    told.tell(Go("long 9"))
    against = await told_steadily(told, 8.5, watching)
    assert progress("all/a") in against  # Messages wait, and it does not say that it rests.
    assert replies("all/a") not in against
    assert await told_steadily(told, 3.0, watching) <= {progress("all/a")}
    assert (await watching.observed()).negative == frozenset()  # It works again.
    assert (await watching.diagnosis()).state is State.HEALTHY


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["none", "hybrid"])
async def test_who_rests_in_its_turn_as_it_has_said_is_not_accused_by_who_tells_it_things(
    system: hf.ActorSystem, recovery: hf.Method | None
) -> None:
    uploader = await system.start(hf.child("uploader", hf.start(Worker), recovery=recovery))
    watching = await watched(system)
    assert await told_steadily(uploader, 10.0, watching) == set()
    uploader.tell(Go("retry 20"))
    assert await told_steadily(uploader, 65.0, watching) == set()
    assert (await watching.diagnosis()).state is State.HEALTHY
    asking = asyncio.ensure_future(asked(uploader.ask(Go(), timeout=2.0)))
    assert replies("uploader") in await told_steadily(uploader, 3.0, watching)  # Somebody waits for it.
    await asking
    assert keeps_up("uploader") not in await told_steadily(uploader, 20.0, watching)
    assert (await watching.observed()).negative == frozenset()


async def test_turns_that_only_get_longer_are_no_measure_for_the_next_one(system: hf.ActorSystem) -> None:
    watching, tired = await watched(system), worker(system, "a")
    for turn in range(1, 9):
        tired.tell(Go(f"long {0.3 * turn}"))
    against: set[Literal] = set()
    for _ in range(80):
        await advance(0.1)
        against |= (await watching.observed()).negative
    assert against == {progress("all/a")}


async def test_how_long_its_turns_have_taken_is_usual_when_it_has_come_to_their_end(system: hf.ActorSystem) -> None:
    watching, slow = await watched(system), worker(system, "a")
    slow.tell(Go("long 0.9"))
    await advance(2.0)
    for _ in range(5):
        slow.tell(Go("long 3.2"))
    for _ in range(170):
        await advance(0.1)
        assert not (await watching.observed()).negative


async def test_who_is_asked_and_does_not_come_back_is_named_by_those_who_wait(system: hf.ActorSystem) -> None:
    """Its start hangs: that is seen before anybody has looked twice whether it runs."""
    gate = asyncio.Event()
    gate.set()
    keeper = system.ref("/t/all", hf.Supervisor)
    await keeper.ask(hf.StartChild(hf.child("late", hf.start(Late, gate))))
    watching = await diagnosis.watch(system, seconds=0.1)
    late, asker = system.ref("/t/all/late", Late), worker(system, "a")
    for _ in range(40):
        await asker.ask(Go("ask /t/all/late"))
        await advance(0.1)
    gate.clear()
    late.tell(Go("crash"))
    asker.tell(Go("ask /t/all/late"))
    await advance(2.1)  # A start is given a second by whoever looks at it.
    assert {progress("all/late"), replies("all/late")} <= (await watching.observed()).negative
    assert (await watching.diagnosis()).certain == ("all/late",)
    gate.set()
    await advance(3.0)
    assert (await watching.diagnosis()).state is State.HEALTHY


async def test_that_it_does_not_answer_is_unknown_again_when_the_last_reason_is_old(system: hf.ActorSystem) -> None:
    watching, late = await watched(system), worker(system, "a")
    asking = asyncio.ensure_future(asked(late.ask(Go("long 9"), timeout=3.0)))
    assert replies("all/a") in await told_steadily(late, 4.0, watching)
    await asking
    await told_steadily(late, 17.0, watching)  # Ten seconds behind the last ask that ran out, and its turn.
    observed = await watching.observed()
    assert replies("all/a") not in observed.negative | observed.positive
    await late.ask(Go())
    await advance(0.3)
    assert replies("all/a") in (await watching.observed()).positive


async def test_a_full_mailbox_says_nothing_of_asks_that_nobody_has_made(system: hf.ActorSystem) -> None:
    watching, full = await watched(system), worker(system, "full")
    senders = [asyncio.ensure_future(full.send(Go("long 0.8"))) for _ in range(12)]  # Who waits takes any room.
    against: set[Literal] = set()
    for _ in range(60):
        await advance(0.1)
        against |= (await watching.observed()).negative
    assert against == {room("all/full")}  # It gets on.
    await asyncio.gather(*senders)


@pytest.mark.parametrize("end", ["crash", "stop"])
async def test_a_crash_loop_is_certain_and_one_crash_is_none(system: hf.ActorSystem, end: str) -> None:
    watching = await watched(system)
    worker(system, "b").tell(Go(end))
    await advance(1.5)
    assert (await watching.diagnosis()).state is State.HEALTHY
    for _ in range(2):
        worker(system, "b").tell(Go(end))
        await advance(1.0)
    assert (await watching.diagnosis()).certain == ("all/b",)
    assert crashes("all/b") in (await watching.observed()).positive
    assert "not progress(all/b): all/b is faulty" in (await watching.why()).text


async def test_who_crashes_because_another_one_does_not_answer_is_not_to_blame(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    worker(system, "c").tell(Go("freeze"))
    for _ in range(4):
        worker(system, "a").tell(Go("ask /t/all/c", 0.5))
        await advance(1.0)
    found = await watching.diagnosis()
    assert [one.bad for one in found.candidates] == [("all/c",)]


@pytest.mark.parametrize("way", ["wrap /t/all/c", "ask /t/all/c"])
async def test_a_callee_in_a_crash_loop_is_certain_whatever_its_callers_raise(system: hf.ActorSystem, way: str) -> None:
    watching = await watched(system)
    for _ in range(4):
        if "ask" in way:
            worker(system, "c").tell(Go("crash"))
        worker(system, "b").tell(Go(way))
        await advance(1.0)
    found = await watching.diagnosis()
    assert [one.bad for one in found.candidates] == [("all/c",)]


async def test_a_full_mailbox_is_certain(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    full = worker(system, "full")
    full.tell(Go("long 3"))
    for _ in range(200):  # It gets on, and still there is no room.
        while (cell := full._cell).has_room and cell.more is not None and cell.more.bound is not None:
            if cell.more.bound.count == cell.more.bound.capacity:
                break
            full.tell(Go("long 0.5"))
        await advance(0.1)
        if room("all/full") in (await watching.observed()).negative:
            break
    assert (await watching.diagnosis()).certain == ("all/full",)


async def test_nothing_is_said_of_who_was_asked_nothing_and_it_is_unknown(system: hf.ActorSystem) -> None:
    watching = await diagnosis.watch(system, seconds=0.1)
    await worker(system, "a").ask(Go())
    await advance(1.0)
    found = await watching.diagnosis()
    assert set(found.unknown) == {"all/b", "all/c", "all/full"}
    never = "all/b never seen, all/c never seen, all/full never seen"
    assert str(found) == f"healthy, as far as is known: 3 unknown ({never})"


async def test_who_was_known_and_is_not_any_more_is_told_from_who_was_never_seen(system: hf.ActorSystem) -> None:
    watching = await diagnosis.watch(system, seconds=0.1)
    worker(system, "a").tell(Go())
    await advance(1.0)
    assert not (await watching.diagnosis()).known_until
    await advance(30.0)
    found, now = await watching.diagnosis(), system._node.clock.wall()
    assert found.unknown[0] == "all/a"
    assert set(found.known_until) == {"all/a"}
    assert now - 30.0 < found.known_until["all/a"] < now - 20.0
    moment = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found.known_until["all/a"]))
    assert f"4 unknown (all/a known until {moment}, all/b never seen, " in str(found)
    assert f"nothing is seen of the work of all/a known until {moment}, " in (await watching.why()).text
    worker(system, "a").tell(Go())
    await advance(1.0)
    assert not (await watching.diagnosis()).known_until


async def test_children_that_come_later_and_those_that_go_are_followed(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    keeper = system.ref("/t/all", hf.Supervisor)
    await keeper.ask(hf.StartChild(hf.child("late", hf.start(Worker))))
    await advance(2.5)
    assert "all/late" in (await watching.diagnosis()).components
    worker(system, "late").tell(Go("freeze"))
    await asked(worker(system, "late").ask(Go(), timeout=1.0))
    await advance(0.5)
    assert (await watching.diagnosis()).certain == ("all/late",)
    await keeper.ask(hf.TerminateChild("late"), timeout=30.0)
    await keeper.ask(hf.DeleteChild("late"))
    await advance(7.0)
    found = await watching.diagnosis()
    assert "all/late" not in found.components
    assert found.state is State.HEALTHY


async def test_who_puts_everything_aside_and_takes_nothing_up_again_is_found(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    for _ in range(150):
        worker(system, "c").tell(Go("aside"))
        await advance(0.1)
    assert (await watching.diagnosis()).certain == ("all/c",)


async def test_nothing_is_told_when_nobody_looks(system: hf.ActorSystem) -> None:
    watching = await watched(system)
    node = system._node
    assert node.deadlines.watcher is not None
    await system.stop(watching.tree)
    assert node.deadlines.watcher is None
    with pytest.raises(ValueError, match="patience"):
        RuntimeObserver({}, patience=0.0)
