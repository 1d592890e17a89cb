"""What is changed of a child is kept, there and back: what x how, for each kind of supervisor."""

from __future__ import annotations

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


def killed(store: str, kind: str, direction: str) -> dict[str, list[Any]]:
    """What a program was like that is killed then."""
    paths = os.pathsep.join(filter(None, (str(Path(hf.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    code = "from tests.supervision import changes_player; changes_player.main()"  # Whose classes have their own name.
    command = [sys.executable, "-c", code, store, kind, direction]
    ended = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": paths}
    )
    assert ended.returncode == -9, ended.stderr
    seen: dict[str, list[Any]] = json.loads(ended.stdout)
    return seen


@pytest.mark.parametrize("how", ["child", "supervisor", "program", "killed"])
@pytest.mark.parametrize("direction", ["there", "back"])
@pytest.mark.parametrize("kind", player.KINDS)
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


async def test_a_new_template_and_a_transaction_reach_all_and_are_kept(tmp_path: Path) -> None:
    """Also those that are started later; a program that says nothing new changes nothing, one that says it goes on."""
    store = f"sqlite:{tmp_path / 'app.db'}"
    team = player.trees("template")[-1]
    new = hf.child(None, hf.start(player.New), recovery=hf.hybrid(), bindings=player.BOUND)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await player.begin(system, "template")
        await player.come(system, "template", "one", "two")
        await system.ref("/app/team", hf.Supervisor).ask(hf.supervision.ChangeSupervisor(children=[new]))
        async with system.transaction() as change:
            for name in ("one", "two"):
                change.replace_code(player.at(name), player.New)
        await player.come(system, "template", "three")
        for name in ("one", "two", "three"):
            await system.ref(player.at(name)).ask(player.Count())
    later = hf.dynamic("team", template=new, journal=True, intensity=100)
    for said in (team, team, later, later):
        async with hf.ActorSystem("app", store=store, log=False) as system:
            for tree in (*player.trees("template")[:-1], said):
                await system.start(tree)
            seen = await player.looks(system)
            assert [seen[player.at(name)][:3] for name in ("one", "two", "three")] == [["New", "task", 2]] * 3


@pytest.mark.parametrize(
    ("kind", "place"), [("template", "task"), ("spec", "task"), ("plain", "task"), ("plain", "process")]
)
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
