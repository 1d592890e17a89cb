"""The ways in which a supervisor comes to other processes, and back: which supervisors it is moved between."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import holdfast as hf
from tests.launched import kills_itself
from tests.migration.far_places import IN_TIME
from tests.system.test_transaction_commit import Die

HOMES: dict[str, Any] = {"near": "task", "next": "task", "far": "process", "other": "process"}
WAYS = {
    "far to near": ("far", "near"),
    "near to far": ("near", "far"),
    "far to far": ("far", "other"),
    "with its process": ("near", "next"),
    "to a process": ("near", "near"),
    "to a task": ("near", "near"),
}
IN_PLACE = {"to a process": "process", "to a task": "task"}


async def plant(system: hf.ActorSystem, at: str, spec: hf.ChildSpec, *homes: str) -> None:
    for name in dict.fromkeys(homes):
        isolation: Any = HOMES[name]
        children = [spec] if name == at else []
        await system.start(hf.supervisor(name, children=children, isolation=isolation, intensity=1000))


def isolation_for(way: str) -> Any:
    """Where it lives before it is moved so."""
    return "process" if way in ("with its process", "to a task") else "task"


async def move(system: hf.ActorSystem, to: str, *then: hf.system.Operation, way: str = "") -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        put(system, change, to, way)
        for step in then:
            change.step(step)


def put(system: hf.ActorSystem, change: hf.system.Change, to: str, way: str) -> None:
    """Have it be below that supervisor, or live elsewhere where it is."""
    ref = team_of(system)
    if way in IN_PLACE:
        now = "task" if system.pid_of(ref) == os.getpid() else "process"
        change.isolation(ref, "process" if now == "task" else "task")
    else:
        change.move(ref, f"/app/{to}")


def team_of(system: hf.ActorSystem) -> hf.ActorRef[hf.Supervisor]:
    found = [path for path in system.tree() if path.endswith("/team")]
    assert len(found) == 1
    return system.ref(found[0], hf.Supervisor)


async def below(system: hf.ActorSystem, at: str) -> list[tuple[str, str]]:
    told = await system.ref(at, hf.Supervisor).ask(hf.WhichChildren(), IN_TIME)
    return [(one.id, one.state) for one in told]


# -- the root is killed in the middle of a move, by a step ------------------------------------------------------------

WHENS = ["prepare", "commit", "finish", "settled"]
IN_FORCE = ("finish", "settled")


async def move_and_die(system: hf.ActorSystem, to: str, when: str, way: str) -> None:
    """The root is killed by a step of the move, or by one before it that finishes first."""
    if when == "finish":
        async with system.transaction(timeout=IN_TIME) as change:
            change.step(Die(when))
            put(system, change, to, way)
    else:
        await move(system, to, Die("finish" if when == "settled" else when), way=way)


async def dies(folder: Path, module: str, *arguments: str) -> None:
    """`killed` of a test module is killed when it runs as a program of its own, with a store in the folder."""
    program = folder / "program.py"
    program.write_text(
        f"import asyncio, sys\nfrom {module} import killed\n\n"
        'if __name__ == "__main__":\n    asyncio.run(killed(*sys.argv[1:]))\n'
    )
    await kills_itself(program, folder / "store", *arguments, timeout=IN_TIME)


def check_is_where(system: hf.ActorSystem, when: str, way: str) -> None:
    """It lives where the specification in force says, if it is moved by its place alone."""
    if way in IN_PLACE:
        has_changed = (system.pid_of(team_of(system)) != os.getpid()) == (IN_PLACE[way] == "process")
        assert has_changed == (when in IN_FORCE)
