"""Children that come back with their dynamic supervisor, and are bound to somebody who is not there yet.

The table: a plain, a recorded and a nested one x where the desk is that they are bound to x how they came to start.
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.supervision.admin import WhichChildren
from tests.supervision.come_back_player import (
    NAMES,
    Count,
    Desk,
    Note,
    add,
    children,
    clerks_at,
    counted,
    desk_at,
    program,
)

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOT = Path(__file__).parents[2]
PLACES = ["earlier", "later", "other"]
SILENT = (hf.events.ChildStartFailed, hf.events.ChildRestarted, hf.events.SupervisorGaveUp, hf.events.BindingAwaited)


async def run(*arguments: str) -> tuple[int, str]:
    """The exit code and the output of a program."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *arguments,
        env={**os.environ, "PYTHONPATH": path},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    said, _ = await process.communicate()
    assert process.returncode is not None
    return process.returncode, said.decode()


def problems(system: hf.ActorSystem) -> list[str]:
    """What went wrong in this program."""
    return [
        f"{event.kind} {event.address} {event.fields}"
        for event in system.history("/app/**", kinds=[kind.__name__ for kind in SILENT]).events
    ]


@pytest.mark.parametrize("where", PLACES)
async def test_they_are_back_when_their_supervisor_is_restarted(where: str) -> None:
    async with program(None, where) as system:
        await add(system, where)
        assert await counted(system, where) == [1, 2, 3]
        top = "/app/house" if where != "other" else "/app/clerks"
        with system.events() as events:
            system.ref(top, hf.Supervisor).kill()
            seen = list[hf.events.Event]()
            while len([one for one in seen if isinstance(one, hf.events.ActorStarted)]) < 3:
                seen.append(await events.until(hf.events.Event))
        assert await counted(system, where) == [4, 5, 6]
        assert {event.address for event in seen if isinstance(event, SILENT)} <= {top}


@pytest.mark.parametrize("where", PLACES)
async def test_they_are_back_in_the_next_program(where: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path}/store"
    async with program(store, where) as system:
        await add(system, where)
        assert await counted(system, where) == [1, 2, 3]
    async with program(store, where) as system:
        assert await counted(system, where) == [4, 5, 6]
        assert problems(system) == []


@pytest.mark.parametrize("where", PLACES)
async def test_they_are_back_when_the_program_was_killed(where: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path}/store"
    player = str(Path(__file__).with_name("come_back_player.py"))
    code, said = await run(player, store, where)
    assert code == -signal.SIGKILL, said
    async with program(store, where) as system:
        assert await counted(system, where) == [4, 5, 6]
        assert problems(system) == []


@pytest.mark.parametrize("where", PLACES)
async def test_a_first_start_is_refused_where_nobody_is(where: str) -> None:
    async with program(None, where, has_desk=False) as system:
        above = system.ref(clerks_at(where), hf.supervision.DynamicSupervisor)
        for spec in children(desk_at(where)):
            with pytest.raises(hf.StartFailed, match=f"binding 'desk': there is no actor at {desk_at(where)}"):
                await above.ask(hf.StartChild(spec))


@pytest.mark.parametrize("where", PLACES)
async def test_whoever_never_comes_is_told_of_and_keeps_nobody_else_waiting(where: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path}/store"
    async with program(store, where) as system:
        await add(system, where)
        free = hf.child("free", hf.start(Desk))
        await system.ref(clerks_at(where), hf.supervision.DynamicSupervisor).ask(hf.StartChild(free))
    async with program(store, where, has_desk=False) as system:
        clerks, desk = clerks_at(where), desk_at(where)
        with system.events() as events:
            assert await system.ref(f"{clerks}/free", Desk).ask(Note()) == 1
            told = await events.until(hf.events.BindingAwaited, timeout=30.0)
        assert (told.address, told.target, told.children) == (clerks, desk, 3)
        assert told.seconds >= 5.0
        assert f"is to start as soon as somebody lives at {desk}" in " ".join(await system.why(f"{clerks}/plain"))
        assert f"plain is starting, and waits for {desk} to be there" in " ".join(await system.why(clerks))
        infos = await system.ref(clerks, hf.Supervisor).ask(WhichChildren())
        assert {info.id: info.state for info in infos} == {**dict.fromkeys(NAMES, "starting"), "free": "running"}
        again = system.ref(clerks, hf.Supervisor).ask(hf.StartChild(children(desk)[1]), 20.0)
        await system.ref(clerks, hf.Supervisor).ask(hf.TerminateChild("plain"))
        if where == "other":
            await system.start(hf.child("desk", hf.start(Desk), recovery=hf.hybrid()))
        else:
            await system.ref("/app/house", hf.Supervisor).ask(hf.RestartChild("desk"))
        with pytest.raises(hf.errors.AlreadyStarted) as running:
            await again
        assert await running.value.ref.ask(Count()) == 1
        assert system._node.find(f"{clerks}/plain") is None


async def test_whom_a_static_child_is_bound_to_has_to_be_there_first() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        for spec in children("/app/desk"):
            with pytest.raises(hf.StartFailed, match="there is no actor at /app/desk"):
                await system.start(spec)


AGAIN = """
        print("bids", [await desk.ask(Bid(f"a{number}", 500)) for number in range(4)], flush=True)
        if sys.argv[2] == "kill":
            os.kill(os.getpid(), 9)


asyncio.run(house(sys.argv[1]))
"""


async def test_the_program_of_the_book_comes_back_whenever_it_is_killed(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how-to" / "start-actors-on-demand.md").read_text()
    code = re.search(r"```python\n(.*?)        with system.events", page, re.DOTALL)
    assert code is not None
    text = code[1].replace("look_every = 0.02", "look_every = 30.0")
    slow = text.replace(
        '        bindings = {"auctions"', '        await asyncio.sleep(0.3)\n        bindings = {"auctions"'
    )
    assert text != code[1]
    assert slow != text
    for name, body in (("page", text), ("slow", slow)):
        (tmp_path / f"{name}.py").write_text(f"import os\nimport sys\n{body}{AGAIN}")
    store = f"sqlite:{tmp_path}/house.db"
    for count, (name, end) in enumerate([("page", "kill"), ("page", "kill"), ("slow", "kill"), ("slow", "stop")], 1):
        returned, said = await run(str(tmp_path / f"{name}.py"), store, end)
        assert f"bids [{count}, {count}, {count}, {count}]" in said, said
        assert returned == (-signal.SIGKILL if end == "kill" else 0), said
