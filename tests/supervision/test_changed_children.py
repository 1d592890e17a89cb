"""What is changed of a child is kept, there and back: what x how, for each kind of supervisor."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.group import probation
from holdfast.supervision.spec import Isolation
from tests.checkpoint.players import until
from tests.supervision import changes_player as player

pytestmark = pytest.mark.usefixtures("warm_programs")


@pytest.fixture(autouse=True)
def brief_probation(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in player.PROBATION.items():
        monkeypatch.setattr(probation, name, value)


async def again(system: hf.ActorSystem, how: str) -> None:
    """Each child, or its supervisor, ends and is started again."""
    above = system.ref("/app/team", hf.Supervisor)
    paths = [one.path for one in await above.ask(hf.WhichChildren())] if how == "child" else ["/app/team"]
    with system.events() as events:
        for path in paths:
            system.ref(path).kill()
        waiting = set(paths)
        async for one in events:
            if isinstance(one, hf.events.ChildRestarted):
                waiting.discard(one.address)
            if not waiting:
                break
    await until(lambda: "/app/team" in system.tree() and above._cell.host.is_up(above._cell))


def killed(store: str, kind: str, direction: str, place: Isolation = "task") -> dict[str, list[Any]]:
    """What a program was like that is killed then."""
    paths = os.pathsep.join(filter(None, (str(Path(hf.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    code = "from tests.supervision import changes_player; changes_player.main()"  # Whose classes have their own name.
    command = [sys.executable, "-c", code, store, kind, direction, place]
    ended = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": paths}
    )
    assert ended.returncode == -9, ended.stderr
    seen: dict[str, list[Any]] = json.loads(ended.stdout)
    return seen


@pytest.mark.parametrize("how", ["child", "supervisor", "program", "killed"])
@pytest.mark.parametrize("direction", ["there", "back"])
@pytest.mark.parametrize("kind", player.KINDS)
@pytest.mark.some(12)
async def test_what_is_changed_of_a_child_is_kept(tmp_path: Path, kind: str, direction: str, how: str) -> None:
    store, before = f"sqlite:{tmp_path / 'app.db'}", None
    if how == "killed":
        before = killed(store, kind, direction)
    elif how == "program":
        before = await player.first(store, kind, direction, is_killed=False)
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        await player.begin(system, kind)
        if how in ("child", "supervisor"):
            for step in player.DIRECTIONS[direction]:
                await step(system, kind)
            before = await player.looks(system)
            await again(system, how)
        assert before is not None
        assert await player.looks(system) == before


ALL_NEW = {player.at(name): ["New", count] for name, count in (("one", 4), ("two", 4), ("three", 2))}


async def classes(system: hf.ActorSystem) -> dict[str, list[Any]]:
    """The class of each child, and what it has counted."""
    seen: dict[str, list[Any]] = {}
    for one in await system.ref("/app/team", hf.Supervisor).ask(hf.WhichChildren(), timeout=20.0):
        kind, _, total, _ = await system.ref(one.path).ask(player.Tell(), timeout=30.0)
        seen[one.path] = [kind, total]
    return seen


@pytest.mark.parametrize("how", ["child", "supervisor", "program", "killed"])
@pytest.mark.parametrize("renewal", player.RENEWALS)
@pytest.mark.parametrize("place", ["task", "process"])
@pytest.mark.some(15)
async def test_a_new_template_and_new_code_reach_all_and_are_kept(
    tmp_path: Path, place: Isolation, renewal: str, how: str
) -> None:
    """Also those that are started later; in this program, and in the next ones that say what the first has said."""
    store = f"sqlite:{tmp_path / 'app.db'}"
    if how == "killed":
        killed(store, "template", renewal, place)
    elif how == "program":
        await player.first(store, "template", renewal, place, is_killed=False)
    for _ in range(2):
        async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
            await player.begin(system, "template", place)
            if how in ("child", "supervisor") and player.at("one") not in system.tree():
                await player.renewed(system, renewal)
                await again(system, how)
            assert await classes(system) == ALL_NEW
            await again(system, "supervisor")
            assert await classes(system) == ALL_NEW


@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_new_template_in_the_source_counts_and_so_does_each_one_behind_it(
    tmp_path: Path, place: Isolation
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await player.first(store, "template", "template, orders", place, is_killed=False)
    elsewhere = dataclasses.replace(player.TEMPLATE, bindings={"peer": "/app/second"})
    brief = dataclasses.replace(player.TEMPLATE, shutdown=2.0)
    for said, given, peer in [
        (player.TEMPLATE, None, "first"),
        (elsewhere, brief, "second"),
        (elsewhere, None, "first"),
        (player.TEMPLATE, None, "first"),
        (elsewhere, None, "second"),
    ]:
        async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
            *others, _ = player.trees("template")
            for tree in (*others, hf.dynamic("team", template=said, journal=True, intensity=100, isolation=place)):
                await system.start(tree)
            team = system.ref("/app/team", hf.Supervisor)
            assert await classes(system) == ALL_NEW
            for path in ALL_NEW:
                assert (await system.ref(path).ask(player.Tell()))[3] == f"/app/{peer}", (said, given)
            if given is not None:
                await team.ask(hf.supervision.ChangeSupervisor(children=[given]))


@pytest.mark.parametrize("place", ["task", "process"])
async def test_another_option_in_the_source_leaves_the_class_that_it_was_given(
    tmp_path: Path, place: Isolation
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await player.first(store, "template", "template, orders", place, is_killed=False)
    elsewhere = dataclasses.replace(player.member(None), bindings={"peer": "/app/second"})
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        *others, _ = player.trees("template")
        for tree in (*others, hf.dynamic("team", template=elsewhere, journal=True, intensity=9, isolation=place)):
            await system.start(tree)
        assert await classes(system) == ALL_NEW
        assert (await system.ref(player.at("one")).ask(player.Tell()))[3] == "/app/second"


@pytest.mark.parametrize("place", ["task", "process"])
async def test_whose_code_does_not_fit_what_it_has_recorded_is_tried_with_the_present_template(
    tmp_path: Path, place: Isolation
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await player.first(store, "template", "template, orders", place, is_killed=False)
    waits = hf.Backoff(initial=0.05, maximum=0.05)
    wrong: hf.ChildSpec = dataclasses.replace(player.member(None), start=hf.start(player.Wrong), backoff=waits)
    new = dataclasses.replace(player.TEMPLATE, backoff=waits)
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        *others, _ = player.trees("template")
        with system.events() as events:
            for tree in (*others, hf.dynamic("team", template=wrong, journal=True, intensity=1000, isolation=place)):
                await system.start(tree)
            failed = set[str]()
            while not ALL_NEW.keys() <= failed:
                failed.add((await events.until(hf.events.ChildStartFailed)).address)
            team, up = system.ref("/app/team", hf.Supervisor), set[str]()
            await team.ask(hf.supervision.ChangeSupervisor(children=[new]))
            while not ALL_NEW.keys() <= up:
                up.add((await events.until(hf.events.ActorStarted)).address)
        assert await classes(system) == ALL_NEW
        await again(system, "supervisor")
        assert await classes(system) == ALL_NEW


@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_transaction_changes_flags_and_leaves_the_template(tmp_path: Path, place: Isolation) -> None:
    flags = hf.supervision.Flags(intensity=50, period=7.0, journal=True)
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / 'app.db'}", log=False, intensity=100) as system:
        await player.begin(system, "template", place)
        await player.renewed(system, "template, orders")
        team = system.ref("/app/team", hf.Supervisor)
        await team.ask(hf.supervision.ChangeSupervisor(flags=flags))
        for wanted in (100, 60):  # The first is what the program says.
            async with system.transaction() as change:
                change.intensity(team, wanted, period=7.0)
            for _ in range(2):
                seen = await system.get_state(team)
                assert (seen["intensity"], seen["period"]) == (wanted, 7.0)
                assert await classes(system) == ALL_NEW
                await again(system, "supervisor")


@pytest.mark.parametrize(
    ("kind", "place"), [("template", "task"), ("spec", "task"), ("plain", "task"), ("plain", "process")]
)
@pytest.mark.some(2)
async def test_a_mechanism_is_that_of_one_child(tmp_path: Path, kind: str, place: Isolation) -> None:
    """It has it each time it is started, in this program and the next ones; another child of its name has none."""
    member = player.member("gone")
    store = f"sqlite:{tmp_path / 'app.db'}"

    async def stacks(system: hf.ActorSystem) -> dict[str, tuple[str, ...]]:
        refs = {name: system.ref(player.at(name)) for name in ("same", "gone")}
        for ref in refs.values():
            await ref.ask(player.Tell(), timeout=30.0)
        return {name: (await system.protection(ref)).stack for name, ref in refs.items()}

    async def begun(system: hf.ActorSystem) -> hf.ActorRef[Any]:
        for tree in player.trees(kind, place):
            await system.start(tree)
        return system.ref("/app/team", hf.Supervisor)

    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        await begun(system)
        if kind != "plain":
            await player.come(system, kind, "same", "gone")
        async with system.transaction() as change:
            change.protect(player.at("same"), hf.ftm.PBR())
            change.protect(player.at("gone"), hf.ftm.LFR())
        await change.settled()
        await again(system, "supervisor")
        assert await stacks(system) == {"same": ("pbr",), "gone": ("lfr",)}
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        team = await begun(system)
        assert await stacks(system) == {"same": ("pbr",), "gone": ("lfr",)}
        await again(system, "supervisor")
        assert await stacks(system) == {"same": ("pbr",), "gone": ("lfr",)}
        if kind == "plain":
            for step in (lambda change: change.remove(player.at("gone")), lambda change: change.add(team, member)):
                async with system.transaction() as change:
                    step(change)
        else:
            await team.ask(hf.TerminateChild("gone"))
            await player.come(system, kind, "gone")
        assert await stacks(system) == {"same": ("pbr",), "gone": ()}
        await again(system, "supervisor")
        assert await stacks(system) == {"same": ("pbr",), "gone": ()}
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        await begun(system)
        assert await stacks(system) == {"same": ("pbr",), "gone": ()}
