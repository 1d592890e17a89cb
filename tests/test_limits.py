"""What is not promised: "Limits" in docs/guarantees.md. When one of these is lifted, its line there goes too."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel import lifecycle
from holdfast.actors.kernel.codec import Packed
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.supervision import patience

# These actors are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[1])
if ROOT not in sys.path:
    sys.path.append(ROOT)


class Do(hf.Message[int]):
    what: str


class Keeper(hf.Actor):
    """Puts aside, tells itself, and has whoever waits be told."""

    def __init__(self) -> None:
        self.done: list[str] = []

    @hf.on(Do)
    async def do(self, message: Do) -> int:
        match message.what:
            case "stash" if not self.done:
                self.ctx.stash()
            case "unstash":
                self.done.append("unstash")
                self.ctx.unstash()
            case "tell itself":
                self.ctx.ref.tell(Do("told"))
                os.kill(os.getpid(), signal.SIGKILL)
            case what:
                self.done.append(what)
        return len(self.done)

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/limits")

    def on_undelivered(self, message: hf.Message[Any]) -> None:
        raise AssertionError("it is called in a task only")


class Busy(Keeper):
    """Has what binds it to its place: a child, a timer among its key variables, a wish to find somebody."""

    def __init__(self) -> None:
        super().__init__()
        self.timer: hf.Timer | None = None

    @hf.on(Do)
    async def do(self, message: Do) -> int:
        match message.what:
            case "spawn":
                self.ctx.spawn(hf.start(Keeper), "child")
            case "set a timer":
                self.timer = self.ctx.tell_after(3600.0, Do("late"))
            case "keep it aside":
                self._timer, self.timer = self.timer, None
            case "find":
                return int(self.ctx.find("/app/nobody", Keeper).path == "/app/nobody")
            case what:
                self.done.append(what)
        return len(self.done)


class Acquainted(hf.Actor):
    def __init__(self, friend: hf.ActorRef[Any]) -> None:
        self.friend = friend


async def died(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Kill its process, and wait until the next one answers."""
    with system.events() as events:
        os.kill(system.pid_of(ref), signal.SIGKILL)
        async for event in events:
            if isinstance(event, hf.events.ActorStarted) and event.address == ref.path:
                return


async def test_a_supervisor_cannot_be_protected() -> None:
    with pytest.raises(hf.SpecError, match="a supervisor cannot be protected by a mechanism: protect its children"):
        hf.child("top", hf.start(hf.Supervisor), mechanism=PBR())


async def test_a_child_without_mechanisms_leaves_them_out() -> None:
    with pytest.raises(hf.SpecError, match="mechanism must not be empty: leave it out"):
        hf.child("one", hf.start(Keeper), mechanism=())


async def test_a_ref_can_be_a_key_variable_and_no_argument_of_a_start_in_another_process() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        friend = await system.start(hf.child("friend", hf.start(Keeper)))
        spec = hf.child("one", hf.start(Acquainted, friend), recovery=hf.hybrid())
        assert (await system.get_state(await system.start(spec)))["friend"] == friend
        with pytest.raises(hf.errors.SpecError, match=r"a value of type .*ActorRef cannot be sent to another process"):
            hf.child("two", hf.start(Acquainted, friend), isolation="process")


async def test_without_recovery_what_was_put_aside_dies_with_its_process() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Keeper), isolation="process"))
        aside = ref.ask(Do("stash"), timeout=60.0)
        assert await ref.ask(Do("counted"), timeout=60.0) == 1  # It is aside by now.
        await died(system, ref)
        with pytest.raises(hf.AskFailed):
            await aside
        assert await ref.ask(Do("unstash"), timeout=60.0) == 1
        assert await ref.ask(Do("after"), timeout=60.0) == 2


async def test_without_recovery_what_it_tells_itself_dies_with_its_process() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Keeper), isolation="process"))
        with pytest.raises(hf.AskFailed):
            await ref.ask(Do("tell itself"), timeout=60.0)
        assert await ref.ask(Do("after"), timeout=60.0) == 1


async def test_on_undelivered_is_not_called_in_a_process() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("one", hf.start(Keeper), isolation="process", restart="temporary")
        ref = await system.start(spec)
        await system.suspend(ref, timeout=60.0)
        ref.tell(Do("never"))
        before = system.dead_letters
        await system.stop(ref)
        assert system.dead_letters == before + 1  # And nothing was raised.


async def test_the_spec_of_a_child_comes_packed_from_another_process() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        child = hf.child("one", hf.start(Keeper))
        top = await system.start(hf.supervisor("top", children=[child], isolation="process"))
        spec = await top.ask(hf.supervision.GetChildSpec("one"), timeout=60.0)
        assert isinstance(spec, Packed), spec


async def attach(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=60.0) as change:
        change.protect(ref, PBR())


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_with_children_cannot_be_protected(isolation: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Busy), isolation=isolation))
        await ref.ask(Do("spawn"), timeout=60.0)
        with pytest.raises(hf.TransactionFailed, match=r"children of its own \(child\): have a supervisor start them"):
            await attach(system, ref)
        assert await ref.ask(Do("goes on"), timeout=60.0) == 1


async def test_what_a_protected_actor_spawns_ends_with_its_replica() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Busy), mechanism=PBR()))
        await ref.ask(Do("spawn"), timeout=60.0)
        os.kill(system.pid_of(system.ref("/app/one/ftm/r1", hf.Actor)), signal.SIGKILL)
        assert await ref.ask(Do("goes on"), timeout=60.0) == 1
        await ref.ask(Do("spawn"), timeout=60.0)  # The name is free: nobody has it there.


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_with_a_timer_among_its_key_variables_cannot_be_attached(isolation: Any) -> None:
    """The variable is named. With a leading underscore it is none."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Busy), isolation=isolation))
        await ref.ask(Do("set a timer"), timeout=60.0)
        with pytest.raises(hf.TransactionFailed, match=r"Busy\.timer: .*Timer cannot be saved; .* leading underscore"):
            await attach(system, ref)
        await ref.ask(Do("keep it aside"), timeout=60.0)
        await attach(system, ref)
        assert await ref.ask(Do("goes on"), timeout=60.0) == 1


def with_more(state: Any) -> Any:
    return {**state, "done": [*state["done"], "put there"]}


async def test_state_and_code_of_a_protected_actor_are_not_replaced() -> None:
    """Detach, replace, attach."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Keeper), mechanism=PBR()))
        await system.suspend(ref, timeout=60.0)
        for refused in (system.replace_state(ref, with_more), system.replace_code(ref, Busy)):
            with pytest.raises(hf.errors.ControlFailed, match=r"`protect` it by None first, and again after"):
                await refused
        await system.resume(ref, timeout=60.0)
        async with system.transaction(timeout=60.0) as change:
            change.protect(ref, None)
        await system.replace_state(ref, with_more, timeout=60.0)
        await attach(system, ref)
        assert await ref.ask(Do("goes on"), timeout=60.0) == 2


async def test_in_a_process_find_gives_a_ref_to_whatever_is_outside() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("one", hf.start(Busy), isolation="process"))
        assert await ref.ask(Do("find"), timeout=60.0) == 1
        task = await system.start(hf.child("two", hf.start(Busy)))
        with pytest.raises(hf.RemoteCrash, match="NoSuchActor"):
            await task.ask(Do("find"), timeout=60.0)


class Leaves(hf.Actor):
    """Takes its time to end, and says when it has."""

    def __init__(self, file: str) -> None:
        self.file = file

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(1.5)
        Path(self.file).touch()


class Named(hf.Supervisor):
    """Names its child itself: the root hears of it, and not of how long it may take."""

    def __init__(self, file: str) -> None:
        self._file = file

    def init(self) -> hf.Plan:
        return hf.Plan.of(hf.supervision.Flags(), [hf.child("leaves", hf.start(Leaves, self._file), shutdown=60.0)])


@pytest.mark.parametrize("shutdown", ["infinity", 60.0])
async def test_how_long_unknown_children_of_a_supervisor_elsewhere_may_take_is_guessed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shutdown: Any
) -> None:
    """As if each had the usual five seconds, which are none here; what its own spec says is kept."""
    for name in ("SLACK", "GRACE"):
        monkeypatch.setattr(patience, name, 0.1)
    monkeypatch.setattr(lifecycle, "PATIENCE", 0.1)
    file = tmp_path / "left"
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("top", hf.start(Named, str(file)), isolation="process", shutdown=shutdown)
        top = await system.start(spec)
        with system.events() as events:
            await system.stop(top)
            overdue = [one for one in events.take() if isinstance(one, hf.events.StopOverdue)]
    assert (bool(overdue), file.exists()) == ((True, False) if shutdown == "infinity" else (False, True))


class Backtracks(hf.Actor):
    """Its first start is in C code that does not let go of the interpreter."""

    def __init__(self, file: str) -> None:
        if not Path(file).exists():
            Path(file).touch()
            re.match("(a+)+$", "a" * 64 + "b")

    @hf.on(Do)
    def do(self, message: Do) -> int:
        return 1


async def test_c_code_that_keeps_the_interpreter_in_a_start_is_ended_by_hung_after(tmp_path: Path) -> None:
    """Its `start_timeout` alone does nothing: no thread of that process can look."""
    child = hf.child("slow", hf.start(Backtracks, str(tmp_path / "begun")), start_timeout=0.1)
    limits = hf.Limits(hung_after=0.5)
    async with hf.ActorSystem("app", log=False, intensity=10) as system:
        with system.events() as events:
            with contextlib.suppress(hf.StartFailed):
                await system.start(hf.supervisor("top", children=[child], isolation="process", limits=limits))
            reasons = [one.reason for one in events.take() if isinstance(one, hf.events.ProcessDied)]
        assert [type(one) for one in reasons] == [hf.Hung]


ASKS = """
import asyncio, os, sys, holdfast as hf

class Ask(hf.Message[str]): ...
class Get(hf.Message[list[str]]): ...

class Silent(hf.Actor):
    @hf.on(Ask)
    async def ask(self, message: Ask) -> str:
        if sys.argv[2] == "kill":
            os.kill(os.getpid(), 9)
        return "an answer"

class Asker(hf.Actor):
    def __init__(self) -> None:
        self.got: list[str] = []

    @hf.on(Ask)
    async def ask(self, message: Ask) -> str:
        try:
            self.got.append(await self.ctx.find("/app/silent", Silent).ask(Ask(), timeout=60.0))
        except hf.AskTimeout as error:
            self.got.append(f"no answer {error.handled}")
        return ""

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[str]:
        return self.got

async def main() -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{sys.argv[1]}", log=False) as system:
        await system.start(hf.child("silent", hf.start(Silent)))
        asker = await system.start(hf.child("asker", hf.start(Asker), recovery=hf.hybrid()))
        if sys.argv[2] == "kill":
            await asker.ask(Ask(), timeout=60.0)
        print(await asker.ask(Get(), timeout=60.0))

asyncio.run(main())
"""


def test_what_a_turn_had_asked_of_an_actor_without_recovery_when_the_root_died_has_no_answer(tmp_path: Path) -> None:
    """Whether it was handled is not known, and it is not asked again."""
    for what, code, out in (("kill", -9, ""), ("end", 0, "['no answer None']\n")):
        command = [sys.executable, "-c", ASKS, str(tmp_path / "app.db"), what]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (code, out), done.stderr
