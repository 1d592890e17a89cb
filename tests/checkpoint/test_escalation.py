"""Escalation that comes back: the supervisor has ended because of a recorded child, and its own has restarted it."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Note, Notes, Seen, until
from tests.checkpoint.strikes import sink
from tests.checkpoint.trees import add, at, back, doing, escalate, running, seen, snapshot, top, tree

pytestmark = pytest.mark.pairs


async def two_snapshots(system: hf.ActorSystem) -> None:
    """ "a" is in the older snapshot, "b" in the newest too, and "c" in none."""
    await add(system, "a")
    await snapshot(system)
    await add(system, "b")
    await snapshot(system)
    await add(system, "c")


async def rolled_back(system: hf.ActorSystem, isolation: str) -> list[hf.events.RolledBack]:
    with system.events() as stream:
        await escalate(system, isolation)
        await seen(system)
        return [one for one in stream.take() if isinstance(one, hf.events.RolledBack)]


async def test_only_whoever_is_to_blame_goes_back_as_its_method_says(store: str | None, isolation: str) -> None:
    options = {"on_escalate": "older_snapshot"}
    async with running(store) as system:
        children = doing(isolation, **options), doing(isolation, "other", **options)
        await system.start(tree(isolation, *children, intensity=0))
        await two_snapshots(system)
        await add(system, "mine", name="other")
        (event,) = await rolled_back(system, isolation)
        assert (event.address, event.reason) == ("/app/top/doer", "its supervisor has ended because of it")
        assert event.from_turn > event.to_turn > 0
        assert await seen(system) == ["a"]
        assert await seen(system, "other") == ["mine"]


async def test_by_default_no_escalation_costs_what_was_acknowledged(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), intensity=0))
        await two_snapshots(system)
        for _ in range(4):
            assert await rolled_back(system, isolation) == []
            assert await seen(system) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"on_escalate": "restore"}, ["a", "b", "c"]),
        ({"on_escalate": "older_snapshot"}, ["a"]),
        ({"on_escalate": "older_snapshot", "keep": 1}, []),
        ({"on_escalate": "fresh"}, []),
    ],
)
async def test_the_method_says_what_comes_back(
    store: str | None, isolation: str, options: dict[str, Any], expected: list[str]
) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation, **options), intensity=0))
        await two_snapshots(system)
        events = await rolled_back(system, isolation)
        assert await seen(system) == expected
        assert len(events) == (options["on_escalate"] != "restore")
        if not expected:
            assert events[0].to_turn == -1
        assert all(("no older snapshot" in one.reason) is ("keep" in options) for one in events)
        await add(system, "new")
        with system.events() as stream:
            at(system).tell(Do(["raise again"]))
            await back(stream, hf.events.ChildRestarted, "/app/top")
        if options["on_escalate"] != "restore":  # What was undone does not come back, not as an "older" one either.
            assert not {"b", "c"} & set(await seen(system))
    if store is not None and options["on_escalate"] != "restore":
        async with running(store) as system:
            await system.start(tree(isolation, doing(isolation, **options), intensity=0))
            assert not {"b", "c"} & set(await seen(system))


async def test_without_any_snapshot_an_older_one_means_a_fresh_start(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation, on_escalate="older_snapshot"), intensity=0))
        await add(system, "a")
        (event,) = await rolled_back(system, isolation)
        assert (event.to_turn, "no older snapshot" in event.reason) == (-1, True)
        assert await seen(system) == []


@pytest.mark.parametrize("to", ["older_snapshot", "fresh"])
async def test_what_has_left_stays_out_and_what_was_not_handled_stays_queued(
    store: str | None, isolation: str, to: str, gate: Path
) -> None:
    async with running(store) as system:
        notes = await sink(system)
        await system.start(tree(isolation, doing(isolation, on_escalate=to, shutdown="brutal_kill"), intensity=0))
        await two_snapshots(system)
        await at(system).ask(Do(["tell undone", "add undone"], notes), timeout=20.0)
        at(system).tell(Do([f"gate {gate}", "tell after", "raise it"], notes))
        await until(gate.exists)
        at(system).tell(Do(["add queued", "tell queued"], notes))
        await at(system).send(Do(["add last"]))
        with system.events() as stream:
            Path(f"{gate}.open").touch()
            await back(stream, hf.events.RolledBack)
        expected = [*(["a"] if to == "older_snapshot" else []), "queued", "last"]
        assert await seen(system) == expected
        assert await notes.ask(Notes()) == ["undone", "queued"]


@pytest.mark.parametrize("to", ["older_snapshot", "fresh"])
async def test_a_turn_that_has_let_something_out_ends_with_the_state_it_began_with(
    store: str | None, isolation: str, to: str, gate: Path
) -> None:
    async with running(store) as system:
        notes = await sink(system)
        await system.start(tree(isolation, doing(isolation, on_escalate=to, shutdown="brutal_kill"), intensity=0))
        await two_snapshots(system)
        at(system).tell(Do(["tell out", "flush", f"gate {gate}", "tell never"], notes))
        await until(gate.exists)
        async with asyncio.timeout(60.0):
            while await notes.ask(Notes()) != ["out"]:  # It may still be on its way from the process.
                pass
        dead = system.dead_letters
        with system.events() as stream:
            at(system).kill()
            await back(stream, hf.events.RolledBack)
        Path(f"{gate}.open").touch()
        await seen(system)
        await add(system, "new")
        assert await seen(system) == (["a", "new"] if to == "older_snapshot" else ["new"])
        assert await notes.ask(Notes()) == ["out"]
        assert system.dead_letters == dead + 1


async def test_timers_stash_and_subscriptions_are_those_of_the_older_snapshot(store: str | None) -> None:
    async with running(store) as system:
        await system.start(tree("task", doing("task", on_escalate="older_snapshot"), intensity=0))
        await at(system).ask(Do(["subscribe /early", "after 3000"]))
        await snapshot(system)
        await at(system).ask(Do(["subscribe /late", "after 3000", "add b"]))
        await snapshot(system)
        await rolled_back(system, "task")
        switch = at(system)._cell.host.home.switch  # type: ignore[attr-defined]
        assert (list(switch.topics), len(switch.timers.saved())) == (["/early"], 1)
        await system.publish("/late", Note("x"))
        await system.publish("/early", Note("y"))
        assert await seen(system) == ["y"]


async def test_who_waits_for_a_later_reply_from_an_undone_turn_is_told(isolation: str) -> None:
    async with running(None) as system:
        await system.start(tree(isolation, doing(isolation, on_escalate="fresh"), intensity=0))
        waiting = at(system).ask(Do(["later"]), timeout=20.0)
        await add(system, "a")
        await rolled_back(system, isolation)
        with pytest.raises(hf.AskFailed, match="RuntimeError: it"):
            await waiting


async def test_who_is_started_by_hand_after_an_escalation_has_left_it_behind(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        spec = tree(isolation, doing(isolation, on_escalate="fresh"), intensity=0, restart="transient")
        await system.start(spec)
        await add(system, "a")
        with system.events() as stream:
            at(system).tell(Do(["raise it"]))
            await back(stream, hf.events.SupervisorGaveUp, "/app/top")
        await until(lambda: "/app/top" not in system.tree())
        await system.ref("/app", hf.Supervisor).ask(hf.RestartChild("top"), timeout=20.0)
        assert await seen(system) == ["a"]
        with system.events() as stream:
            top(system).kill()
            await back(stream, hf.events.ChildRestarted, "/app/top")
        assert await seen(system) == ["a"]


async def test_an_escalation_through_two_supervisors_counts_for_the_one_it_began_with(store: str | None) -> None:
    """Both give up; whoever restarts the upper one has brought the child back, in its own window."""
    async with running(store) as system:
        inner = hf.supervisor("top", children=[doing("task", on_escalate="older_snapshot")], intensity=0)
        await system.start(hf.supervisor("above", children=[inner], intensity=0))
        path = "/app/above/top/doer"
        ref: Any = system.ref(path, hf.Actor)
        for word in "abc":
            await ref.ask(Do([f"add {word}"]))
            if word != "c":
                await system.ref("/app/above/top", hf.Supervisor).ask(hf.TerminateChild("doer"))
                await system.ref("/app/above/top", hf.Supervisor).ask(hf.RestartChild("doer"))
                ref = system.ref(path, hf.Actor)
        with system.events() as stream:
            ref.kill()
            event = await back(stream, hf.events.RolledBack, path)
        assert event.to_turn > 0
        await until(lambda: path in system.tree())
        assert await system.ref(path, hf.Actor).ask(Seen(), timeout=20.0) == ["a"]


async def test_what_is_restarted_by_hand_or_killed_is_no_escalation(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation, on_escalate="fresh"), intensity=5))
        await add(system, "a")
        with system.events() as stream:
            top(system).kill()
            await back(stream, hf.events.ChildRestarted, "/app/top")
            assert await seen(system) == ["a"]
            assert not [one for one in stream.take() if isinstance(one, hf.events.RolledBack)]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_child_whose_restore_fails_goes_back_if_its_method_says_so(store: str | None, tmp_path: Path) -> None:
    """Its supervisor cannot even start with it: that is an escalation too, and the older snapshot is the way out."""
    marker = tmp_path / "marker"
    async with running(store) as system:
        await system.start(tree("task", doing("task", on_escalate="older_snapshot"), intensity=0))
        await two_snapshots(system)
        await at(system).ask(Do([f"replayed {marker}"]))
        with system.events() as stream:
            with contextlib.suppress(hf.HoldfastError):
                await at(system).ask(Do(["raise it"]))
            event = await back(stream, hf.events.RolledBack)
        assert event.address == "/app/top/doer"
        assert await seen(system) == ["a"]


async def test_a_child_is_started_with_an_older_snapshot_by_hand(store: str | None, isolation: str) -> None:
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), doing(isolation, "new")))
        await two_snapshots(system)
        await top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
        with system.events() as stream:
            await top(system).ask(hf.RestartChild("doer", older=True), timeout=20.0)
            async with asyncio.timeout(60.0):
                event = await back(stream, hf.events.RolledBack)
        assert await seen(system) == ["a", "b"], "it was saved when it was stopped, and before"
        assert event.from_turn > event.to_turn > 0


async def test_without_an_older_snapshot_nothing_is_started_by_hand(store: str | None, isolation: str) -> None:
    """Wherever its supervisor is, whoever has asked is told; a child that ran goes on as it was."""
    async with running(store) as system:
        await system.start(tree(isolation, doing(isolation), doing(isolation, "new")))
        await add(system, "a")
        with pytest.raises(hf.errors.ControlFailed, match="there is no older snapshot"):
            await top(system).ask(hf.RestartChild("doer", older=True, running=True), timeout=20.0)
        assert await seen(system) == ["a"]
        await top(system).ask(hf.TerminateChild("new"), timeout=20.0)
        with pytest.raises(hf.errors.ControlFailed, match="there is no older snapshot"):
            await top(system).ask(hf.RestartChild("new", older=True), timeout=20.0)
        counted = await top(system).ask(hf.supervision.CountChildren())
        assert (counted.specs, counted.active) == (2, 1), "it stays stopped"
