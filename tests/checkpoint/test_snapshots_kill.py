"""SIGKILL in the middle of a snapshot: the actor's process, the forked writer, the root (R25, R26, T9, T10, T17)."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

import holdfast
import holdfast as hf
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.image_player import CELLS, MANY, Canvas, Digest, Paint, Turns, digest_of
from tests.checkpoint.players import start, until
from tests.checkpoint.strikes import NEVER

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = 20_261_121
ROUNDS = 6
SCRIPT = Path(__file__).with_name("snapshot_root.py")
PATHS = os.pathsep.join(
    filter(None, (str(Path(holdfast.__file__).parents[1]), str(SCRIPT.parents[2]), os.environ.get("PYTHONPATH")))
)


def model(cells: int) -> Any:
    made: Any = Canvas.__new__(Canvas)
    Canvas.__init__(made, cells)
    return made


async def canvas(system: hf.ActorSystem, isolation: str, cells: int) -> hf.ActorRef[Canvas]:
    recovery = hf.hybrid(interval=NEVER, max_deliveries=1000)
    return await start(system, isolation, "canvas", hf.start(Canvas, cells), recovery=recovery, shutdown=8.0)


@pytest.mark.pairs
@pytest.mark.parametrize("where", ["process", "subtree"])
@pytest.mark.parametrize("cells", [CELLS, MANY])
async def test_the_process_dies_in_the_middle_of_a_snapshot(store: str | None, where: str, cells: int) -> None:
    moments = random.Random(SEED)
    print(f"seed {SEED}")
    want = model(cells)
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        ref = await canvas(system, where, cells)
        for number in range(ROUNDS):
            paint = Paint(moments.randrange(cells), cells // 3)
            want.paint(paint)
            await ref.ask(paint, timeout=30.0)
            wish = asyncio.ensure_future(system.checkpoint(ref, timeout=30.0))
            await asyncio.sleep(moments.choice((0.0, moments.uniform(0.0, 0.06))))
            later = Paint(moments.randrange(cells), 1)
            want.paint(later)
            ref.tell(later)
            os.kill(system.pid_of(ref), signal.SIGKILL)
            assert await ref.ask(Digest(), timeout=30.0) == digest_of(want), f"seed {SEED}, round {number}"
            await asyncio.wait([wish])
            wish.exception()


async def test_the_forked_writer_dies_in_the_middle_of_a_snapshot(system: hf.ActorSystem) -> None:
    moments = random.Random(SEED)
    print(f"seed {SEED}")
    want = model(MANY)
    ref = await canvas(system, "process", MANY)
    broken = 0
    with system.events() as stream:
        for number in range(400):
            if number >= 20 and broken >= 3:
                break  # On a busy machine a writer has often written all before it is killed.
            paint = Paint(moments.randrange(MANY), MANY // 2)
            want.paint(paint)
            await ref.ask(paint, timeout=30.0)
            wish = asyncio.ensure_future(system.checkpoint(ref, timeout=30.0))
            process = psutil.Process(system.pid_of(ref))
            await until(lambda: process.children() or wish.done())  # noqa: B023 - called at once
            await asyncio.sleep(moments.uniform(0.0, 0.004))
            for writer in process.children():
                with contextlib.suppress(ProcessLookupError):  # It has just written all, and ended.
                    os.kill(writer.pid, signal.SIGKILL)
            await asyncio.wait([wish])
            problem = wish.exception()
            assert problem is None or "died" in str(problem), f"round {number}"
            broken += problem is not None
        failed = [one for one in stream.take() if isinstance(one, hf.events.SnapshotFailed)]
    assert broken >= 3
    assert failed, "a writer that was killed has written nothing that counts"
    os.kill(system.pid_of(ref), signal.SIGKILL)
    assert await ref.ask(Digest(), timeout=30.0) == digest_of(want), f"seed {SEED}"
    await system.checkpoint(ref, timeout=30.0)


@pytest.mark.parametrize("where", ["task", "process"])
def test_the_root_dies_in_the_middle_of_a_snapshot(tmp_path: Path, where: str) -> None:
    moments = random.Random(SEED)
    print(f"seed {SEED}")
    store, following, cells = tmp_path / "app.db", 0, CELLS if where == "task" else 4 * CELLS
    for _ in range(3):
        fatal = following + moments.randint(3, 40)
        root = begin(store, where, following, 1_000_000)
        assert root.stdout is not None
        with root.stdout as out:
            for line in out:
                if int(line) == fatal:
                    root.kill()
        assert root.wait() == -9, f"seed {SEED}: it ended by itself"
        following = asyncio.run(count(store, where))
    done = model(cells)
    for n in range(following):
        done.paint(Paint(n * 37 % cells, 40_000))
    root = begin(store, where, 1, 0)
    output, _ = root.communicate(timeout=60)
    assert output.splitlines()[-1] == digest_of(done), f"seed {SEED}"


async def count(store: Path, where: Any) -> int:
    """How many were painted: the next one goes on from there, whether or not the last was answered."""
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        cells = CELLS if where == "task" else 4 * CELLS
        ref = await system.start(
            hf.child("canvas", hf.start(Canvas, cells), isolation=where, recovery=hf.hybrid(interval=NEVER))
        )
        return await ref.ask(Turns(), timeout=60.0)


def begin(store: Path, where: str, first: int, last: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(store), where, str(first), str(last)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": PATHS})


def test_packs_that_no_snapshot_names_are_removed(tmp_path: Path) -> None:
    journal = SqliteJournal(tmp_path / "x.db")
    for number in (1, 2, 3):
        journal.keep_blocks("/app/a", number, [(0, memoryview(b"x" * 5000))], False)
    assert journal.packs("/app/a") == {1, 2, 3}
    journal.forget_blocks("/app/a", {1, 3})
    assert [path.name for path in tmp_path.glob("x.db-packs/*/*")] == ["2.pack"]
    journal.append([("/app/a", ("in", 1))])
    journal.erase("/app/a")
    assert [path.name for path in tmp_path.glob("x.db-packs/*")] == ["store-id"]
    journal.close()
