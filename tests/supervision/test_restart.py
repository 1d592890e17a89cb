"""Restarts: what becomes of messages, of starts that fail, and of supervisors that have enough (otp.md 1.5, 1.6)."""

import asyncio
import contextvars
from collections.abc import Callable
from typing import Any, Literal

import pytest

import holdfast as hf
from holdfast.actors.events import ChildRestarted, SupervisorGaveUp
from holdfast.supervision.admin import ChildBusy, DeleteChild, RestartChild, TerminateChild, WhichChildren

virtual = pytest.mark.asyncio(loop_factories=["virtual"])
Where = Literal["__init__", "on_start", "async on_start"]


class Boom(hf.Message[None]): ...


class Note(hf.Message[int]):
    """The reply is the number of the life that handled it."""

    number: int = 0


class Plan:
    """What the starts of an actor shall do; the actor that reads it is given it as an argument."""

    def __init__(self, where: Where = "__init__") -> None:
        self.where: Where = where
        self.failures = 0
        self.starts = 0
        self.notes: list[int] = []
        self.before_failure: Callable[[], None] = lambda: None

    def attempt(self, here: Where) -> None:
        if here == self.where:
            self.starts += 1
            if self.failures:
                self.failures -= 1
                self.before_failure()
                raise OSError("the device is not there yet")


class Fragile(hf.Actor):
    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        plan.attempt("__init__")

    async def on_start(self, restored: bool) -> None:
        self.plan.attempt("on_start")
        await asyncio.sleep(0)
        self.plan.attempt("async on_start")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.plan.notes.append(message.number)
        return self.ctx.life


def fragile(plan: Plan, id: str = "fragile", **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Fragile, plan), **options)


async def states(system: hf.ActorSystem, path: str = "/app/top") -> dict[str, str]:
    return {info.id: info.state for info in await system.ref(path, hf.Supervisor).ask(WhichChildren())}


# -- messages -------------------------------------------------------------------------------------------------------


async def test_the_queue_outlives_the_crash_and_the_message_in_hand_is_not_run_again() -> None:
    """DESIGN 4, T14, T20: nothing queued is lost, each ask has its outcome."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(fragile(plan))
        ref = system.ref("/app/fragile", Fragile)
        before = ref.ask(Note(1))
        crash = ref.ask(Boom())
        ref.tell(Note(2))
        asked = [ref.ask(Note(number)) for number in (3, 4)]
        assert await before == 1
        with pytest.raises(hf.RemoteCrash, match="ValueError: boom") as caught:
            await crash
        assert [await reply for reply in asked] == [2, 2]
        assert plan.notes == [1, 2, 3, 4]
        assert plan.starts == 2
        assert 'raise ValueError("boom")' in caught.value.traceback


async def test_messages_sent_between_two_lives_wait_for_the_next() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.supervisor("top", intensity=9, children=[fragile(plan)]))
        ref = system.ref("/app/top/fragile", Fragile)
        plan.failures = 3
        ref.tell(Boom())
        reply = ref.ask(Note(7))
        assert await reply == 5  # three attempts failed, each was a life
        assert plan.notes == [7]


async def test_a_killed_child_comes_back_with_its_queue() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(fragile(plan))
        ref = system.ref("/app/fragile", Fragile)
        replies = [ref.ask(Note(number)) for number in range(3)]
        ref.kill()
        assert await asyncio.gather(*replies) == [2, 2, 2]
        assert plan.notes == [0, 1, 2]


async def test_refs_stay_good_over_restarts_of_the_supervisor_too() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.supervisor("top", intensity=0, children=[fragile(plan)]))
        ref = system.ref("/app/top/fragile", Fragile)
        ref.tell(Boom())
        await system._node.settled()
        while plan.starts < 2:
            await system._node.settled()
        assert await ref.ask(Note(1)) == 1  # a new child of a new supervisor, at the same address


# -- starts that fail -----------------------------------------------------------------------------------------------

EVERYWHERE = pytest.mark.parametrize("where", ["__init__", "on_start", "async on_start"])


@EVERYWHERE
async def test_a_failing_first_start_is_the_callers_error(where: Where) -> None:
    plan = Plan(where)
    plan.failures = 1
    async with hf.ActorSystem(log=False) as system:
        with pytest.raises(hf.StartFailed, match="/app/fragile could not be started: OSError: the device is not there"):
            await system.start(fragile(plan))
        assert system.tree() == ["/app"]
        await system.start(fragile(plan))  # The address is free again.
        assert await system.ref("/app/fragile", Fragile).ask(Note()) == 1
        assert plan.starts == 2


@EVERYWHERE
async def test_a_failing_child_rolls_the_whole_start_back(where: Where) -> None:
    """otp.md 1.2: the earlier ones are stopped, and the supervisor is not there."""
    good, bad, late = Plan(where), Plan(where), Plan(where)
    bad.failures = 1
    async with hf.ActorSystem(log=False) as system:
        children = [fragile(good, "good"), fragile(bad, "bad"), fragile(late, "late")]
        with pytest.raises(hf.StartFailed, match=r"/app/top could not be started: .*/app/top/bad could not be started"):
            await system.start(hf.supervisor("top", children=children))
        assert (good.starts, bad.starts, late.starts) == (1, 1, 0)
        assert system.tree() == ["/app"]


@EVERYWHERE
async def test_a_failing_restart_is_tried_again_until_it_succeeds(where: Where) -> None:
    """otp.md 1.5: with intensity 3 a child that fails twice and then succeeds survives."""
    plan = Plan(where)
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.supervisor("top", intensity=3, children=[fragile(plan)]))
        ref = system.ref("/app/top/fragile", Fragile)
        plan.failures = 2
        with system.events() as events:
            ref.tell(Boom())
            assert await ref.ask(Note()) == 4
            counted = [event.attempt for event in events.take() if isinstance(event, ChildRestarted)]
        assert counted == [1, 2, 3]
        assert plan.starts == 4
        assert await states(system) == {"fragile": "running"}


@EVERYWHERE
async def test_every_attempt_counts_and_endless_failure_ends(where: Where) -> None:
    """otp.md 1.5: with intensity 2 and endless failure exactly 2 attempts are made."""
    plan = Plan(where)
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            top = await system.start(hf.supervisor("top", intensity=2, restart="temporary", children=[fragile(plan)]))
            ref = system.ref("/app/top/fragile", Fragile)
            plan.failures = 100
            ref.tell(Boom())
            with pytest.raises(hf.ActorStopped):
                await ref.ask(Note())
            assert [event.address for event in events.take() if isinstance(event, SupervisorGaveUp)] == ["/app/top"]
        assert plan.starts == 1 + 2
        await system._node.settled()
        assert top.path not in system.tree()


async def test_the_supervisor_answers_between_two_attempts() -> None:
    """otp.md 1.5: the retry goes through its own mailbox."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", intensity=100, children=[fragile(plan)]))
        outside, asked = contextvars.copy_context(), list[asyncio.Future[list[hf.supervision.ChildInfo]]]()
        plan.before_failure = lambda: asked.append(outside.run(top.ask, WhichChildren()))
        plan.failures = 3
        system.ref("/app/top/fragile", Fragile).tell(Boom())
        await system._node.settled()
        assert [[info.state for info in await answer] for answer in asked] == [["restarting"]] * 3
        assert await states(system) == {"fragile": "running"}


async def test_one_for_all_starts_everything_again_after_a_failed_attempt() -> None:
    """otp.md 1.5: those just started stay up until the retry, which stops them and starts from the first."""
    plans = {name: Plan() for name in "abc"}
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        children = [hf.child(name, hf.start(Telling, plan, log)) for name, plan in plans.items()]
        await system.start(hf.supervisor("top", strategy="one_for_all", intensity=9, children=children))
        log.clear()
        plans["b"].failures = 1
        system.ref("/app/top/a", Telling).tell(Boom())
        await system._node.settled()
        assert " ".join(log) == "-a -c -b +a -a +a +b +c"
        assert await states(system) == dict.fromkeys("abc", "running")


async def test_rest_for_one_goes_on_at_the_child_that_failed() -> None:
    """otp.md 1.5: those already started before it are kept."""
    plans = {name: Plan() for name in "abc"}
    log: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        children = [hf.child(name, hf.start(Telling, plan, log)) for name, plan in plans.items()]
        await system.start(hf.supervisor("top", strategy="rest_for_one", intensity=9, children=children))
        log.clear()
        plans["b"].failures = 1
        system.ref("/app/top/a", Telling).tell(Boom())
        await system._node.settled()
        assert " ".join(log) == "-a -c -b +a +b +c"


class Telling(hf.Actor):
    """Logs the starts that succeed, and the stops."""

    def __init__(self, plan: Plan, log: list[str]) -> None:
        plan.attempt("__init__")
        self.name, self.log = self.ctx.path.rpartition("/")[2], log
        log.append(f"+{self.name}")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.log.append(f"-{self.name}")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


class Stuck(hf.Actor):
    """Starts only when it is let."""

    def __init__(self, gate: asyncio.Event) -> None:
        self.gate = gate

    async def on_start(self, restored: bool) -> None:
        await self.gate.wait()

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Note)
    def note(self, message: Note) -> int:
        return self.ctx.life


async def test_a_child_killed_while_it_starts_does_not_hold_its_supervisor() -> None:
    async with hf.ActorSystem(log=False) as system:
        starting = asyncio.ensure_future(system.start(hf.child("stuck", hf.start(Stuck, asyncio.Event()))))
        while "/app/stuck" not in system.tree():
            await asyncio.sleep(0)
        system.ref("/app/stuck", Stuck).kill()
        with pytest.raises(hf.StartFailed, match="/app/stuck could not be started: killed"):
            await starting
        assert system.tree() == ["/app"]


async def test_a_child_killed_while_it_restarts_is_restarted_and_each_counts_once() -> None:
    gate = asyncio.Event()
    gate.set()
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", intensity=2, children=[hf.child("stuck", hf.start(Stuck, gate))]))
        ref = system.ref("/app/top/stuck", Stuck)
        gate.clear()
        with system.events() as events:
            ref.tell(Boom())
            while await state_of(top) != "restarting":
                pass
            ref.kill()
            gate.set()
            assert await ref.ask(Note()) == 3
            assert [event.attempt for event in events.take() if isinstance(event, ChildRestarted)] == [1, 2]


async def state_of(top: hf.ActorRef[hf.Supervisor]) -> str:
    (info,) = await top.ask(WhichChildren())
    return info.state


async def test_the_supervisor_answers_while_a_child_takes_its_time_to_restart() -> None:
    """DESIGN 5: restores run outside the supervisor's turn; terminate_child ends them."""
    gate = asyncio.Event()
    gate.set()
    async with hf.ActorSystem(log=False) as system:
        child = hf.child("stuck", hf.start(Stuck, gate), shutdown="brutal_kill")
        top = await system.start(hf.supervisor("top", children=[child]))
        gate.clear()
        system.ref("/app/top/stuck", Stuck).tell(Boom())
        while await state_of(top) != "restarting":
            pass
        with pytest.raises(ChildBusy):
            await top.ask(RestartChild("stuck"))
        await top.ask(TerminateChild("stuck"))
        assert await state_of(top) == "stopped"
        gate.set()
        again = await top.ask(RestartChild("stuck"))
        assert await again.ask(Note()) == 1
        assert await state_of(top) == "running"


async def test_a_child_that_crashes_right_after_its_restart_is_restarted_again() -> None:
    """Its start and its end may both wait in the supervisor's mailbox; neither is taken for the other."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.supervisor("top", intensity=5, children=[fragile(plan)]))
        ref = system.ref("/app/top/fragile", Fragile)
        for _ in range(5):
            ref.tell(Boom())
        assert await ref.ask(Note()) == 6
        assert plan.starts == 6


# -- enough ---------------------------------------------------------------------------------------------------------


def nest(plan: Plan, restart: Any) -> hf.ChildSpec:
    inner = hf.supervisor("inner", intensity=0, restart=restart, children=[fragile(plan)])
    return hf.supervisor("outer", intensity=5, children=[inner])


@pytest.mark.parametrize(("restart", "state"), [("permanent", "running"), ("transient", "stopped")])
async def test_giving_up_is_a_clean_end_so_only_permanent_escalates(restart: str, state: str) -> None:
    """otp.md 1.6: the supervisor that gives up ends with a Shutdown."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(nest(plan, restart))
        watcher = system.spawn(hf.start(Watcher, system.ref("/app/outer/inner", hf.Supervisor)))
        system.ref("/app/outer/inner/fragile", Fragile).tell(Boom())
        why = "restart intensity reached; the last to end was /app/outer/inner/fragile: ValueError: boom"
        assert await watcher.ask(Down()) == f"shutdown ({why})"
        while (found := await states(system, "/app/outer")) == {"inner": "restarting"}:
            pass
        assert found == {"inner": state}
        assert plan.starts == (2 if state == "running" else 1)


class Down(hf.Message[str]):
    """The reply is the reason of the end that is waited for."""


class Watcher(hf.Actor):
    def __init__(self, other: hf.ActorRef[hf.Actor]) -> None:
        self.ctx.monitor(other)
        self.reason: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        self.reason.set_result(str(reason))

    @hf.on(Down)
    def down(self, message: Down) -> hf.ReplyHandle[str]:
        handle = self.ctx.reply_handle()
        self.reason.add_done_callback(lambda done: handle.reply(done.result()))
        return handle


async def test_the_product_of_the_intensities_is_what_the_root_bears() -> None:
    """otp.md 1.6, T29: two levels that allow one restart each bear three crashes; the fourth is too much."""
    plan = Plan()
    with pytest.raises(hf.TreeFailed):  # noqa: PT012 - the failure comes out of the whole block
        async with hf.ActorSystem(intensity=0, log=False) as system:
            inner = hf.supervisor("inner", intensity=1, children=[fragile(plan)])
            await system.start(hf.supervisor("outer", intensity=1, children=[inner]))
            ref = system.ref("/app/outer/inner/fragile", Fragile)
            for crashes in range(1, 4):
                ref.tell(Boom())
                while plan.starts == crashes:
                    await system._node.settled()
                assert await ref.ask(Note()) in (1, 2)
            ref.tell(Boom())
            await asyncio.Event().wait()
    assert plan.starts == 4


# -- retries that no longer count -----------------------------------------------------------------------------------


@virtual
async def test_a_retry_is_void_after_terminate_child() -> None:
    plan = Plan()
    slow = hf.Backoff(initial=10.0, maximum=10.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[fragile(plan, backoff=slow)]))
        system.ref("/app/top/fragile", Fragile).tell(Boom())
        await system._node.settled()
        assert await states(system) == {"fragile": "restarting"}
        await top.ask(TerminateChild("fragile"))
        assert await states(system) == {"fragile": "stopped"}
        await asyncio.sleep(60)
        assert await states(system) == {"fragile": "stopped"}
        assert plan.starts == 1


@virtual
async def test_a_stale_retry_does_not_restart_the_child_that_was_started_since() -> None:
    plan = Plan()
    slow = hf.Backoff(initial=10.0, maximum=10.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", intensity=5, children=[fragile(plan, backoff=slow)]))
        ref = system.ref("/app/top/fragile", Fragile)
        ref.tell(Boom())
        await asyncio.sleep(6)
        await top.ask(TerminateChild("fragile"))
        await top.ask(RestartChild("fragile"))
        ref.tell(Boom())  # Its own retry is due at 16 s, the stale one at 10 s.
        await asyncio.sleep(5)
        assert plan.starts == 2
        assert await ref.ask(Note(), timeout=30.0) == 2
        assert asyncio.get_running_loop().time() == 16.0
        assert plan.starts == 3


@virtual
async def test_queued_asks_fail_when_the_child_they_wait_for_is_terminated() -> None:
    plan = Plan()
    slow = hf.Backoff(initial=10.0, maximum=10.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[fragile(plan, backoff=slow)]))
        ref = system.ref("/app/top/fragile", Fragile)
        ref.tell(Boom())
        waiting = ref.ask(Note(), timeout=60.0)
        await system._node.settled()
        await top.ask(TerminateChild("fragile"))
        with pytest.raises(hf.ActorStopped, match="the message was not handled"):
            await waiting
        await top.ask(DeleteChild("fragile"))
        assert asyncio.get_running_loop().time() == 0.0
