"""Effects in processes of their own: they compute, hang, die and are killed without harm to anybody else."""

from __future__ import annotations

import asyncio
import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.effects import FunctionRaised, begin_effect
from holdfast.actors.kernel.codec import Codec
from holdfast.actors.process.effect_processes import EffectProcesses
from holdfast.ftm import LFR
from holdfast.testing import GuardedSystem, simulate
from tests.effects.clerk import IN_TIME, No, lines, note
from tests.effects.test_effects_protected import whole

pytestmark = pytest.mark.usefixtures("warm_programs")


class Run(hf.Message[str]):
    """Run `how` in a process: see `run`."""

    how: str
    file: str = ""
    at_most_once: bool = False
    attempts: int = 1
    timeout: float = IN_TIME


def run(how: str, file: str, me: int) -> Any:
    """An effect: it writes down its process first."""
    times = note(file, how) if file else 1
    match how:
        case "pid":
            return os.getpid() != me
        case "token":
            return hf.fencing_token()
        case "refuse":
            raise No("not so")
        case "raise":
            raise KeyError("a")
        case "raise once" if times == 1:
            raise KeyError("a")
        case "die" | "exit":
            os.kill(os.getpid(), signal.SIGKILL) if how == "die" else os._exit(3)
        case "die once" if times == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        case "hang":
            Path(f"{file}.pid").write_text(str(os.getpid()))
            while True:
                pass
        case "unsavable":
            return object()
        case "large":
            return "x" * 5_000_000
    return f"{how}!"


async def on_loop() -> None: ...


class Runner(hf.Actor):
    @hf.on(Run)
    async def run(self, message: Run) -> str:
        function: Any = functools.partial(run, message.how, me=os.getpid())
        if message.how in ("lambda", "async"):
            function = (lambda file: file) if message.how == "lambda" else on_loop
        options: dict[str, Any] = {"timeout": message.timeout, "at_most_once": message.at_most_once}
        if message.attempts > 1:
            options["retry"] = hf.Retry(message.attempts, hf.Backoff(initial=0.001), on=(LookupError,))
        given = () if message.how == "async" else (message.file,)
        try:
            said = await self.ctx.effect(function, *given, key=message.how, isolation="process", **options)
        except hf.HoldfastError as error:
            return f"{type(error).__name__}: {error}"
        return str(len(said)) if message.how == "large" else str(said)


def runner(isolation: Any = "task", **options: Any) -> hf.ChildSpec[Runner]:
    method = options.pop("recovery", hf.hybrid(interval=1000.0))
    return hf.child("runner", hf.start(Runner), isolation=isolation, recovery=method, **options)


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("method", [hf.hybrid(interval=1000.0), hf.fresh()], ids=["hybrid", "fresh"])
@pytest.mark.some(2)
async def test_what_comes_of_it_is_its_outcome(tmp_path: Path, isolation: str, method: Any) -> None:
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(runner(isolation, recovery=method))
        for how, says in {
            "pid": "True",
            "plain": "plain!",
            "large": "5000000",
            "refuse": "No",
            "raise": "EffectFailed: /app/runner",
            "unsavable": "UnsavableValue",
            "die": "its process has ended (exit code -9)",
            "exit": "its process has ended (exit code 3)",
            "lambda": "cannot be imported",
            "async": "SpecError",
        }.items():
            said = await ref.ask(Run(how), IN_TIME)
            assert says in said or (how == "raise" and "KeyError" in said), said
        assert int(await ref.ask(Run("token"), IN_TIME)) > 0
        assert await ref.ask(Run("raise once", world, attempts=2), IN_TIME) == "raise once!"
        assert "EffectFailed" in await ref.ask(Run("die", attempts=2), IN_TIME)
        said = await ref.ask(Run("die once", f"{world}2", at_most_once=True), IN_TIME)
        assert said.startswith("EffectInDoubt")


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_time_limit_ends_it(tmp_path: Path, isolation: str) -> None:
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(runner(isolation))
        assert await ref.ask(Run("plain"), IN_TIME) == "plain!"  # There is a process now: it begins at once.
        assert "longer than 1 s" in await ref.ask(Run("hang", world, timeout=1.0), IN_TIME)
        await gone(int(Path(f"{world}.pid").read_text()))
        assert await ref.ask(Run("plain"), IN_TIME) == "plain!"


@pytest.mark.parametrize("end", ["actor", "root"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.some(2)
async def test_it_ends_with_whoever_waits_for_it(tmp_path: Path, isolation: str, end: str) -> None:
    """Also if it computes, and the program is killed."""
    world = str(tmp_path / "world")
    if end == "root":
        await asyncio.to_thread(killed_program, world, isolation)
        await gone(int(Path(f"{world}.pid").read_text()))
        return
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(runner(isolation, recovery=hf.fresh(), restart="temporary"))
        ref.tell(Run("hang", world))
        pid = await begun(world)
        ref.kill()
        await gone(pid)


def killed_program(world: str, isolation: str) -> None:
    """Run a program until its effect computes, and kill it."""
    program = subprocess.Popen([sys.executable, "-c", PROGRAM, world, isolation])
    try:
        end = time.monotonic() + IN_TIME
        while not (Path(f"{world}.pid").exists() and Path(f"{world}.pid").read_text()):
            assert time.monotonic() < end
            time.sleep(0.01)
    finally:
        program.kill()
        program.wait()


PROGRAM = """
import asyncio, sys
import holdfast as hf
from tests.effects.test_effect_processes import Run, runner

async def main():
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(runner(sys.argv[2]))
        await ref.ask(Run("hang", sys.argv[1]), 60)

asyncio.run(main())
"""


async def begun(world: str) -> int:
    async with asyncio.timeout(IN_TIME):
        while not (Path(f"{world}.pid").exists() and Path(f"{world}.pid").read_text()):
            await asyncio.sleep(0.01)
    return int(Path(f"{world}.pid").read_text())


async def gone(pid: int) -> None:
    """Wait until a process has ended."""
    async with asyncio.timeout(IN_TIME):
        while Path(f"/proc/{pid}").exists() and "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text():
            await asyncio.sleep(0.01)


async def test_behind_a_mechanism_only_the_leader_begins_one(tmp_path: Path) -> None:
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(runner(mechanism=LFR()))
        await whole(system, ref)
        assert await ref.ask(Run("plain", world), IN_TIME) == "plain!"
    assert lines(world) == ["plain"]


def in_turn(file: str, number: int) -> int:
    """Write down when it begins and when it ends."""
    note(file, f"begins {number}")
    time.sleep(0.05)
    note(file, f"ends {number}")
    return number


@pytest.mark.parametrize("most", [1, 2])
async def test_so_many_compute_at_once_and_others_wait_in_order(tmp_path: Path, most: int) -> None:
    """Also behind one that has failed, and one that nobody waits for any more."""
    world = str(tmp_path / "world")
    processes = EffectProcesses(Codec(no_ref), most=most)
    begin_effect(1)
    try:
        given = [asyncio.ensure_future(processes.run(in_turn, world, number)) for number in range(4)]
        failed = asyncio.ensure_future(processes.run(run, "raise", "", 0))
        unwanted = asyncio.ensure_future(processes.run(in_turn, world, 4))
        last = asyncio.ensure_future(processes.run(in_turn, world, 5))
        await asyncio.sleep(0)
        unwanted.cancel()
        assert await asyncio.gather(*given, last) == [0, 1, 2, 3, 5]
        with pytest.raises(FunctionRaised):
            await failed
    finally:
        processes.close()
    said = lines(world)
    if most == 1:  # Of two, one may be begun later and be there sooner.
        assert [line for line in said if line.startswith("begins")] == [
            f"begins {number}" for number in (0, 1, 2, 3, 5)
        ]
    begun = [sum(1 if line.startswith("begins") else -1 for line in said[: end + 1]) for end in range(len(said))]
    assert max(begun) <= most


def no_ref(path: str) -> Any:
    raise LookupError(path)


async def test_what_no_import_looks_at_in_the_path_harms_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Folder(str): ...  # as an editable install or a script may have brought it

    monkeypatch.setattr(sys, "path", [Folder(tmp_path), *sys.path, tmp_path])
    begin_effect(1)
    processes = EffectProcesses(Codec(lambda path: None))  # type: ignore[arg-type, return-value]
    try:
        assert await processes.run(run, "pid", "", os.getpid()) is True
    finally:
        processes.close()


async def test_one_that_cannot_be_begun_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    begin_effect(1)
    processes = EffectProcesses(Codec(lambda path: None))  # type: ignore[arg-type, return-value]
    try:
        with monkeypatch.context() as patched:
            patched.setattr(sys, "executable", "/nowhere/python")
            with pytest.raises(FileNotFoundError):
                await processes.run(run, "pid", "", os.getpid())
        assert await processes.run(run, "pid", "", os.getpid()) is True
    finally:
        processes.close()


@simulate(seeds=3, latency=(0.0, 0.01), intensity=1000)
async def test_they_are_simulated(system: GuardedSystem) -> None:
    """Under a seed the function runs in the process of the test, behind the same codec."""
    for isolation in ("task", "process"):
        ref = await system.start(hf.child(isolation, hf.start(Runner), isolation=isolation, recovery=hf.hybrid()))
        assert await ref.ask(Run("plain"), IN_TIME) == "plain!"
        assert await ref.ask(Run("pid"), IN_TIME) == "False"
        assert await ref.ask(Run("refuse"), IN_TIME) == "No: No(why='not so')"
        assert "KeyError" in await ref.ask(Run("raise"), IN_TIME)
        assert "UnsavableValue" in await ref.ask(Run("unsavable"), IN_TIME)
