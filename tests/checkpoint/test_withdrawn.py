"""`AskTimeout.handled` of an ask to a recorded actor is False where it is never handled, and nowhere else."""

from __future__ import annotations

import asyncio
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.conftest import ROOT
from tests.checkpoint.players import until
from tests.checkpoint.withdrawn_player import METHODS, Done, Put, Slow, noted, slow

pytestmark = pytest.mark.usefixtures("warm_programs")

SHORT, LONG = 0.1, 60.0
PLAYER = "tests.checkpoint.withdrawn_player"
WHERE = ("task", "process", "subtree")
STORES = ("memory", "os", "fsync")
STACKS: dict[str, Any] = {"none": None, "PBR": hf.ftm.PBR(), "LFR": hf.ftm.LFR(), "TR": hf.ftm.TR()}


async def begun(system: hf.ActorSystem, tmp_path: Path, where: str, **options: Any) -> hf.ActorRef[Slow]:
    spec, path = slow(where, options.pop("method"), tmp_path / "begun", **options)
    await system.start(spec)
    return system.ref(path, Slow)


def system_for(kept: str, tmp_path: Path) -> hf.ActorSystem:
    if kept == "memory":
        return hf.ActorSystem("app", log=False)
    return hf.ActorSystem("app", store=f"sqlite:{tmp_path}/app.db", durability=kept, log=False)  # type: ignore[arg-type]


async def told_of(ref: hf.ActorRef[Slow], *names: str) -> list[bool | None]:
    late = await asyncio.gather(*(ref.ask(Put(name), SHORT) for name in names), return_exceptions=True)
    return [one.handled for one in late if isinstance(one, hf.AskTimeout)]


@pytest.mark.pairs
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("kept", STORES)
@pytest.mark.parametrize("way", ["behind a turn", "suspended"])
@pytest.mark.some(5)
async def test_what_waits_until_its_time_is_over_is_never_handled(
    tmp_path: Path, name: str, where: str, kept: str, way: str
) -> None:
    async with system_for(kept, tmp_path) as system:
        ref = await begun(system, tmp_path, where, method=METHODS[name])
        slow_one = None
        if way == "suspended":
            await system.suspend(ref)
        else:
            slow_one = ref.ask(Put("slow", 1.0), LONG)
            await until(lambda: "slow" in noted(tmp_path / "begun"))
        assert await told_of(ref, "a", "b", "c") == [False] * 3
        if slow_one is None:
            await system.resume(ref)
        else:
            await slow_one
        assert await ref.ask(Done(), LONG) == (slow_one is not None)
    assert noted(tmp_path / "begun") == ({"slow"} if slow_one is not None else set())


@pytest.mark.parametrize("stack", [name for name in STACKS if name != "none"])
async def test_nor_behind_a_mechanism(tmp_path: Path, stack: str) -> None:
    async with system_for("os", tmp_path) as system:
        ref = await begun(system, tmp_path, "task", method=hf.hybrid(), mechanism=STACKS[stack])
        slow_one = ref.ask(Put("slow", 1.0), LONG)
        await until(lambda: "slow" in noted(tmp_path / "begun"))
        assert set(await told_of(ref, "a", "b")) <= {False, None}
        await slow_one
        await ref.ask(Done(), LONG)
    assert noted(tmp_path / "begun") == {"slow"}


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("where", WHERE)
@pytest.mark.some(5)
async def test_of_the_turn_in_hand_nobody_knows(tmp_path: Path, name: str, where: str) -> None:
    async with system_for("os", tmp_path) as system:
        ref = await begun(system, tmp_path, where, method=METHODS[name])
        with pytest.raises(hf.AskTimeout) as late:
            await ref.ask(Put("slow", 1.0), 0.5)
        assert late.value.handled is (None if "slow" in noted(tmp_path / "begun") else False)


@pytest.mark.asyncio(loop_factories=["uvloop"])  # Behind what it has read it comes to its timers first.
@pytest.mark.parametrize("where", ["process", "subtree"])
async def test_nor_of_a_turn_that_has_ended_and_was_not_heard_of(tmp_path: Path, where: str) -> None:
    """The root is at something else from the question until its time is over."""
    loop, (heard, told) = asyncio.get_running_loop(), os.pipe()
    async with system_for("memory", tmp_path) as system:
        ref = await begun(system, tmp_path, where, method=hf.hybrid())
        await ref.ask(Done(), LONG)
        ends = time.monotonic() + 1.0 + SHORT

        def block() -> None:
            os.read(heard, 1)
            while time.monotonic() < ends:
                time.sleep(0.001)  # It is the loop that is blocked.

        loop.add_reader(heard, block)
        asked = ref.ask(Put("quick"), 1.0)
        for _ in range(2):  # It is sent behind what is ready now.
            await asyncio.sleep(0)
        os.write(told, b".")
        (said,) = await asyncio.gather(asked, return_exceptions=True)
        loop.remove_reader(heard)
        assert said == 1 or (isinstance(said, hf.AskTimeout) and said.handled is None)
    os.close(heard)
    os.close(told)


@pytest.mark.parametrize(("where", "name"), [("task", "hybrid"), ("process", "replay_only"), ("subtree", "hybrid")])
def test_it_is_never_false_of_what_has_begun_whoever_is_killed(tmp_path: Path, where: str, name: str) -> None:
    """By a ledger outside; also of what a later program has begun."""
    draw = random.Random(f"{where} {name}")
    command = [sys.executable, "-m", PLAYER, f"sqlite:{tmp_path}/app.db", where, name, str(tmp_path)]
    for program in range(4):
        with subprocess.Popen([*command, str(program), str(draw.randrange(1 << 30))], cwd=ROOT) as process:
            ends = time.monotonic() + LONG
            while str(program) not in noted(tmp_path / "up"):
                assert process.poll() is None
                assert time.monotonic() < ends
                time.sleep(0.01)
            time.sleep(draw.uniform(0.5, 2.0))  # Any moment of its work: what is judged holds at each.
            process.kill()
    subprocess.run([*command, "3", "-1"], cwd=ROOT, check=True, timeout=120)
    began, told = noted(tmp_path / "begun"), noted(tmp_path / "told")
    assert len(began) > 20
    assert len(told) > 5
    assert began & told == set()
