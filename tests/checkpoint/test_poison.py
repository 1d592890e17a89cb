"""A message that kills the root is counted over its lives, and quarantined; what others have waiting is not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.checkpoint.poison_player import DELIVERIES
from tests.checkpoint.test_restart_root import PATHS

pytestmark = pytest.mark.usefixtures("warm_programs")

PLAYER = Path(__file__).with_name("poison_player.py")


def live(store: Path, kind: str, moment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(PLAYER), str(store), kind, moment]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": PATHS})


@pytest.mark.parametrize("kind", ["SYNC", "ASYNC"])
def test_a_message_that_kills_the_root_is_quarantined(tmp_path: Path, kind: str) -> None:
    store = tmp_path / "app.db"
    for death in range(DELIVERIES):
        done = live(store, kind, "AGAIN" if death else "FIRST")
        assert (done.returncode, done.stdout) == (-9, ""), done.stderr
    for life in range(2):  # It is told once, and stays in quarantine.
        done = live(store, kind, "AGAIN")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout) == [[2, 1], [["/app/sick", DELIVERIES]], int(life == 0)]
    assert not Path(f"{store}-hands").exists()


def test_a_root_that_is_killed_between_turns_blames_nobody(tmp_path: Path) -> None:
    """Also if something waits each time, and a message was in hand once before."""
    store = tmp_path / "app.db"
    script = (
        "import asyncio, os, sys, holdfast as hf\n"
        "from tests.checkpoint.poison_player import *\n"
        "async def main():\n"
        "    async with hf.ActorSystem('app', store='sqlite:' + sys.argv[1], log=False) as system:\n"
        "        recovery = hf.hybrid(interval=1000.0, max_deliveries=2)\n"
        "        one = await system.start(hf.child('one', hf.start(Worker), recovery=recovery))\n"
        "        await one.ask(Work(), timeout=60.0)\n"
        "        await system.suspend(one)\n"
        "        await one.send(Work())\n"
        "        if sys.argv[2] == 'kill': os.kill(os.getpid(), 9)\n"
        "        await system.resume(one)\n"
        "        print(await one.ask(Get(), timeout=60.0), len(system.quarantined()))\n"
        "asyncio.run(main())\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([PATHS, str(Path(__file__).parents[2])])}
    for what, code, out in (("kill", -9, ""), ("kill", -9, ""), ("kill", -9, ""), ("end", 0, "8 0\n")):
        done = subprocess.run([sys.executable, "-c", script, str(store), what], capture_output=True, text=True, env=env)
        assert (done.returncode, done.stdout) == (code, out), done.stderr


def test_a_turn_that_only_waits_when_another_kills_the_root_is_not_blamed(tmp_path: Path) -> None:
    """The next root knows who was at work."""
    script = (
        "import asyncio, os, sys, holdfast as hf\n"
        "from pathlib import Path\n"
        "from tests.checkpoint.players import *\n"
        "async def main():\n"
        "    async with hf.ActorSystem('app', store=f'sqlite:{sys.argv[1]}/app.db', log=False) as system:\n"
        "        recovery = hf.hybrid(interval=1000.0, max_deliveries=2)\n"
        "        specs = [hf.child(name, hf.start(Doer), recovery=recovery) for name in ('one', 'two')]\n"
        "        one, two = [await system.start(spec) for spec in specs]\n"
        "        begun, what = Path(sys.argv[1], 'gate'), sys.argv[2]\n"
        "        if what == '0': await two.send(Do([f'gate {begun}', 'add through']))\n"
        "        if what == 'end': Path(f'{begun}.open').touch()\n"
        "        else:\n"
        "            await until(begun.exists)\n"
        "            begun.unlink()\n"
        "            await one.ask(Do([f'once {sys.argv[1]}/fuse{what}']), timeout=60.0)\n"
        "        print(await two.ask(Seen(), timeout=60.0), len(system.quarantined()))\n"
        "asyncio.run(main())\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([PATHS, str(Path(__file__).parents[2])])}
    for what in ("0", "1", "2", "3", "end"):
        command = [sys.executable, "-c", script, str(tmp_path), what]
        done = subprocess.run(command, capture_output=True, text=True, env=env)
        expected = (0, "['through'] 0\n") if what == "end" else (-9, "")
        assert (done.returncode, done.stdout) == expected, done.stderr
