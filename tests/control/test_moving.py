"""A live actor is moved between a task and an OS process, and back; nothing of it is lost."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.control.movers import (
    OTHER,
    Answer,
    Begin,
    Bond,
    Count,
    Delayed,
    Door,
    Downs,
    End,
    Friend,
    Homesick,
    Large,
    Later,
    Ledger,
    Open,
    Picky,
    Put,
    Shutter,
    Spawns,
    Started,
    Tick,
    Ticker,
    Ticks,
    Where,
    Work,
    Worker,
    lives_in,
    moved,
)
from tests.control.players import Account, Add, Crash, Holder, Total, Wait, until_there


async def test_an_actor_is_moved_there_and_back_with_its_state(
    system: hf.ActorSystem, recovery: Any, here: Any, tmp_path: Path
) -> None:
    """The old life hears that it has moved; nobody else hears of an end."""
    end = tmp_path / "end"
    spec = hf.child("one", hf.start(Started, str(end)), recovery=recovery, isolation=here)
    one = await system.start(spec)
    watcher = await system.start(hf.child("watcher", hf.start(Friend)))
    watcher.tell(Bond(link=one, watch=one))
    assert await one.ask(Add(5)) == 5
    with system.events() as stream:
        for to in (OTHER[here], here):
            pid = system.pid_of(one)
            await system.set_isolation(one, to)
            assert lives_in(system, one) == to
            await until_there(end)
            told = end.read_text()
            assert told.startswith(f"{pid} shutdown (moved")
            end.unlink()
        told_of = stream.take()
    assert [(e.origin, e.to) for e in told_of if isinstance(e, hf.events.Moved)] == [
        (here, OTHER[here]),
        (OTHER[here], here),
    ]
    assert not [
        e
        for e in told_of
        if isinstance(e, (hf.events.ChildRestarted, hf.events.ChildTerminated, hf.events.ActorStarted))
    ]
    assert await one.ask(Add(1)) == 6
    state = await system.get_state(one)
    assert state == {"total": 6, "seen": [5, 1], "starts": [False, True, True] if recovery is None else state["starts"]}
    assert state["starts"][-1] is True
    assert (await system.get_status(one)).life == 1
    assert await watcher.ask(Downs()) == ["heard 0", "friend /app/one"]


async def test_where_it_is_already_it_stays(system: hf.ActorSystem, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), isolation=here))
    pid = system.pid_of(one)
    with system.events() as stream:
        await system.set_isolation(one, here)
        assert moved(stream) == []
    assert system.pid_of(one) == pid


async def test_restarts_happen_in_the_new_place(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    await one.ask(Add(3))
    await system.set_isolation(one, OTHER[here])
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Crash())
    assert await one.ask(Total(), timeout=30.0) == (0 if recovery is None else 3)
    assert lives_in(system, one) == OTHER[here]
    assert (await system.get_status(one)).life == 2


async def test_children_start_in_the_new_place_when_their_supervisor_is_started_anew(system: hf.ActorSystem) -> None:
    top = hf.supervisor("top", children=[hf.child("one", hf.start(Account))], intensity=0)
    supervisor = await system.start(top)
    one = system.ref("/app/top/one", Account)
    await system.set_isolation(one, "process")
    with system.events() as stream:
        one.kill()  # Its supervisor gives up, and is started anew by the root.
        async with asyncio.timeout(30.0):
            async for event in stream:
                if isinstance(event, hf.events.ActorStarted) and event.address == "/app/top/one":
                    break
    again = system.ref("/app/top/one", Account)
    assert await again.ask(Add(1), timeout=30.0) == 1
    assert lives_in(system, again) == "process"
    spec = await supervisor.ask(hf.supervision.GetChildSpec("one"))
    assert isinstance(spec, hf.ChildSpec)
    assert spec.isolation == "process"


async def test_a_child_of_a_dynamic_supervisor_is_moved(system: hf.ActorSystem) -> None:
    family = await system.start(hf.dynamic("family"))
    one = await family.ask(hf.StartChild(hf.child("one", hf.start(Account))))
    assert await one.ask(Add(2)) == 2
    await system.set_isolation(one, "process")
    assert await one.ask(Add(2)) == 4
    one.tell(Crash())
    assert await one.ask(Add(2), timeout=30.0) == 2
    assert lives_in(system, one) == "process"


async def test_limits_are_those_of_the_move(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Ledger)))
    await system.set_isolation(one, "process", limits=hf.Limits(niceness=7))
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, await one.ask(Where())) == min(19, own + 7)
    root = system._node.root
    assert root is not None
    spec = await hf.ActorRef[hf.Supervisor](root).ask(hf.supervision.GetChildSpec("one"))
    assert isinstance(spec, hf.ChildSpec)
    assert spec.limits == hf.Limits(niceness=7)


async def test_messages_that_wait_go_along_in_order(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    asks = [one.ask(Add(n)) for n in range(200)]
    moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here]))
    asks += [one.ask(Add(n)) for n in range(200, 400)]
    await moving
    asks += [one.ask(Add(n)) for n in range(400, 500)]
    await asyncio.gather(*asks)
    assert (await system.get_state(one))["seen"] == list(range(500))


async def test_a_bounded_mailbox_stays_bounded(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    """Those who wait for room before the move get it afterwards."""
    spec = hf.child("one", hf.start(Account), recovery=recovery, isolation=here, mailbox=hf.bounded(4))
    one = await system.start(spec)
    await system.suspend(one)
    asks = [one.ask(Add(n), timeout=30.0) for n in range(12)]
    await system.set_isolation(one, OTHER[here])
    with pytest.raises(hf.MailboxFull):
        one.tell(Add(100))
    assert not any(ask.done() for ask in asks)
    await system.resume(one)
    assert len(await asyncio.gather(*asks)) == 12
    assert (await system.get_state(one))["seen"][:12] == list(range(12))


async def test_a_suspended_actor_is_suspended_there_too(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    await system.suspend(one)
    waiting = [one.ask(Add(1)) for _ in range(3)]
    await system.set_isolation(one, OTHER[here])
    assert (await system.get_status(one)).state == "suspended"
    assert (await system.get_state(one))["total"] == 0
    await system.set_isolation(one, here)
    assert (await system.get_status(one)).state == "suspended"
    assert not any(ask.done() for ask in waiting)
    await system.resume(one)
    assert await asyncio.gather(*waiting) == [1, 2, 3]


async def test_timers_run_on_and_their_handles_stay_good(system: hf.ActorSystem, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Ticker), isolation=here))
    one.tell(Begin(0.02, 0.3))
    await one.ask(Ticks())
    await system.set_isolation(one, OTHER[here])
    there = system.pid_of(one)
    async with asyncio.timeout(30.0):
        while (await one.ask(Ticks())).count(there) < 3:
            await asyncio.sleep(0.01)
    one.tell(End())
    before = len(await one.ask(Ticks()))
    await asyncio.sleep(0.4)
    assert len(await one.ask(Ticks())) == before, "a cancelled timer has fired"


async def test_a_timer_that_fires_once_does_so_once(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    """Moved while it runs, while its tick is queued, and after."""
    kind: type[hf.Actor] = Ticker if recovery is None else RecordedTicker
    one = await system.start(hf.child("one", hf.start(kind), recovery=recovery, isolation=here))
    one.tell(Begin(0.0, 0.05))
    await one.ask(Ticks())
    await system.suspend(one)
    await system.set_isolation(one, OTHER[here])
    await asyncio.sleep(0.1)  # The tick is queued now.
    await system.set_isolation(one, here)
    await system.resume(one)
    async with asyncio.timeout(30.0):
        while not await one.ask(Ticks()):
            await asyncio.sleep(0.01)
    await system.set_isolation(one, OTHER[here])
    assert len(await one.ask(Ticks())) == 1


class RecordedTicker(Ticker):
    """Keeps no handles: those of recorded actors are of another kind."""

    key_variables = ("pids",)


async def test_what_was_put_aside_is_there_too(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Door), recovery=recovery, isolation=here))
    asks = [one.ask(Put(n)) for n in range(3)]
    one.tell(Put(3))
    await system.set_isolation(one, OTHER[here])
    asks.append(one.ask(Put(4)))
    await system.set_isolation(one, here)
    await system.set_isolation(one, OTHER[here])
    assert not any(ask.done() for ask in asks)
    one.tell(Open())
    assert await asyncio.gather(*asks) == [0, 1, 2, 4]
    assert (await system.get_state(one))["seen"] == [0, 1, 2, 3, 4]


async def test_replies_can_be_given_from_the_other_side(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Delayed), recovery=recovery, isolation=here))
    asks = [one.ask(Later()) for _ in range(3)]
    for to in (OTHER[here], here, OTHER[here]):
        await system.set_isolation(one, to)
    assert await one.ask(Answer(7)) == 3
    assert await asyncio.gather(*asks) == [7, 7, 7]


async def test_an_ask_whose_handle_would_be_lost_keeps_the_actor_where_it_is(system: hf.ActorSystem, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Delayed, True), isolation=here))
    asked = one.ask(Later())
    await one.ask(Where())  # It has begun both.
    with pytest.raises(hf.errors.CannotMove, match="1 asks wait for replies"):
        await system.set_isolation(one, OTHER[here])
    assert await one.ask(Answer(1)) == 1
    assert await asked == 1
    await system.set_isolation(one, OTHER[here])
    assert lives_in(system, one) == OTHER[here]


async def test_background_work_is_waited_for(system: hf.ActorSystem, recovery: Any, here: Any, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    one = await system.start(hf.child("one", hf.start(Worker), recovery=recovery, isolation=here))
    one.tell(Work(str(gate)))
    await one.ask(Total())
    with pytest.raises(hf.errors.CannotMove, match="background work"):
        await system.set_isolation(one, OTHER[here], timeout=0.2)
    moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here], timeout=30.0))
    assert await one.ask(Add(1)) == 1  # It goes on meanwhile.
    gate.touch()
    await moving
    assert await one.ask(Total()) == 101
    assert lives_in(system, one) == OTHER[here]


async def test_a_turn_in_hand_is_waited_for(system: hf.ActorSystem, recovery: Any, here: Any, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    waiting = one.ask(Wait(str(gate)), timeout=30.0)
    await until_there(tmp_path / "gate.begun")
    with pytest.raises(hf.errors.CannotMove):
        await system.set_isolation(one, OTHER[here], timeout=0.2)
    moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here], timeout=30.0))
    gate.touch()
    assert await waiting == "waited"
    await moving
    assert await one.ask(Add(1)) == 1


async def test_a_new_life_that_does_not_come_up_is_ended(system: hf.ActorSystem, recovery: Any, tmp_path: Path) -> None:
    ended = tmp_path / "ended"
    recipe = hf.start(Homesick, os.getpid(), str(ended))
    one = await system.start(hf.child("one", recipe, recovery=recovery, isolation="process"))
    with pytest.raises(hf.errors.CannotMove):
        await system.set_isolation(one, "task", timeout=1.0)
    await until_there(ended)
    assert lives_in(system, one) == "process"
    assert (await system.get_state(one))["ended"] == str(ended)


async def test_links_watches_topics_bindings_and_names_stay(system: hf.ActorSystem, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Friend), isolation=here))
    linked = await system.start(hf.child("linked", hf.start(Account), restart="temporary"))
    watched = await system.start(hf.child("watched", hf.start(Account), restart="temporary"))
    system.register("friend", one)
    system.bind(one, "other", linked)
    one.tell(Bond(link=linked, watch=watched))
    await one.ask(Downs())
    await system.set_isolation(one, OTHER[here])
    assert system.whereis("friend") == one
    await system.publish("/run-time", Tick())
    assert await one.ask(Downs()) == ["heard 1", "friend /app/watched"]
    await system.set_isolation(one, here)
    linked.kill()
    watched.kill()
    async with asyncio.timeout(30.0):
        told: list[str] = []
        while len(told) < 4:
            told = await one.ask(Downs())
    assert sorted(told) == ["down /app/watched", "exit /app/linked", "friend /app/watched", "heard 1"]


async def test_state_hooks_are_used(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Picky), recovery=recovery, isolation=here))
    assert await one.ask(Put(2)) == 3
    await system.set_isolation(one, OTHER[here])
    assert await one.ask(Put(3)) == 6


async def test_a_state_larger_than_a_frame_goes_along(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Large), recovery=recovery, isolation=here))
    assert await one.ask(Put(20_000_000)) == 20_000_000
    await system.set_isolation(one, OTHER[here], timeout=20.0)
    assert await one.ask(Put(1)) == 20_000_001
    await system.set_isolation(one, here, timeout=20.0)
    assert await one.ask(Put(1)) == 20_000_002


# -- what is refused -------------------------------------------------------------------------------------------------


async def test_a_state_that_cannot_be_saved_is_refused_by_name(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Holder)))
    assert await one.ask(Add(1)) == 1
    with pytest.raises(hf.errors.CannotMove, match=r"Holder\.file"):
        await system.set_isolation(one, "process")
    assert await one.ask(Add(1)) == 2
    assert lives_in(system, one) == "task"


async def test_who_cannot_be_moved_is_told_so(system: hf.ActorSystem) -> None:
    spawned = system.spawn(hf.start(Account), "spawned")
    spawner = await system.start(hf.child("spawner", hf.start(Spawns)))
    for ref, why in (
        (spawned, "nobody restarts it"),
        (spawner, r"children of its own \(own\)"),
    ):
        with pytest.raises(hf.errors.CannotMove, match=why):
            await system.set_isolation(ref, "process")
    assert await spawner.ask(Add(1)) == 1


async def test_a_class_that_cannot_be_imported_there_stays(system: hf.ActorSystem) -> None:
    class Local(Account):
        pass

    one = await system.start(hf.child("one", hf.start(Local)))
    assert await one.ask(Add(1)) == 1
    with pytest.raises(hf.errors.CannotMove, match="defined in a function"):
        await system.set_isolation(one, "process")
    assert await one.ask(Add(1)) == 2


async def test_nonsense_is_refused(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))
    for to, options in (("moon", {}), ("task", {"limits": hf.Limits()}), ("process", {"timeout": 0})):
        with pytest.raises(hf.SpecError):
            await system.set_isolation(one, to, **options)  # type: ignore[arg-type]
    await system.stop(one)
    with pytest.raises(hf.ActorStopped):
        await system.set_isolation(one, "process")


@pytest.mark.parametrize("method", [None, hf.hybrid(interval=60.0)], ids=["no recovery", "hybrid"])
async def test_what_is_ordered_below_a_supervisor_in_a_process_follows_the_actor(
    system: hf.ActorSystem, tmp_path: Path, method: Any
) -> None:
    """An order that was on its way to the process that the actor leaves is carried out where it lives."""
    child = hf.child("one", hf.start(Account), recovery=method)
    await system.start(hf.supervisor("top", isolation="process", children=[child]))
    one = system.ref("/app/top/one", Account)
    for to in ("process", "task"):
        gate = tmp_path / to
        busy = one.ask(Wait(str(gate)), timeout=30.0)
        moving = asyncio.create_task(system.set_isolation(one, to, timeout=30.0))
        ordered = []
        for _ in range(30):  # Those that come when it is to rest next find it there, or gone.
            ordered.append(asyncio.create_task(system.get_state(one, timeout=30.0)))
            await asyncio.sleep(0.02)
        gate.touch()
        await moving
        assert await busy == "waited"
        assert {state["total"] for state in await asyncio.gather(*ordered)} == {0}


@pytest.mark.parametrize("below", ["task", "process"])
async def test_ends_that_an_actor_has_not_heard_of_go_along(system: hf.ActorSystem, below: Any) -> None:
    """Its ties are over by then: it hears of each end once all the same."""
    await system.start(hf.supervisor("top", isolation=below, children=[hf.child("one", hf.start(Friend))]))
    one = system.ref("/app/top/one", Friend)
    for to in ("process", "task"):
        others = [system.spawn(hf.start(Account), f"{to}-{n}") for n in range(40)]
        for other in others:
            one.tell(Bond(link=other, watch=other))
        await one.ask(Downs())
        await system.suspend(one)
        for other in others[:4]:  # They wait in its queue.
            other.kill()
        moving = asyncio.create_task(system.set_isolation(one, to, timeout=30.0))
        for other in others[4:]:  # Some of them end while it is carried over.
            other.kill()
            await asyncio.sleep(0.002)
        await moving
        await system.resume(one)
        heard = [text for text in await one.ask(Downs()) if f"/{to}-" in text and text[:4] in ("exit", "down")]
        assert sorted(heard) == sorted(f"{what} {other.path}" for other in others for what in ("exit", "down"))


async def test_what_a_replay_has_put_back_waits_until_the_new_life_is_the_one(system: hf.ActorSystem) -> None:
    """A turn that it began before was left behind: its message came again, behind those that followed it."""
    child = hf.child("one", hf.start(Shutter), recovery=hf.replay_only(), isolation="process")
    await system.start(hf.supervisor("top", isolation="process", children=[child]))
    one = system.ref("/app/top/one", Shutter)
    asked = [one.ask(Count("outside", n), timeout=30.0) for n in range(8)]
    one.tell(Open())
    with system.events() as events:
        await system.set_isolation(one, "task", timeout=30.0)
        assert await asyncio.gather(*asked) == list(range(1, 9))
        assert (await system.get_state(one))["taken"] == list(range(8))
    assert not [
        event for event in events.take() if isinstance(event, hf.events.RecoveryFailed | hf.events.TrustBreached)
    ]
