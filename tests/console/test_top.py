"""`holdfast top`, by Textual's pilot, against a real system behind its real endpoint."""

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from textual.pilot import Pilot
from textual.widgets import Static

import holdfast as hf
from holdfast.console.operate.row_list import RowList
from holdfast.console.operate.top import COLUMNS, Page, Question, Top
from holdfast.console.remote import RemoteSystem
from tests.system.trees import Add, ref


@asynccontextmanager
async def shown(path: Path) -> AsyncGenerator[Pilot[str]]:
    """The page, filled."""
    with await asyncio.to_thread(RemoteSystem, path) as remote:
        app = Top(remote, seconds=0.2)
        async with app.run_test(size=(160, 40)) as pilot:
            await until(pilot, lambda: bool(rows_of(pilot).keys))
            yield pilot


async def until(pilot: Pilot[str], holds: Callable[[], bool]) -> None:
    """Let the page work until something is so."""
    async with asyncio.timeout(20):
        while not holds():
            await pilot.pause(0.02)


def rows_of(pilot: Pilot[str]) -> RowList:
    return pilot.app.screen_stack[0].query_one(RowList)


def cell(pilot: Pilot[str], path: str, column: str) -> str:
    return rows_of(pilot).cell(path, column)


async def at(pilot: Pilot[str], path: str) -> None:
    """Move the cursor by keys."""
    rows = rows_of(pilot)
    down = rows.keys.index(path) - rows.keys.index(rows.key_at_cursor)
    await pilot.press(*["down" if down > 0 else "up"] * abs(down))
    assert rows.key_at_cursor == path


async def test_it_shows_the_tree_and_what_changes(system: hf.ActorSystem, path: Path) -> None:
    async with shown(path) as pilot:
        assert [cell(pilot, "/app/left/a", name) for name in COLUMNS[:4]] == ["    a", "running", "Counter", "task"]
        assert cell(pilot, "/app/right/e", "state") == "stopped"
        await system.suspend(ref(system, "/app/left/a"))
        await until(pilot, lambda: cell(pilot, "/app/left/a", "state") == "suspended")
        ref(system, "/app/left/a").tell(Add(1))
        await until(pilot, lambda: cell(pilot, "/app/left/a", "queued") == "1")
        await until(pilot, lambda: "1 wait" in str(pilot.app.query_one("#head", Static).content))
        await system.start(hf.child("late", hf.start(hf.Actor)))
        await until(pilot, lambda: "/app/late" in rows_of(pilot).keys)


async def test_keys_suspend_resume_inspect_and_restart(system: hf.ActorSystem, path: Path) -> None:
    async with shown(path) as pilot:
        await at(pilot, "/app/left/b")
        await pilot.press("s")
        await until(pilot, lambda: cell(pilot, "/app/left/b", "state") == "suspended")
        await pilot.press("r")
        await until(pilot, lambda: cell(pilot, "/app/left/b", "state") == "running")
        await pilot.press("i")
        await until(pilot, lambda: isinstance(pilot.app.screen, Page))
        assert "address: /app/left/b" in str(pilot.app.screen.query_one(Static).content)
        await pilot.press("escape")
        await pilot.press("R")
        await until(pilot, lambda: isinstance(pilot.app.screen, Question))
        await pilot.press("n")
        assert (await system.get_status(ref(system, "/app/left/b"))).life == 1
        await pilot.press("R")
        await until(pilot, lambda: isinstance(pilot.app.screen, Question))
        await pilot.press("y")
        await until(pilot, lambda: cell(pilot, "/app/left/b", "restarts") == "1")


async def test_a_pattern_and_another_order(system: hf.ActorSystem, path: Path) -> None:
    async with shown(path) as pilot:
        await system.suspend(ref(system, "/app/left/c"))
        ref(system, "/app/left/c").tell(Add(1))
        await pilot.press("o")
        await until(pilot, lambda: rows_of(pilot).keys[0] == "/app/left/c")
        await pilot.press("slash", *"/app/right/*", "enter")
        await until(pilot, lambda: rows_of(pilot).keys == ["/app/right/d", "/app/right/e", "/app/right/client"])


async def test_turns_are_counted_while_somebody_looks(system: hf.ActorSystem, path: Path) -> None:
    one = ref(system, "/app/left/a")
    async with shown(path) as pilot:
        async with asyncio.timeout(20):
            while cell(pilot, "/app/left/a", "turns/s") in ("", "0"):
                await one.ask(Add(1))
                await pilot.pause(0.01)
    async with asyncio.timeout(20):
        while await system.statistics(one) is not None:
            await asyncio.sleep(0.01)


async def test_it_says_why_it_ends_when_the_system_goes(tmp_path: Path) -> None:
    from holdfast.console.endpoint import control_endpoint

    async with hf.ActorSystem("app", log=False) as system, control_endpoint(system, tmp_path / "app.sock") as path:
        remote = await asyncio.to_thread(RemoteSystem, path)
        app = Top(remote, seconds=0.2)
        async with app.run_test() as pilot:
            await until(pilot, lambda: bool(rows_of(pilot).keys))
            remote._client.close()
            await until(pilot, lambda: app.return_value is not None)
    assert app.return_value is not None
    assert "no system answers at" in app.return_value


async def test_q_leaves(system: hf.ActorSystem, path: Path) -> None:
    async with shown(path) as pilot:
        await pilot.press("q")
        await until(pilot, lambda: not pilot.app.is_running)
