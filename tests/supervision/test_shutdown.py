"""How children are stopped: time, force, order, and what their hooks hear (otp.md 1.7). Time is virtual."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import HookFailed, LifeAbandoned
from holdfast.supervision.admin import StartChild, TerminateChild

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Boom(hf.Message): ...


class Work(hf.Message[str]):
    seconds: float = 0.0


class Quit(hf.Message):
    reason: hf.ExitReason


class Worker(hf.Actor):
    """Takes `seconds` for its good-bye, and logs its begin and its end with the reason."""

    def __init__(self, log: list[str], seconds: float = 0.0) -> None:
        self.name = self.ctx.path.rpartition("/")[2]
        self.log, self.seconds = log, seconds

    async def on_stop(self, reason: hf.ExitReason) -> None:
        self.log.append(f"{self.name} stops: {reason}")
        await asyncio.sleep(self.seconds)
        self.log.append(f"{self.name} has stopped")

    @hf.on(Work)
    async def work(self, message: Work) -> str:
        await asyncio.sleep(message.seconds)
        return "done"

    @hf.on(Quit)
    def quit(self, message: Quit) -> None:
        self.ctx.stop(message.reason)

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


def now() -> float:
    return asyncio.get_running_loop().time()


def worker(log: list[str], seconds: float = 0.0, id: str = "worker", **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Worker, log, seconds), **options)


async def stopped_at(spec: hf.ChildSpec) -> float:
    """Start it, stop it, and say when it was over."""
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(spec)
        await system.stop(ref)
        assert ref.path not in system.tree()
        return now()


async def test_a_child_that_stops_in_time_is_not_killed() -> None:
    log: list[str] = []
    assert await stopped_at(worker(log, 3.0, shutdown=5.0)) == 3.0
    assert log == ["worker stops: shutdown", "worker has stopped"]


async def test_a_child_that_takes_too_long_is_killed() -> None:
    log: list[str] = []
    assert await stopped_at(worker(log, 10.0, shutdown=2.0)) == 2.0
    assert log == ["worker stops: shutdown"]


async def test_shutdown_zero_gives_no_time_to_wait() -> None:
    log: list[str] = []
    assert await stopped_at(worker(log, 10.0, shutdown=0)) == 0.0
    assert "worker has stopped" not in log


async def test_brutal_kill_runs_no_hook() -> None:
    log: list[str] = []
    assert await stopped_at(worker(log, shutdown="brutal_kill")) == 0.0
    assert log == []


async def test_infinity_waits_as_long_as_it_takes() -> None:
    log: list[str] = []
    assert await stopped_at(worker(log, 86_400.0, shutdown="infinity")) == 86_400.0
    assert log[-1] == "worker has stopped"


async def test_a_busy_child_ends_its_turn_first() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(worker(log, shutdown=5.0))
        reply = ref.ask(Work(3.0))
        await asyncio.sleep(1.0)
        await system.stop(ref)
        assert (now(), await reply, log[-1]) == (3.0, "done", "worker has stopped")


async def test_a_busy_child_is_killed_when_its_time_is_over_and_its_askers_hear_of_it() -> None:
    """DESIGN 4: the ask in hand fails with the exit reason, the queued ones were surely not run. T20."""
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(worker(log, shutdown=2.0))
        in_hand, queued = ref.ask(Work(100.0), timeout=60.0), ref.ask(Work(), timeout=60.0)
        await asyncio.sleep(1.0)
        await system.stop(ref)
        assert now() == 3.0
        with pytest.raises(hf.AskFailed, match="/app/worker ended while it handled the message: killed"):
            await in_hand
        with pytest.raises(hf.ActorStopped, match="the message was not handled"):
            await queued
        assert log == []
        assert now() == 3.0


class Stubborn(hf.Actor):
    """Goes on in spite of its cancellation, and then tries to send."""

    def __init__(self, log: list[str], other: hf.ActorRef[Worker]) -> None:
        self.log, self.other = log, other

    @hf.on(Work)
    async def work(self, message: Work) -> str:
        try:
            await asyncio.sleep(message.seconds)
        except asyncio.CancelledError:
            await asyncio.sleep(10.0)
            try:
                self.other.tell(Quit(hf.NORMAL))
            except hf.ActorStopped as error:
                self.log.append(str(error))
        return "in vain"


async def test_a_child_that_swallows_its_cancellation_is_abandoned() -> None:
    """T32: a task cannot be killed, but its life can be ended: what it still sends is refused."""
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        other = await system.start(worker(log, id="other"))
        with system.events() as events:
            ref = await system.start(hf.child("stubborn", hf.start(Stubborn, log, other), shutdown=2.0))
            reply = ref.ask(Work(100.0), timeout=60.0)
            await system.stop(ref)
            assert now() == 3.0  # two seconds for the stop, one for the kill
            assert [event.address for event in events.take() if isinstance(event, LifeAbandoned)] == ["/app/stubborn"]
        with pytest.raises(hf.AskFailed):
            await reply
        await asyncio.sleep(20.0)
        assert log == [
            "/app/stubborn has stopped (this life is over; its leftovers may not send); the message was not handled"
        ]
        assert "/app/other" in system.tree()


async def test_children_are_stopped_one_after_the_other_newest_first() -> None:
    """otp.md 1.7: strictly sequential, so the total time is the sum."""
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        children = [worker(log, seconds, name) for name, seconds in (("a", 1.0), ("b", 2.0), ("c", 3.0))]
        await system.start(hf.supervisor("top", children=children))
        await system.start(worker(log, 4.0, "late"))
    assert now() == 10.0
    stops = [line.partition(" ")[0] for line in log if line.endswith("has stopped")]
    assert stops == ["late", "c", "b", "a"]


async def test_a_child_started_later_is_stopped_first() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[worker(log, id="static")]))
        await top.ask(StartChild(worker(log, id="dynamic")))
        await system.stop(top)
    assert [line for line in log if line.endswith("has stopped")] == ["dynamic has stopped", "static has stopped"]


async def test_nested_supervisors_stop_from_the_leaves_up_in_reverse_order() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        left = hf.supervisor("left", children=[worker(log, id="a"), worker(log, id="b")])
        right = hf.supervisor("right", children=[worker(log, id="c"), worker(log, 30.0, id="d", shutdown=60.0)])
        await system.start(hf.supervisor("top", children=[left, worker(log, id="middle"), right]))
    assert [line.partition(" ")[0] for line in log[::2]] == ["d", "c", "middle", "b", "a"]
    assert now() == 30.0  # a supervisor has the time its children need


async def test_a_supervisor_that_is_killed_takes_its_children_with_it_without_hooks() -> None:
    """otp.md 1.7: no orderly stop; none of them outlives it."""
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        top = hf.supervisor("top", restart="temporary", children=[worker(log, id="a"), worker(log, id="b")])
        ref = await system.start(top)
        ref.kill()
        await system._node.settled()
        assert system.tree() == ["/app"]
    assert log == []


@pytest.mark.parametrize("reason", [hf.NORMAL, hf.SHUTDOWN, hf.Shutdown("work is done")], ids=str)
async def test_on_stop_hears_the_reason_an_actor_gave_itself(reason: hf.ExitReason) -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(worker(log, restart="temporary"))
        ref.tell(Quit(reason))
        await system._node.settled()
        assert log == [f"worker stops: {reason}", "worker has stopped"]


async def test_on_stop_hears_of_a_crash() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(worker(log, restart="temporary"))
        ref.tell(Boom())
        await system._node.settled()
        assert log == ["worker stops: ValueError: boom", "worker has stopped"]


async def test_the_next_life_begins_only_after_the_last_hook_of_the_one_before() -> None:
    """otp.md W2: teardown is over before the next start."""
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(worker(log, 7.0))
        ref.tell(Boom())
        assert await ref.ask(Work(), timeout=60.0) == "done"
        assert now() == 7.0
        assert log == ["worker stops: ValueError: boom", "worker has stopped"]


class Rude(hf.Actor):
    def __init__(self, log: list[str]) -> None:
        self.log = log

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.log.append("rude")
        raise RuntimeError("no good-bye")


async def test_a_hook_that_raises_does_not_disturb_the_sequence() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            children = [worker(log, id="a"), hf.child("rude", hf.start(Rude, log)), worker(log, id="c")]
            await system.stop(await system.start(hf.supervisor("top", children=children)))
            failed = [(event.address, event.hook) for event in events.take() if isinstance(event, HookFailed)]
    assert failed == [("/app/top/rude", "on_stop")]
    assert log == ["c stops: shutdown", "c has stopped", "rude", "a stops: shutdown", "a has stopped"]


async def test_a_child_that_dies_by_itself_while_another_is_stopped_is_no_trouble() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(
            hf.supervisor("top", intensity=0, children=[worker(log, id="a"), worker(log, 3.0, "b")])
        )
        stopping = asyncio.ensure_future(system.stop(top))
        await asyncio.sleep(1.0)
        system.ref("/app/top/a", Worker).kill()
        await stopping
        assert now() == 3.0
        assert system.tree() == ["/app"]
    assert log == ["b stops: shutdown", "b has stopped"]


async def test_terminate_child_waits_until_the_child_has_stopped() -> None:
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[worker(log, 3.0)]))
        await top.ask(TerminateChild("worker"))
        assert (now(), log[-1]) == (3.0, "worker has stopped")


@pytest.mark.parametrize("kind", ["one of a list", "dynamic"])
@pytest.mark.parametrize("who", ["crashed", "beside it"])
async def test_who_asks_below_a_supervisor_that_gives_up_is_told_why(kind: str, who: str) -> None:
    log: list[str] = []
    specs = [worker(log, id="crashed"), worker(log, id="beside it")]
    async with hf.ActorSystem("app", log=False, intensity=1) as system:
        if kind == "dynamic":
            team = await system.start(hf.dynamic("team", intensity=0))
            for one in specs:
                await team.ask(StartChild(one))
        else:
            team = await system.start(hf.supervisor("team", children=specs, intensity=0))
        crashed, asked = system.ref("/app/team/crashed", Worker), system.ref(f"/app/team/{who}", Worker)
        waits = [asked.ask(Work(3.0), timeout=60.0)] if who != "crashed" else []
        crashed.tell(Boom())
        waits.append(asked.ask(Work(), timeout=60.0))
        with pytest.raises(hf.ActorStopped, match=r"its parent has stopped: .*team/crashed: .*boom"):
            await waits[-1]
        await asyncio.gather(*waits, return_exceptions=True)
