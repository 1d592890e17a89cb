"""How recovery and restarts meet (DESIGN 5): what follows from each kind of end of a child that is recorded."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from pathlib import Path
from typing import Any, cast

import pytest

import holdfast as hf
from holdfast.supervision.admin import RemoveChild
from holdfast.supervision.spec import Strategy
from tests.checkpoint.players import Do, Doer, Late, Note, Seen, until
from tests.checkpoint.strikes import NEVER, event, let_through, sink
from tests.checkpoint.trees import add, at, back, doing, end_process, running, seen, top, tree

pytestmark = pytest.mark.pairs

# -- ends that are recovered from -------------------------------------------------------------------------------------


async def strike(system: hf.ActorSystem, how: str) -> None:
    ref = at(system)
    if how == "Crash":
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Do(["raise no luck"]), timeout=20.0)
    elif how == "OutOfMemory":
        with pytest.raises(hf.RemoteCrash):
            await ref.ask(Do(["memory"]), timeout=20.0)
    elif how == "KILLED":
        ref.kill()
    else:
        end_process(system, ref)


@pytest.mark.parametrize("how", ["Crash", "OutOfMemory", "KILLED", "Signal"])
async def test_an_abnormal_end_is_followed_by_restore_and_replay(store: str | None, isolation: str, how: str) -> None:
    if how == "Signal" and isolation == "task":
        pytest.skip("a task has no process of its own to kill")
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation)))
        await add(system, "one", "two")
        with system.events() as stream:
            await strike(system, how)
            recovered = await back(stream)
        assert recovered.replayed >= 3, "on_start and two messages"
        assert await seen(system) == ["one", "two"]


async def test_a_hung_process_is_ended_and_its_actor_recovered(store: str | None, tmp_path: Path) -> None:
    async with running(store) as system:
        await system.start(tree("process", doing("process", limits=hf.Limits(hung_after=0.5))))
        await add(system, "one")
        with system.events() as stream:
            at(system).tell(Do([f"hang {tmp_path / 'hung'}"]))
            died = await event(stream, hf.events.ChildTerminated)
            assert isinstance(died.reason, hf.Hung)
            await back(stream)
        assert (await seen(system))[0] == "one"


# -- stopped with a sibling -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strategy", ["one_for_all", "rest_for_one"])
async def test_who_is_stopped_because_of_a_sibling_makes_a_final_snapshot_and_keeps_its_queue(
    store: str | None, isolation: str, strategy: str, gate: Path
) -> None:
    async with running(store) as system:
        names = ("bad", "doer")
        spec = tree(isolation, *(doing(isolation, name) for name in names), strategy=cast("Strategy", strategy))
        await system.start(spec)
        await add(system, "one")
        held = at(system).ask(Do([f"gate {gate}", "add held"]), timeout=20.0)
        await until(gate.exists)
        later = [at(system).ask(Do([f"add {n}"]), timeout=20.0) for n in range(3)]
        with system.events() as stream:
            at(system, "bad").tell(Do(["raise it"]))
            await until(lambda: at(system, "bad")._cell.state != "running")
            let_through(gate)
            recovered = await back(stream)
        assert recovered.replayed == 0, "the final snapshot has it all"
        await held
        await asyncio.gather(*later)
        assert await seen(system) == ["one", "held", "0", "1", "2"]


# -- stopped in good order, by itself or by hand ----------------------------------------------------------------------


async def stopped(system: hf.ActorSystem, how: str) -> None:
    if how == "terminate":
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        return
    with system.events() as stream:
        at(system).tell(Do(["stop"] if how == "NORMAL" else ["leave"]))
        async with asyncio.timeout(20.0):
            while (await top(system).ask(hf.WhichChildren()))[0].state != "stopped":
                await asyncio.sleep(0.005)
        assert not any(isinstance(one, hf.events.ChildRestarted) for one in stream.take())


@pytest.mark.parametrize("how", ["NORMAL", "SHUTDOWN", "terminate"])
async def test_who_has_stopped_is_restored_by_the_next_start_unless_that_is_fresh(
    store: str | None, isolation: str, how: str
) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation, restart="transient")))
        await add(system, "one")
        await stopped(system, how)
        with system.events() as stream:
            await top(system).ask(hf.RestartChild("doer"), timeout=20.0)
            assert (await back(stream)).replayed == 0, "the final snapshot has it all"
        assert await seen(system) == ["one"]
        await stopped(system, how)
        await top(system).ask(hf.RestartChild("doer", fresh=True), timeout=20.0)
        assert await seen(system) == []
        await add(system, "new")
        at(system).kill()
        await until(lambda: at(system)._cell.life > 1)
        assert await seen(system) == ["new"], "nothing of before comes back later either"


@pytest.mark.parametrize("erase", [True, False])
async def test_who_is_deleted_is_erased_unless_that_is_not_wanted(
    store: str | None, isolation: str, erase: bool
) -> None:
    spec = doing(isolation)
    async with running(store) as system:
        await system.start(tree(isolation, spec, doing(isolation, "other")))
        await add(system, "one")
        await add(system, "else", name="other")
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        await top(system).ask(hf.DeleteChild("doer", erase=erase), timeout=20.0)
        known = set(system._node.ports.keeper.known("/app"))  # type: ignore[attr-defined]
        assert ("/app/top/doer" in known) is not erase
        await top(system).ask(hf.StartChild(spec), timeout=20.0)
        assert await seen(system) == ([] if erase else ["one"])
        assert await seen(system, "other") == ["else"]


@pytest.mark.parametrize("how", ["delete", "restart fresh", "start fresh", "remove"])
async def test_what_the_store_refuses_to_forget_is_an_error_and_can_be_forgotten_later(
    store: str | None, isolation: str, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = doing(isolation)
    order: hf.Message[Any] = {
        "delete": hf.DeleteChild("doer"),
        "restart fresh": hf.RestartChild("doer", fresh=True),
        "start fresh": hf.StartChild(spec, fresh=True),
        "remove": RemoveChild("doer", erase=True),
    }[how]

    def refuse(address: str) -> None:
        raise hf.HoldfastError("the disk is gone")

    async with running(store) as system:
        await system.start(tree(isolation, spec))
        await add(system, "one")
        if how != "remove":
            await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        if how == "start fresh":
            await top(system).ask(hf.DeleteChild("doer", erase=False), timeout=20.0)
        with monkeypatch.context() as broken:
            broken.setattr(system._homes.journal, "erase", refuse)
            with pytest.raises(hf.HoldfastError, match="the disk is gone"):
                await top(system).ask(order, timeout=20.0)
        there = await top(system).ask(hf.WhichChildren(), timeout=20.0)
        assert [one.state for one in there] == ([] if how in ("start fresh", "remove") else ["stopped"])
        if how in ("start fresh", "remove"):
            await top(system).ask(hf.StartChild(spec), timeout=20.0)
        else:
            await top(system).ask(hf.RestartChild("doer"), timeout=20.0)
        assert await seen(system) == ["one"]
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        await top(system).ask(hf.DeleteChild("doer"), timeout=20.0)
        await top(system).ask(hf.StartChild(spec), timeout=20.0)
        assert await seen(system) == []


async def test_what_was_erased_stays_erased_when_the_store_is_opened_again(tmp_path: Path, isolation: str) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), doing(isolation, "other")))
        for name in ("doer", "other"):
            await add(system, "one", name=name)
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        await top(system).ask(hf.DeleteChild("doer"), timeout=20.0)
        await system._node.settled()
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), doing(isolation, "other")))
        assert (await seen(system), await seen(system, "other")) == ([], ["one"])


async def test_a_deleted_supervisor_is_erased_with_all_below_it(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        root = system.ref("/app", hf.Supervisor)
        await system.start(tree(isolation, doing(isolation)))
        await system.start(hf.child("topmost", hf.start(Doer), recovery=hf.hybrid()))  # A name that only begins alike.
        await add(system, "one")
        await system.ref("/app/topmost", Doer).ask(Note("mine"))
        await root.ask(hf.TerminateChild("top"), timeout=20.0)
        await root.ask(hf.DeleteChild("top"), timeout=20.0)
        await system.start(tree(isolation, doing(isolation)))
        assert await seen(system) == []
        assert await system.ref("/app/topmost", Doer).ask(Seen()) == ["mine"]


async def test_what_waits_for_an_actor_that_begins_afresh_is_a_dead_letter_or_fails(
    store: str | None, gate: Path
) -> None:
    """A recorded tell is kept when the supervisor ends; a fresh start of the tree gives it up, and says so."""
    async with running(store) as system:
        await system.start(tree("task", doing("task", shutdown="brutal_kill"), restart="transient"))
        at(system).tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        at(system).tell(Do(["add lost"]))
        asked = at(system).ask(Do(["add asked"]), timeout=20.0)
        root = system.ref("/app", hf.Supervisor)
        with system.events() as stream:
            await root.ask(hf.TerminateChild("top"), timeout=20.0)
            with pytest.raises(hf.ActorStopped):
                await asked
            assert not [one for one in stream.take() if isinstance(one, hf.events.DeadLetter)]
            await root.ask(hf.RestartChild("top", fresh=True), timeout=20.0)
            dead = [one for one in stream.take() if isinstance(one, hf.events.DeadLetter)]
        assert [cast("Do", one.message).steps[0] for one in dead] == [f"gate {gate}", "add lost"]
        assert await seen(system) == []


async def test_the_answer_to_an_ask_of_an_erased_life_is_not_taken_for_one_of_the_new_life(
    store: str | None, gate: Path
) -> None:
    """Its turns have the same numbers: what is still out for the old ones must not be written down for the new."""
    async with running(store) as system:
        await system.start(tree("task", doing("task", shutdown="brutal_kill"), doing("task", "other")))
        notes = await sink(system)
        at(system).tell(Do([f"forward {gate}", "add x"], notes))
        peer = at(system, "other")
        await peer.send(Do([f"gate {gate}"]))
        await until(gate.exists)
        at(system).tell(Do(["ask old"], peer))
        await until(lambda: "/app/top/doer" in str(peer._cell.host.home.switch.open))  # type: ignore[attr-defined]
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        await top(system).ask(hf.RestartChild("doer", fresh=True), timeout=20.0)
        let_through(gate)
        assert await peer.ask(Seen(), timeout=20.0) == ["old"]
        switch = at(system)._cell.host.home.switch  # type: ignore[attr-defined]
        assert switch.ledger.outcomes == {}
        assert "got" not in {entry[0] for _, entry in switch.journal.load(switch.path).entries}
        await at(system).ask(Do(["ask new"], peer), timeout=20.0)
        assert await seen(system) == ["new:2"]


# -- its supervisor was restarted -------------------------------------------------------------------------------------


async def test_static_children_of_a_restarted_supervisor_are_restored_and_keep_their_queue(
    store: str | None, isolation: str, gate: Path
) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), doing(isolation, "other")))
        await add(system, "one")
        await add(system, "else", name="other")
        at(system).tell(Do([f"gate {gate}", "add held"]))
        await until(gate.exists)
        at(system).tell(Do(["add queued"]))
        with system.events() as stream:
            top(system).kill()
            await back(stream, hf.events.ChildRestarted, "/app/top")
        let_through(gate)
        assert await seen(system) == ["one", "held", "queued"]
        assert await seen(system, "other") == ["else"]


async def test_who_has_asked_below_a_restarted_supervisor_is_told_that_the_actor_may_come_back(
    store: str | None, gate: Path
) -> None:
    """It is not said to be gone for good: the same address is there again a moment later."""
    async with running(store) as system:
        await system.start(tree("task", doing("task")))
        await add(system, "one")
        at(system).tell(Do([f"gate {gate}"]))
        await until(gate.exists)
        asked = at(system).ask(Do(["add never"]), timeout=20.0)  # In the mailbox, behind the gate.
        with system.events() as stream:
            top(system).kill()
            await back(stream, hf.events.ChildRestarted, "/app/top")
        with pytest.raises(hf.ActorStopped, match="its supervisor has ended, and may start it again"):
            await asked
        let_through(gate)
        assert await seen(system) == ["one"]


# -- one window, and who answers meanwhile ----------------------------------------------------------------------------


async def test_each_attempt_counts_once_also_one_that_fails_inside_the_recovery(
    store: str | None, isolation: str, tmp_path: Path
) -> None:
    """The handler works once and fails under replay: each recovery fails, and nothing but the window ends that."""
    again = dataclasses.replace(doing(isolation), backoff=hf.Backoff(initial=0.0, maximum=0.0))
    async with running(store) as system:
        await system.start(tree(isolation, again, intensity=3, period=60.0, restart="temporary"))
        await at(system).ask(Do([f"replayed {tmp_path / 'marker'}"]), timeout=20.0)
        restarted: list[int] = []
        failed, gave_up = 0, False
        with system.events() as stream:
            at(system).kill()
            async for one in stream:  # A supervisor in a process may be heard before the root tells of the recovery.
                if isinstance(one, hf.events.ChildRestarted) and one.address == "/app/top/doer":
                    restarted.append(one.attempt)
                failed += isinstance(one, hf.events.RecoveryFailed)
                gave_up = gave_up or isinstance(one, hf.events.SupervisorGaveUp)
                if gave_up and failed >= 3:
                    break
        assert (restarted, failed) == ([1, 2, 3], 3)


async def test_the_supervisor_answers_while_a_child_is_recovered_and_later_siblings_wait(
    store: str | None, isolation: str, gate: Path
) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), doing(isolation, "later"), strategy="rest_for_one"))
        await add(system, "one")
        let_through(gate)
        await at(system).ask(Do([f"gate {gate}"]), timeout=20.0)
        Path(f"{gate}.open").unlink()  # Under replay it stops there.
        gate.unlink()
        at(system).kill()
        await until(gate.exists)
        states = {one.id: one.state for one in await top(system).ask(hf.WhichChildren(), timeout=30.0)}
        assert states == {"doer": "recovering", "later": "restarting"}
        assert (await top(system).ask(hf.supervision.CountChildren(), timeout=30.0)).specs == 2
        let_through(gate)
        assert await seen(system) == ["one"]
        assert await seen(system, "later") == []


@pytest.mark.parametrize("how", ["start", "restart"])
@pytest.mark.parametrize("end", ["up", "terminated", "supervisor stopped"])
async def test_the_supervisor_answers_while_a_recorded_child_starts_by_order(
    store: str | None, gate: Path, how: str, end: str
) -> None:
    late = hf.child("late", hf.start(Late, str(gate)), recovery=hf.hybrid(NEVER), shutdown=1.0)
    async with running(store) as system:
        await system.start(tree("task"))
        asked = asyncio.ensure_future(top(system).ask(hf.StartChild(late), timeout=20.0))
        await until(gate.exists)
        if how == "restart":
            let_through(gate)
            await asked
            await top(system).ask(hf.TerminateChild("late"), timeout=30.0)
            Path(f"{gate}.open").unlink()
            gate.unlink()
            asked = asyncio.ensure_future(top(system).ask(hf.RestartChild("late"), timeout=20.0))
            await until(gate.exists)
        infos = await top(system).ask(hf.WhichChildren(), timeout=30.0)
        assert [(one.id, one.state) for one in infos] == [("late", "recovering")]
        again = await asyncio.gather(top(system).ask(hf.StartChild(late), timeout=30.0), return_exceptions=True)
        assert isinstance(again[0], hf.errors.AlreadyStarted)
        assert not asked.done()
        if end == "up":
            let_through(gate)
            assert (await asked).path == "/app/top/late"
            assert await seen(system, "late") == []
        elif end == "terminated":
            await top(system).ask(hf.TerminateChild("late"), timeout=30.0)
            with pytest.raises(hf.StartFailed, match="stopped while it started"):
                await asked
        else:
            await system.stop(top(system))
            with pytest.raises(hf.AskFailed, match="shutdown"):
                await asked


async def test_a_recorded_child_that_cannot_start_by_order_leaves_nothing(store: str | None) -> None:
    async with running(store) as system:
        await system.start(tree("task"))
        bad = hf.child("bad", hf.start(Unable), recovery=hf.hybrid(NEVER))
        for _ in range(2):
            with pytest.raises(hf.StartFailed, match="no such device"):
                await top(system).ask(hf.StartChild(bad), timeout=20.0)
            assert await top(system).ask(hf.WhichChildren(), timeout=30.0) == []


class Unable(hf.Actor):
    async def on_start(self, restored: bool) -> None:
        raise OSError("no such device")


# -- who hears of it --------------------------------------------------------------------------------------------------


async def test_down_says_recovering_only_if_it_is_and_links_and_watches_wait_for_the_end(
    store: str | None, isolation: str
) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation, rules=[hf.rule(OSError, "stop")])))
        watcher = await system.start(hf.child("watcher", hf.start(Doer), recovery=hf.hybrid(NEVER)))
        linked = await system.start(hf.child("linked", hf.start(Doer), restart="temporary"))
        ref = at(system)
        await watcher.ask(Do(["monitor"], ref))
        heard: list[str] = []
        await linked.ask(Do(["link"], ref))
        await add(system, "one")
        with system.events() as stream:
            ref.kill()
            await back(stream)
        assert await watcher.ask(Seen()) == ["down True"]
        assert await linked.ask(Seen()) == heard
        with contextlib.suppress(hf.HoldfastError):
            await ref.ask(Do(["fail"]), timeout=20.0)  # An OSError: its rule says that this is not recovered from.
        await until(lambda: "/app/linked" not in system.tree())
        assert await watcher.ask(Seen()) == ["down True", "down False"]


class Guard(hf.Actor):
    """Watches another for good."""

    def __init__(self, other: hf.ActorRef[Any]) -> None:
        self.heard: list[str] = []
        self.ctx.watch(other)

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append(f"gone {recovering}")

    @hf.on(Seen)
    def read(self, message: Seen) -> list[str]:
        return self.heard


async def test_a_watch_fires_once_when_the_actor_is_gone_for_good(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation)))
        guard = system.spawn(hf.start(Guard, at(system)))
        for _ in range(2):
            with system.events() as stream:
                at(system).kill()
                await back(stream)
        assert await guard.ask(Seen()) == []
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        await until(lambda: "/app/top/doer" not in system.tree())
        await system._node.settled()
        assert await guard.ask(Seen()) == ["gone False"]
