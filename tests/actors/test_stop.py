"""How a life begins and ends: hooks, order, reasons (DESIGN 3, 4; W9, T32)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import HookFailed
from holdfast.supervision.admin import AlreadyStarted


class Do(hf.Message[Any]):
    work: Any


class No(hf.Refusal):
    why: str = ""


class Plain(hf.Actor):
    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        result = message.work(self)
        return await result if asyncio.iscoroutine(result) else result


class Hooked(Plain):
    """Notes its hooks; `gate` holds `on_start`, `parting` holds `on_stop`."""

    def __init__(
        self, told: list[Any], gate: asyncio.Event | None = None, parting: asyncio.Event | None = None
    ) -> None:
        self._told, self._gate, self._parting = told, gate, parting

    async def on_start(self, restored: bool) -> None:
        self._told.append("starting")
        if self._gate is not None:
            await self._gate.wait()
        self._told.append("started")

    async def on_stop(self, reason: hf.ExitReason) -> None:
        self._told.append(reason)
        if self._parting is not None:
            await self._parting.wait()


# -- beginning -------------------------------------------------------------------------------------------------------


async def test_on_start_is_the_first_turn(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    one = system.spawn(hf.start(Hooked, told))
    assert told == []
    await one.ask(Do(lambda actor: told.append("message")))
    assert told == ["starting", "started", "message"]


async def test_start_waits_for_on_start(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    gate = asyncio.Event()
    starting = asyncio.create_task(system.start(hf.child("one", hf.start(Hooked, told, gate))))
    while not told:
        await asyncio.sleep(0)
    assert not starting.done()
    gate.set()
    await starting
    assert told == ["starting", "started"]


@pytest.mark.parametrize("error", [ValueError("broken"), SystemExit(3), No("will not"), asyncio.CancelledError()])
@pytest.mark.parametrize("where", ["__init__", "on_start", "async on_start", "suspended on_start"])
async def test_an_actor_that_cannot_start_says_why_and_leaves_nothing(
    system: hf.ActorSystem, error: BaseException, where: str
) -> None:
    class Broken(Plain):
        def __init__(self) -> None:
            if where == "__init__":
                raise error

        def on_start(self, restored: bool) -> Any:
            if where == "on_start":
                raise error
            return self.fail()

        async def fail(self) -> None:
            if where == "suspended on_start":
                await asyncio.sleep(0)
            raise error

    async with asyncio.timeout(30):
        with pytest.raises(hf.StartFailed) as failed:
            await system.start(hf.child("broken", hf.start(Broken)))
    assert failed.value.actor == "/t/broken"
    assert type(error).__name__ in failed.value.reason
    cause = failed.value.__cause__
    assert cause is error or (cause is not None and cause.__cause__ is error)  # A refusal becomes a failed start first.
    assert system.tree() == ["/t"]
    await system.start(hf.child("broken", hf.start(Plain)))  # the name is free


async def test_a_spawned_actor_whose_init_fails_is_refused_at_the_call(system: hf.ActorSystem) -> None:
    class Broken(Plain):
        def __init__(self) -> None:
            raise ValueError("broken")

    with pytest.raises(hf.StartFailed, match="broken"):
        system.spawn(hf.start(Broken), "broken")
    assert system.tree() == ["/t"]
    system.spawn(hf.start(Plain), "broken")


async def test_messages_to_a_spawned_actor_whose_on_start_fails_are_not_lost_without_a_trace(
    system: hf.ActorSystem,
) -> None:
    class Broken(Plain):
        def on_start(self, restored: bool) -> None:
            raise ValueError("broken")

    broken = system.spawn(hf.start(Broken))
    asked = broken.ask(Do(print))
    broken.tell(Do(print))
    with pytest.raises(hf.ActorStopped):
        await asked
    assert system.dead_letters == 1


async def test_a_name_clash_of_children_is_refused(system: hf.ActorSystem) -> None:
    await system.start(hf.child("one", hf.start(Plain)))
    with pytest.raises(AlreadyStarted):
        await system.start(hf.child("one", hf.start(Plain)))
    system.spawn(hf.start(Plain), "two")
    with pytest.raises(hf.errors.NameTaken):
        await system.start(hf.child("two", hf.start(Plain)))
    assert system.tree() == ["/t", "/t/one", "/t/two"]


# -- stopping --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reason", [hf.SHUTDOWN, hf.NORMAL, hf.Shutdown("enough"), hf.Hung(1.0)], ids=str)
async def test_the_reason_is_handed_to_on_stop_and_to_who_waits(system: hf.ActorSystem, reason: hf.ExitReason) -> None:
    told: list[Any] = []
    one = system.spawn(hf.start(Hooked, told))
    ended = one._cell.ended()
    await one.ask(Do(lambda actor: actor.ctx.stop(reason)))
    assert await ended == reason
    assert told[2:] == [reason]


async def test_on_stop_runs_after_a_crash_with_the_crash(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    one = system.spawn(hf.start(Hooked, told))
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Do(lambda _: 1 / 0))
    await system._node.settled()
    assert [type(entry) for entry in told[2:]] == [hf.Crash]
    assert told[2].type_name == "ZeroDivisionError"


async def test_on_stop_does_not_run_when_killed(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    one = system.spawn(hf.start(Hooked, told))
    await one.ask(Do(lambda _: None))
    one.kill()
    await system._node.settled()
    assert told == ["starting", "started"]


async def test_stop_ends_the_turn_in_hand_first(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    gate = asyncio.Event()

    async def work(_: Any) -> str:
        await gate.wait()
        return "done"

    one = system.spawn(hf.start(Hooked, told))
    asked = one.ask(Do(work))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    one.stop()
    gate.set()
    assert await asked == "done"
    await system._node.settled()
    assert told == ["starting", "started", hf.SHUTDOWN]


@pytest.mark.parametrize("moment", ["before its first turn", "in on_start", "up"])
async def test_a_stop_at_any_moment_runs_each_hook_once_and_in_order(system: hf.ActorSystem, moment: str) -> None:
    told: list[Any] = []
    gate = asyncio.Event()
    one = system.spawn(hf.start(Hooked, told, gate))
    ended = one._cell.ended()
    if moment != "before its first turn":
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert told == ["starting"]
    if moment == "up":
        gate.set()
        await one.ask(Do(lambda _: None))
    one.stop()
    one.stop()
    gate.set()
    async with asyncio.timeout(30):
        assert await ended == hf.SHUTDOWN
    assert told == ["starting", "started", hf.SHUTDOWN]


@pytest.mark.parametrize("command", ["stop", "kill"])
async def test_a_child_that_ends_while_it_starts_is_no_endless_wait_for_who_starts_it(
    system: hf.ActorSystem, command: str
) -> None:
    told: list[Any] = []
    gate = asyncio.Event()
    starting = asyncio.create_task(system.start(hf.child("one", hf.start(Hooked, told, gate), restart="temporary")))
    while not told:
        await asyncio.sleep(0)
    getattr(system.ref("/t/one", Hooked), command)()
    gate.set()
    async with asyncio.timeout(30):
        if command == "stop":
            await starting
        else:
            with pytest.raises(hf.StartFailed):
                await starting
        while system.tree() != ["/t"]:
            await asyncio.sleep(0)


async def test_stopping_again_while_stopping_and_after_is_no_error(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    parting = asyncio.Event()
    one = system.spawn(hf.start(Hooked, told, None, parting))
    first = asyncio.create_task(system.stop(one))
    while len(told) < 3:
        await asyncio.sleep(0)
    second = asyncio.create_task(system.stop(one))
    one.stop()
    await asyncio.sleep(0)
    assert not second.done()  # it returns only after the hook ran
    parting.set()
    await asyncio.gather(first, second)
    await system.stop(one)
    one.stop()
    one.kill()
    assert told == ["starting", "started", hf.SHUTDOWN]


async def test_stopping_a_supervised_child_twice_is_no_error(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Plain)))
    await asyncio.gather(system.stop(one), system.stop(one))
    await system.stop(one)
    assert system.tree() == ["/t"]
    await system.start(hf.child("one", hf.start(Plain)))


async def test_an_actor_can_stop_itself_in_its_turn(system: hf.ActorSystem) -> None:
    told: list[Any] = []
    one = system.spawn(hf.start(Hooked, told))
    queued = [one.ask(Do(lambda actor: actor.ctx.stop())), one.ask(Do(lambda _: "never"))]
    assert await queued[0] is None
    with pytest.raises(hf.ActorStopped):
        await queued[1]
    assert told[-1] == hf.NORMAL


async def test_children_are_stopped_first_newest_first_and_grandchildren_before_them(system: hf.ActorSystem) -> None:
    told: list[str] = []

    class Node(Plain):
        def on_stop(self, reason: hf.ExitReason) -> None:
            told.append(self.ctx.path.removeprefix("/t/"))

    def below(*names: str) -> Do:
        return Do(lambda actor: [actor.ctx.spawn(hf.start(Node), name) for name in names])

    top = system.spawn(hf.start(Node), "top")
    [a, _] = await top.ask(below("a", "b"))
    await a.ask(below("1", "2"))
    await system.stop(top)
    assert told == ["top/b", "top/a/2", "top/a/1", "top/a", "top"]


@pytest.mark.parametrize("end", ["crash", "kill", "stop"])
async def test_children_end_with_their_parent_however_it_ends(system: hf.ActorSystem, end: str) -> None:
    top = system.spawn(hf.start(Plain), "top")
    child = await top.ask(Do(lambda actor: actor.ctx.spawn(hf.start(Plain), "child")))
    await child.ask(Do(lambda actor: actor.ctx.spawn(hf.start(Plain), "grandchild") and None))
    top.tell(Do(lambda _: 1 / 0)) if end == "crash" else getattr(top, end)()
    await system._node.settled()
    assert system.tree() == ["/t"]
    with pytest.raises(hf.ActorStopped):
        await child.ask(Do(print))


async def test_a_hook_that_fails_is_told_and_the_end_goes_on(system: hf.ActorSystem) -> None:
    class Broken(Plain):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(0)
            raise ValueError("broken")

    broken = system.spawn(hf.start(Broken), "broken")
    with system.events() as stream:
        await system.stop(broken)
        [failed] = [event for event in stream.take() if isinstance(event, HookFailed)]
    assert (failed.address, failed.hook, str(failed.reason)) == ("/t/broken", "on_stop", "ValueError: broken")
    assert system.tree() == ["/t"]


async def test_on_stop_may_still_send_and_ask(system: hf.ActorSystem) -> None:
    other = system.spawn(hf.start(Plain))

    class Parting(Plain):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            told.append(await other.ask(Do(lambda actor: "heard")))

    told: list[str] = []
    await system.stop(system.spawn(hf.start(Parting)))
    assert told == ["heard"]


async def test_background_tasks_end_with_the_life(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Plain))
    task: asyncio.Task[Any] = await one.ask(Do(lambda actor: actor.ctx.create_task(asyncio.Event().wait())))
    await one.ask(Do(lambda actor: actor.ctx.pipe_to_self(asyncio.Event().wait(), lambda _: Do(print))))
    await system.stop(one)
    await asyncio.wait([task], timeout=30)
    assert task.cancelled()


async def test_an_exception_in_a_background_task_is_the_actor_s_crash(system: hf.ActorSystem) -> None:
    """T34: no task dies in silence."""

    async def fail() -> None:
        raise ValueError("in the background")

    for how in ("create_task", "pipe_to_self"):
        one = system.spawn(hf.start(Plain))
        ended = one._cell.ended()
        rest = () if how == "create_task" else (Do,)
        await one.ask(Do(lambda actor, how=how, rest=rest: getattr(actor.ctx, how)(fail(), *rest) and None))
        assert str(await ended) == "ValueError: in the background"


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_stop_that_takes_too_long_becomes_a_kill(system: hf.ActorSystem) -> None:
    loop = asyncio.get_running_loop()
    told: list[Any] = []
    one = system.spawn(hf.start(Hooked, told, None, asyncio.Event()))
    begin = loop.time()
    await system.stop(one)
    assert loop.time() - begin == pytest.approx(5.0, abs=0.1)
    assert system.tree() == ["/t"]


# -- whom on_stop is called for, and what it may say ------------------------------------------------------------------


class Says(Plain):
    """Tells of its end, and gives what it was given as its result."""

    def __init__(self, told: list[str], says: Any = None) -> None:
        self.told, self.says = told, says

    async def on_stop(self, reason: hf.ExitReason) -> Any:
        self.told.append(str(reason))
        if isinstance(self.says, BaseException):
            raise self.says
        return self.says


class FailsToStart(Says):
    async def on_start(self, restored: bool) -> None:
        self.ctx.spawn(hf.start(Says, self.told), "helper")
        raise self.says


@pytest.mark.parametrize("traps", [False, True])
async def test_on_stop_is_called_when_a_supervisor_stops_its_child(system: hf.ActorSystem, traps: bool) -> None:
    told: list[str] = []
    ref = await system.start(hf.child("a", hf.start(Says, told)))

    def trap(actor: hf.Actor) -> None:
        actor.ctx.trap_exits = traps

    await ref.ask(Do(trap))
    await system.stop(ref)
    assert told == ["shutdown"]


@pytest.mark.parametrize("error", [ValueError("no device"), hf.Ignore("not today")])
async def test_a_start_that_fails_has_nothing_to_take_down_but_its_children(
    system: hf.ActorSystem, error: Exception
) -> None:
    told: list[str] = []
    start = system.start(hf.child("a", hf.start(FailsToStart, told, error)))
    if isinstance(error, hf.Ignore):
        assert await start is None
    else:
        with pytest.raises(hf.StartFailed, match="no device"):
            await start
    assert told == ["shutdown"]  # It is the helper's.


@pytest.mark.parametrize("recovery", [None, hf.hybrid(60.0)])
async def test_an_exit_that_is_not_trapped_cuts_off_wherever_the_state_is(
    system: hf.ActorSystem, recovery: Any
) -> None:
    told: list[str] = []
    peer = system.spawn(hf.start(Plain))
    ref = await system.start(hf.child("a", hf.start(Cut, str(id(told))), recovery=recovery, restart="temporary"))
    TOLD[str(id(told))] = told
    await ref.ask(Linked(peer.path))
    peer.kill()
    while "/t/a" in system.tree():
        await asyncio.sleep(0)
    assert told == []


TOLD: dict[str, list[str]] = {}


class Linked(hf.Message[None]):
    path: str


class Cut(hf.Actor):
    """Its state can be saved: where it tells of its end is known by name."""

    def __init__(self, name: str) -> None:
        self.name = name

    @hf.on(Linked)
    def link(self, message: Linked) -> None:
        if message.path:
            self.ctx.link(self.ctx.find(message.path, hf.Actor))

    def on_stop(self, reason: hf.ExitReason) -> None:
        TOLD[self.name].append(str(reason))


@pytest.mark.parametrize(
    ("says", "reason", "restarted"),
    [
        (None, "shutdown (mine)", False),
        ("anything else", "shutdown (mine)", False),
        (hf.Shutdown("no use"), "shutdown (no use)", False),
        (hf.Crash("Later", "it was not saved"), "Later: it was not saved", True),
        (OSError("disk full"), "OSError: disk full", True),
    ],
)
async def test_on_stop_may_say_why_the_life_ends(
    system: hf.ActorSystem, says: Any, reason: str, restarted: bool
) -> None:
    told: list[str] = []
    ref = await system.start(hf.child("a", hf.start(Says, told, says), restart="transient"))
    ended = ref._cell.ended()
    with system.events() as events:
        ref.tell(Do(lambda actor: actor.ctx.stop(hf.Shutdown("mine"))))
        assert str(await ended) == reason
        await system._node.settled()
        kinds = [type(event).__name__ for event in events.take()]
    assert told == ["shutdown (mine)"]
    assert ("ChildRestarted" in kinds) is restarted
    assert ("ActorCrashed" in kinds) is isinstance(says, hf.Crash)
    assert ("HookFailed" in kinds) is isinstance(says, OSError)


async def test_a_crash_stays_the_reason_when_on_stop_fails_too(system: hf.ActorSystem) -> None:
    ref = system.spawn(hf.start(Says, [], OSError("disk full")))
    ended = ref._cell.ended()
    ref.tell(Do(lambda _: 1 / 0))
    assert "ZeroDivisionError" in str(await ended)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_who_stops_with_a_crash_has_crashed(system: hf.ActorSystem, isolation: Any) -> None:
    ref = await system.start(hf.child("a", hf.start(Gives), isolation=isolation, restart="temporary"))
    ended = ref._cell.ended()
    with system.events() as events:
        ref.tell(Give())
        await ended
        await system._node.settled()
        told = [event for event in events.take() if isinstance(event, hf.events.ActorCrashed)]
    assert [(event.address, str(event.reason)) for event in told] == [("/t/a", "Up: it gives up")]


class Give(hf.Message): ...


class Gives(hf.Actor):
    @hf.on(Give)
    def give(self, message: Give) -> None:
        self.ctx.stop(hf.Crash("Up", "it gives up"))
