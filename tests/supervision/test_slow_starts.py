"""Starts that take their time, or never end: the supervisor answers, and everything can be stopped."""

import asyncio
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import pytest

import holdfast as hf
from holdfast.actors.deadline_thread import BLOCKED
from holdfast.actors.events import LogLine
from holdfast.testing import idle
from tests.supervision.blockers import Blocker
from tests.supervision.family import Boom, refused

pytestmark = pytest.mark.usefixtures("warm_programs")

SECONDS = 60.0  # of real time, far more than any of it takes
virtual = pytest.mark.asyncio(loop_factories=["virtual"])


class Slow(hf.Actor):
    """Comes up when it is let, in its first life or in later ones."""

    def __init__(self, gate: asyncio.Event, log: list[str] | None = None, lives: tuple[int, ...] = (1,)) -> None:
        self.gate, self.log, self.lives = gate, log if log is not None else [], lives

    async def on_start(self, restored: bool) -> None:
        if self.ctx.life in self.lives:
            await self.gate.wait()
        self.log.append(f"+{self.ctx.path.rpartition('/')[2]}")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.log.append(f"-{self.ctx.path.rpartition('/')[2]}")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


class Hangs(hf.Actor):
    """Never comes up."""

    async def on_start(self, restored: bool) -> None:
        await asyncio.Event().wait()


class Swallows(hf.Actor):
    """Never comes up, and goes on in spite of its cancellation."""

    async def on_start(self, restored: bool) -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            await asyncio.Event().wait()


def slow(gate: asyncio.Event, id: str = "slow", log: list[str] | None = None, **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Slow, gate, log), **options)


async def states(system: hf.ActorSystem, path: str) -> dict[str, str]:
    return {one.id: one.state for one in await system.ref(path, hf.Supervisor).ask(hf.WhichChildren())}


async def begun(system: hf.ActorSystem, *paths: str) -> None:
    while not set(paths) <= set(system.tree()):
        await asyncio.sleep(0)


async def test_a_start_in_a_process_is_ended_by_a_kill_however_early_it_comes() -> None:
    async with hf.ActorSystem(log=False) as system:
        spec = hf.child("one", hf.start(Blocker, "nowhere"), isolation="process", restart="temporary")
        started = asyncio.ensure_future(system.start(spec))
        await begun(system, "/app/one")
        system.ref("/app/one", Blocker).kill()
        with pytest.raises(hf.StartFailed):
            await asyncio.wait_for(started, SECONDS)


# -- it answers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["StartChild", "RestartChild", "its own start", "system.start"])
async def test_a_supervisor_answers_while_a_child_starts(how: str) -> None:
    gate, free = asyncio.Event(), asyncio.Event()
    free.set()
    async with hf.ActorSystem(log=False) as system:
        start: asyncio.Future[Any]
        path = "/app" if how == "system.start" else "/app/top"
        if how == "its own start":
            start = asyncio.ensure_future(system.start(hf.supervisor("top", children=[slow(gate)])))
        else:
            top = await system.start(hf.supervisor("top", children=[]))
            if how == "system.start":
                start = asyncio.ensure_future(system.start(slow(gate)))
            elif how == "StartChild":
                start = top.ask(hf.StartChild(slow(gate)), SECONDS)
            else:
                await top.ask(hf.StartChild(slow(free)))
                await top.ask(hf.TerminateChild("slow"))
                free.clear()
                start = top.ask(hf.RestartChild("slow"), SECONDS)
                gate = free
        await begun(system, f"{path}/slow")
        assert (await states(system, path))["slow"] == "starting"
        above = system.ref(path, hf.Supervisor)
        other = await above.ask(hf.StartChild(hf.child("other", hf.start(hf.Actor))))
        assert other.path == f"{path}/other"
        assert isinstance(await refused(above.ask(hf.StartChild(slow(gate)))), hf.errors.AlreadyPresent)
        assert isinstance(await refused(above.ask(hf.RestartChild("slow"))), hf.errors.ChildBusy)
        assert not start.done()
        gate.set()
        assert (await start).path in (f"{path}/slow", "/app/top")
        assert (await states(system, path))["slow"] == "running"


async def test_a_supervisor_is_up_when_all_its_children_are() -> None:
    gates = {name: asyncio.Event() for name in "abc"}
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        children = [slow(gate, name, log) for name, gate in gates.items()]
        start = asyncio.ensure_future(system.start(hf.supervisor("top", children=children)))
        for name in "cba":  # Each waits for those before it, whenever it could.
            gates[name].set()
            await begun(system, "/app/top/a")
            assert not start.done() or name == "a"
        await start
        assert log == ["+a", "+b", "+c"]


@virtual
@pytest.mark.parametrize("how", ["StartChild", "its own start"])
async def test_a_supervisor_escalates_while_a_child_starts(how: str) -> None:
    """Whoever waits for the start hears of it, and the child that was starting is over."""
    gate = asyncio.Event()
    free = asyncio.Event()
    free.set()
    async with hf.ActorSystem(log=False, intensity=9) as system:
        first = slow(free, "first")
        start: asyncio.Future[Any]
        if how == "StartChild":
            top = await system.start(hf.supervisor("top", children=[first], intensity=0))
            start = top.ask(hf.StartChild(slow(gate)), SECONDS)
        else:
            spec = hf.supervisor("top", children=[first, slow(gate)], intensity=0)
            start = asyncio.ensure_future(system.start(spec))
        await begun(system, "/app/top/slow")
        with system.events() as events:
            system.ref("/app/top/first", hf.Actor).kill()
            error = await refused(start)
            gave_up = [one for one in events.take() if isinstance(one, hf.events.SupervisorGaveUp)]
        assert isinstance(error, hf.AskFailed if how == "StartChild" else hf.StartFailed)
        assert [one.address for one in gave_up] == ["/app/top"]
        if how == "StartChild":
            async with asyncio.timeout(SECONDS):
                while (await states(system, "/app")).get("top") != "running":
                    await asyncio.sleep(0)
            assert await states(system, "/app/top") == {"first": "running"}
        assert "/app/top/slow" not in system.tree()


@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
async def test_a_sibling_that_crashes_meanwhile_is_restarted(strategy: Any) -> None:
    """With a group strategy when the start is over: the group has to be complete."""
    gate, log = asyncio.Event(), list[str]()
    free = asyncio.Event()
    free.set()
    async with hf.ActorSystem(log=False) as system:
        children = [slow(free, "a", log), slow(gate, "b", log)]
        start = asyncio.ensure_future(system.start(hf.supervisor("top", strategy=strategy, children=children)))
        await begun(system, "/app/top/b")
        system.ref("/app/top/a", Slow).tell(Boom())
        while (await states(system, "/app/top"))["a"] == "running" and strategy == "one_for_one" and len(log) < 3:
            pass
        gate.set()
        await start
        await idle(system)
        assert await states(system, "/app/top") == {"a": "running", "b": "running"}
        assert log.count("+a") == 2
        assert log.count("+b") == (1 if strategy == "one_for_one" else 2)


# -- it can be stopped ----------------------------------------------------------------------------------------------


@pytest.mark.pairs
@pytest.mark.parametrize("kind", [Hangs, Swallows])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("what", ["the child", "its supervisor", "the system"])
async def test_what_hangs_in_its_start_can_be_stopped(
    kind: type[hf.Actor], isolation: Literal["task", "process"], what: str
) -> None:
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[]))
        spec = hf.child("hangs", hf.start(kind), isolation=isolation, shutdown=0.05)
        start = top.ask(hf.StartChild(spec), SECONDS)
        await begun(system, "/app/top/hangs")
        if what == "the child":
            await top.ask(hf.TerminateChild("hangs"), SECONDS)
            assert await states(system, "/app/top") == {"hangs": "stopped"}
        elif what == "its supervisor":
            await system.stop(top)
        else:
            await system.shutdown()
        assert isinstance(await refused(start), hf.StartFailed if what == "the child" else hf.AskFailed)


@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_supervisor_that_starts_is_stopped_in_good_order(place: Any, tmp_path: Path) -> None:
    async with hf.ActorSystem(log=False) as system:
        inner = hf.supervisor(
            "inner",
            isolation=place,
            children=[
                hf.child("up", hf.start(Notes, str(tmp_path / "stopped"))),
                hf.child("hangs", hf.start(Hangs), shutdown=0.05),
            ],
        )
        start = asyncio.ensure_future(system.start(inner))
        await begun(system, "/app/inner/up")
        await system.ref("/app", hf.Supervisor).ask(hf.TerminateChild("inner"), SECONDS)
        assert isinstance(await refused(start), hf.StartFailed)
        assert (tmp_path / "stopped").exists()


class Notes(hf.Actor):
    def __init__(self, path: str) -> None:
        self.path = path

    def on_stop(self, reason: hf.ExitReason) -> None:
        Path(self.path).touch()


PROGRAM = """
import asyncio
import holdfast as hf

class Hangs(hf.Actor):
    async def on_start(self, restored):
        print("starting", flush=True)
        await asyncio.Event().wait()

    async def on_stop(self, reason):
        print("never", flush=True)

class Kid(hf.Actor):
    async def on_stop(self, reason):
        await asyncio.sleep(0.01)
        print("stopped in good order", flush=True)

async def main():
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("kid", hf.start(Kid)))
        await system.start(hf.child("hangs", hf.start(Hangs), shutdown=SHUTDOWN, start_timeout="infinity"))

if __name__ == "__main__":
    hf.run(main())
"""


@pytest.mark.parametrize(("shutdown", "signals"), [("0.05", 1), ("'infinity'", 2)])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_program_whose_actor_hangs_in_its_start(
    number: signal.Signals, shutdown: str, signals: int, tmp_path: Path
) -> None:
    """The first one stops all in good order; the second one does not wait for what is not even there yet."""
    script = tmp_path / "program.py"
    script.write_text(PROGRAM.replace("SHUTDOWN", shutdown), "utf-8")
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "starting\n"
            program.send_signal(number)
            if signals == 2:
                with pytest.raises(subprocess.TimeoutExpired):
                    program.wait(0.5)  # "infinity", on a leaf, waits: it is what was asked for.
                program.send_signal(number)
            output, _ = program.communicate(timeout=SECONDS)
        finally:
            program.kill()
    assert output == "stopped in good order\n"
    assert program.returncode in (143, -signal.SIGINT, 130)


# -- it has its time ------------------------------------------------------------------------------------------------


@virtual
@pytest.mark.parametrize("kind", [Hangs, Swallows])
async def test_a_start_that_takes_too_long_has_failed(kind: type[hf.Actor]) -> None:
    async with hf.ActorSystem(log=False) as system:
        before = asyncio.get_running_loop().time()
        with pytest.raises(hf.StartFailed, match=r"did not start within 60 s \(start_timeout\)"):
            await system.start(hf.child("a", hf.start(kind)))
        with pytest.raises(hf.StartFailed, match=r"within 2\.5 s"):
            await system.start(hf.child("b", hf.start(kind), start_timeout=2.5))
        assert asyncio.get_running_loop().time() - before == pytest.approx(62.5, abs=3.0)
        assert system.tree() == ["/app"]


@virtual
async def test_a_restart_that_takes_too_long_is_tried_again_and_counts() -> None:
    gate = asyncio.Event()
    async with hf.ActorSystem(log=False) as system:
        spec = hf.child("a", hf.start(Slow, gate, None, (2, 3)), start_timeout=10.0)
        await system.start(hf.supervisor("top", intensity=5, period=100.0, children=[spec]))
        with system.events() as events:
            system.ref("/app/top/a", Slow).tell(Boom())
            await asyncio.sleep(50.0)
            told = events.take()
        assert await states(system, "/app/top") == {"a": "running"}
        assert [event.attempt for event in told if isinstance(event, hf.events.ChildRestarted)] == [1, 2, 3]
        assert sum(isinstance(event, hf.events.ChildStartFailed) for event in told) == 2


@virtual
async def test_a_supervisor_may_take_as_long_as_its_children() -> None:
    gates = [asyncio.Event() for _ in range(3)]
    async with hf.ActorSystem(log=False) as system:
        children = [slow(gate, str(number)) for number, gate in enumerate(gates)]
        start = asyncio.ensure_future(system.start(hf.supervisor("top", children=children)))
        for gate in gates:
            await asyncio.sleep(50.0)
            gate.set()
        await start


@pytest.mark.parametrize("wrong", [0, -1.0, "never", True, float("inf")])
def test_a_limit_is_seconds_or_infinity(wrong: Any) -> None:
    with pytest.raises(hf.SpecError, match="start_timeout must be seconds > 0 or 'infinity'"):
        hf.child("a", hf.start(hf.Actor), start_timeout=wrong)


class Add(hf.Message[None]): ...


class Replays(hf.Actor):
    """Takes `seconds` to handle each message, in its second life too."""

    def __init__(self, seconds: float, hangs: bool = False) -> None:
        self.seconds, self.hangs = seconds, hangs

    @hf.on(Add)
    async def add(self, message: Add) -> None:
        if self.hangs and self.ctx.life == 2:
            await asyncio.Event().wait()
        await asyncio.sleep(self.seconds)

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


@virtual
@pytest.mark.parametrize("hangs", [False, True])
async def test_a_replay_is_limited_by_its_progress(hangs: bool) -> None:
    """Ten messages of 8 s each are handled again in a start that may take 20 s without one."""
    async with hf.ActorSystem(log=False) as system:
        spec = hf.child(
            "a", hf.start(Replays, 8.0, hangs), recovery=hf.replay_only(), start_timeout=20.0, shutdown="infinity"
        )
        ref = await system.start(hf.supervisor("top", intensity=9, period=1000.0, children=[spec]))
        actor = system.ref("/app/top/a", Replays)
        for _ in range(10):
            await actor.ask(Add(), SECONDS)
        with system.events() as events:
            actor.tell(Boom())
            while (await states(system, ref.path))["a"] == "running":
                await asyncio.sleep(0.1)
            while (await states(system, ref.path))["a"] != "running":
                await asyncio.sleep(0.1)
            failed = [event.reason for event in events.take() if isinstance(event, hf.events.ChildStartFailed)]
        assert failed == (["it came no step further within 20 s (start_timeout)"] if hangs else [])


@virtual
async def test_the_pauses_of_a_paced_replay_are_not_counted() -> None:
    async with hf.ActorSystem(log=False) as system:
        spec = hf.child("a", hf.start(Replays, 0.0), recovery=hf.replay_only(pacing="original"), start_timeout=20.0)
        await system.start(hf.supervisor("top", intensity=9, period=1000.0, children=[spec]))
        actor = system.ref("/app/top/a", Replays)
        for _ in range(3):
            await actor.ask(Add(), SECONDS)
            await asyncio.sleep(100.0)
        with system.events() as events:
            actor.tell(Boom())
            await asyncio.sleep(1000.0)
            told = events.take()
        assert await states(system, "/app/top") == {"a": "running"}
        assert not [event for event in told if isinstance(event, hf.events.ChildStartFailed)]


# -- it blocks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", ["__init__", "on_start", "on_stop"])
async def test_a_child_that_blocks_its_process_beyond_its_limit_ends_it(phase: str) -> None:
    """No timer comes there any more; the process says where it is blocked."""
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            top = await system.start(hf.supervisor("top", children=[], isolation="process"))
            spec = hf.child("blocks", hf.start(Blocker, phase), start_timeout=0.5, shutdown=0.5)
            order = top.ask(hf.StartChild(spec), SECONDS)
            if phase == "on_stop":
                await order
                order = top.ask(hf.TerminateChild("blocks"), SECONDS)
            assert str(BLOCKED) in str(await refused(order))
            await top.ask(hf.WhichChildren(), SECONDS)  # It is there again.
            told = "\n".join(event.text for event in events.take() if isinstance(event, LogLine))
        assert f"/app/top/blocks had 0.5 s to {'stop' if phase == 'on_stop' else 'start'}" in told
        assert "time.sleep" in told
