"""Children that do not end as they are told, ends that cross a shutdown, and ends of strangers (otp.md 1.3, 1.7)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.family import Boom, Family, Kid, Leave, Plan, kid

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Work(hf.Message):
    """Takes its time, and then ends as it says."""

    seconds: float = 0.0
    end: hf.ExitReason | None = None
    crash: bool = False


class Naughty(hf.Actor):
    def __init__(self, slow_stop: float = 0.0) -> None:
        self.slow_stop = slow_stop
        self.ctx.trap_exits = True

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        await asyncio.sleep(message.seconds)
        if message.end is not None:
            self.ctx.stop(message.end)
        if message.crash:
            raise ValueError("in the last moment")

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(self.slow_stop)


def naughty(id: str = "x", slow_stop: float = 0.0, **options: Any) -> hf.ChildSpec:
    return hf.child(id, hf.start(Naughty, slow_stop), **options)


async def shutdown_errors(spec: hf.ChildSpec, work: Work, *, by: str = "call") -> list[str]:
    """What is reported when a busy child is stopped: by TerminateChild, or because its supervisor ends."""
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[spec], restart="temporary"))
        system.ref("/app/top/x", Naughty).tell(work)
        await asyncio.sleep(1.0)
        with system.events() as events:
            if by == "call":
                await top.ask(hf.TerminateChild("x"), timeout=1000.0)
            else:
                await system.stop(top)
            return [str(event.reason) for event in events.take() if isinstance(event, hf.events.ShutdownError)]


BY = pytest.mark.parametrize("by", ["call", "end"])


@BY
async def test_a_good_end_is_not_reported(by: str) -> None:
    assert await shutdown_errors(naughty(), Work(), by=by) == []
    assert await shutdown_errors(naughty(shutdown="infinity"), Work(500.0), by=by) == []
    assert await shutdown_errors(naughty(shutdown="brutal_kill"), Work(500.0), by=by) == []


@BY
async def test_a_child_that_refuses_to_end_is_killed_and_reported(by: str) -> None:
    assert await shutdown_errors(naughty(shutdown=2.0), Work(100.0), by=by) == ["killed"]
    assert await shutdown_errors(naughty("x", 100.0, shutdown=2.0), Work(), by=by) == ["killed"]


@BY
async def test_a_child_that_crashes_while_it_is_told_to_stop_is_reported(by: str) -> None:
    errors = await shutdown_errors(naughty(shutdown=5.0), Work(2.0, crash=True), by=by)
    assert errors == ["ValueError: in the last moment"]


@pytest.mark.parametrize(
    ("restart", "end", "reported"),
    [
        ("permanent", hf.NORMAL, ["normal"]),
        ("permanent", hf.Shutdown("mine"), ["shutdown (mine)"]),
        ("transient", hf.NORMAL, []),
        ("transient", hf.Shutdown("mine"), []),
        ("temporary", hf.NORMAL, []),
        ("temporary", hf.Signal(9), ["SIGKILL"]),
    ],
)
async def test_another_clean_reason_is_reported_of_permanent_children_only(
    restart: Any, end: hf.ExitReason, reported: list[str]
) -> None:
    """OTP's do_terminate. The child, in its last turn, chooses its reason before the order reaches it."""
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[naughty("x", 10.0, restart=restart, shutdown=50.0)]))
        system.ref("/app/top/x", Naughty).tell(Work(0.0, end))
        await asyncio.sleep(1.0)  # It is on its way out: its `on_stop` takes ten seconds.
        with system.events() as events:
            await top.ask(hf.TerminateChild("x"), timeout=100.0)
            told = [str(event.reason) for event in events.take() if isinstance(event, hf.events.ShutdownError)]
        assert told == reported


async def test_one_naughty_child_does_not_disturb_the_order_of_the_others() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await Family.start(system, plan, kid(plan, "a"), naughty("n", 100.0, shutdown=3.0), kid(plan, "b"))
        await system.stop(system.ref("/app/top", hf.Supervisor))
        assert (plan.take(), asyncio.get_running_loop().time()) == ("-b -a", 3.0)


async def test_the_times_of_children_add_up() -> None:
    """otp.md 1.7: strictly one after another; only dynamic supervisors stop in parallel."""
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.supervisor("top", children=[naughty(name, 2.0) for name in "abc"]))
        await system.stop(top)
        assert asyncio.get_running_loop().time() == 6.0


async def test_a_child_that_dies_while_a_sibling_is_being_stopped_is_no_trouble() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a"), naughty("n", 10.0, shutdown="infinity"))
        with system.events() as events:
            stopping = asyncio.ensure_future(system.stop(family.top))
            await asyncio.sleep(1.0)
            family.ref("a").tell(Boom())
            await stopping
            told = events.take()
        assert not [event for event in told if isinstance(event, (hf.events.ChildRestarted, hf.events.ShutdownError))]
        assert system.tree() == ["/app"]


async def test_an_end_that_waits_in_the_queue_when_the_child_is_terminated_is_no_restart() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a"), intensity=0)
        family.ref("a").kill()
        await family.top.ask(hf.TerminateChild("a"))
        await family.rest()
        assert await family.states() == {"a": "stopped"}


# -- in which order -------------------------------------------------------------------------------------------------


async def test_the_stop_order_is_that_of_the_specs_not_of_the_lives() -> None:
    """otp.md 1.7: reverse start order, also when a child was stopped and started again by hand meanwhile."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, *(kid(plan, name) for name in "abc"))
        await family.top.ask(hf.TerminateChild("a"))
        await family.top.ask(hf.RestartChild("a"))
        plan.take()
        await system.stop(family.top)
        assert plan.take() == "-c -b -a"


async def test_a_failing_start_rolls_back_in_reverse_with_each_childs_own_shutdown() -> None:
    plan = Plan()
    plan.todo["d"] = ["fail"]
    async with hf.ActorSystem(log=False) as system:
        children = [kid(plan, "a"), kid(plan, "b", shutdown="brutal_kill"), kid(plan, "c"), kid(plan, "d")]
        with system.events() as events, pytest.raises(hf.StartFailed, match="/app/top/d could not be started"):
            await system.start(hf.supervisor("top", children=children))
        assert plan.take() == "+a +b +c !d -c -a"
        failed = [
            (event.address, event.reason) for event in events.take() if isinstance(event, hf.events.ChildStartFailed)
        ]
        assert failed[0] == ("/app/top/d", "OSError: not there yet")


# -- strangers and parents ------------------------------------------------------------------------------------------


class Stranger(hf.Actor):
    """Linked to a supervisor that is none of its business; or the parent of one."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan

    @hf.on(Work)
    def work(self, message: Work) -> None:
        inner = hf.supervisor("inner", children=[kid(self.plan, "a"), kid(self.plan, "b")])
        self.ctx.spawn(inner.start, "inner")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.link(self.ctx.find("/app/top", hf.Supervisor))
        self.ctx.stop(message.why)


@pytest.mark.parametrize("reason", [hf.SHUTDOWN, hf.NORMAL, hf.Signal(9), hf.KILLED])
async def test_the_end_of_a_linked_stranger_is_no_order(reason: hf.ExitReason) -> None:
    """otp.md 1.3: a supervisor ignores every EXIT but its parent's."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a"), intensity=0)
        system.spawn(hf.start(Stranger, plan)).tell(Leave(reason))
        assert await family.rest() == ""
        assert await family.states() == {"a": "running"}


@pytest.mark.parametrize("message", [Boom(), Leave()], ids=["crash", "stop"])
async def test_a_supervisor_ends_with_its_parent(message: hf.Message[Any]) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.supervisor("top"))
        parent = system.spawn(hf.start(Stranger, plan), "parent")
        parent.tell(Work())
        await system._node.settled()
        assert plan.take() == "+a +b"
        if isinstance(message, Leave):
            parent.tell(message)
        else:
            parent.stop()
        for _ in range(10):
            await system._node.settled()
        assert plan.take() == "-b -a"
        assert system.tree() == ["/app", "/app/top"]


async def test_a_killed_supervisor_takes_its_children_with_it() -> None:
    """Where OTP leaves that to the children's links: no hook runs, nothing is orphaned."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a"), kid(plan, "b"), restart="temporary")
        family.top.kill()
        assert await family.rest() == ""
        assert system.tree() == ["/app"]


# -- reports --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("restart", ["permanent", "transient", "temporary"])
@pytest.mark.parametrize("reason", [hf.NORMAL, hf.SHUTDOWN, hf.Shutdown("x"), hf.Signal(9)])
async def test_which_ends_are_reported(restart: Any, reason: hf.ExitReason) -> None:
    """otp.md 1.3: every end of a permanent child, abnormal ends of the others."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a", restart=restart))
        with system.events() as events:
            await family.after("a", Leave(reason))
            told = [event.reason for event in events.take() if isinstance(event, hf.events.ChildTerminated)]
        assert told == ([reason] if restart == "permanent" or not reason.is_clean else [])


@pytest.mark.parametrize("restart", ["permanent", "transient", "temporary"])
@pytest.mark.parametrize("above", [hf.supervisor, hf.dynamic])
async def test_an_end_is_told_that_comes_while_its_supervisor_stops(restart: Any, above: Any) -> None:
    """It stops a sibling meanwhile, or is told to stop at the same moment."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(above("top"))
        for spec in (kid(plan, "a", restart=restart), naughty("n", 10.0, shutdown="infinity")):
            await top.ask(hf.StartChild(spec))
        with system.events() as events:
            if above is hf.dynamic:
                system.ref("/app/top/a", Kid).kill()
                await system.stop(top)
            else:
                stopping = asyncio.ensure_future(system.stop(top))
                await asyncio.sleep(1.0)
                system.ref("/app/top/a", Kid).kill()
                await stopping
            told = [event for event in events.take() if isinstance(event, hf.events.ChildTerminated)]
        assert [(event.address, event.reason) for event in told] == [("/app/top/a", hf.KILLED)]


async def test_so_is_one_that_comes_while_its_group_is_restarted() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        children = kid(plan, "a"), naughty("n", 10.0, shutdown="infinity"), kid(plan, "b")
        family = await Family.start(system, plan, *children, strategy="one_for_all")
        with system.events() as events:
            family.ref("b").tell(Boom())
            await asyncio.sleep(1.0)
            family.ref("a").kill()
            await asyncio.sleep(10.0)
            told = [event for event in events.take() if isinstance(event, hf.events.ChildTerminated)]
        assert [event.address for event in told] == ["/app/top/b", "/app/top/a"]
        assert plan.take() == "-b +a +b"


async def test_the_next_life_begins_when_the_last_is_over() -> None:
    """W2: what a start that fails late has begun is ended, and only then comes the next attempt."""
    log: list[str] = []

    class Helper(hf.Actor):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(4.0)
            log.append("helper stopped")

    class Slow(hf.Actor):
        async def on_start(self, restored: bool) -> None:
            log.append(f"start {self.ctx.life}")
            if self.ctx.life == 2:
                self.ctx.spawn(hf.start(Helper))
                raise OSError("not there yet")

        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(5.0)
            log.append(f"stopped {self.ctx.life}")

        @hf.on(Boom)
        def boom(self, message: Boom) -> None:
            raise ValueError("boom")

    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(hf.child("slow", hf.start(Slow)))
        ref.tell(Boom())
        await asyncio.sleep(100.0)
        assert log == ["start 1", "stopped 1", "start 2", "helper stopped", "start 3"]
        assert system.ref("/app/slow", Slow) == ref
