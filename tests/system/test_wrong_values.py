"""Wrong values that a user's own code gives to the runtime: each is refused where it is given, and ends nobody else."""

import asyncio
import inspect
import operator
import re
import traceback
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.life import recorded_context
from tests.system.wrong_values import HALF, REASONS, Client, Idle, OwnReason, Send, Stop, send_all

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

LAST = len(REASONS)


def idle(id: str | None, **options: Any) -> hf.ChildSpec[Idle]:
    return hf.child(id, hf.start(Idle), restart="temporary", **options)


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_what_is_no_exit_reason_ends_the_life_that_gave_it_as_a_crash(recovery: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        other = await system.start(idle("other"))
        with system.events() as events:
            for number in range(-1, LAST):
                one = await system.start(idle(f"x{number}", recovery=recovery))
                with pytest.raises(hf.RemoteCrash, match=r"ctx\.stop: takes an exit reason"):
                    await one.ask(Stop(number))
            await system._node.settled()
            ends = [event for event in events.take() if isinstance(event, hf.events.ActorCrashed)]
        assert len(ends) == LAST + 1
        assert not [path for path in system.tree() if "/x" in path]
        assert await system.get_state(other) == {"done": 0}


async def test_who_stops_another_one_gives_an_exit_reason() -> None:
    async with hf.ActorSystem(log=False) as system:
        one = await system.start(idle("x"))
        for reason in (*REASONS, OwnReason("own")):
            with pytest.raises(hf.SpecError, match="takes an exit reason"):
                await system.terminate(one, reason)
            with pytest.raises(hf.SpecError, match="takes an exit reason"):
                await system.stop(one, reason)
        assert (await system.get_status(one)).life == 1
        await system.stop(one, hf.Shutdown("its work is done"))


class Leaver(hf.Actor):
    def on_stop(self, reason: hf.ExitReason) -> hf.ExitReason:
        return hf.Shutdown(42)  # type: ignore[arg-type]


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_hook_that_returns_a_wrong_reason_has_failed(recovery: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        one = await system.start(hf.child("x", hf.start(Leaver), restart="temporary", recovery=recovery))
        with system.events() as events:
            ended = await system.terminate(one)
            assert [event.hook for event in events.take() if isinstance(event, hf.events.HookFailed)] == ["on_stop"]
        assert isinstance(ended, hf.Crash)
        assert "on_stop: takes an exit reason" in ended.text


class Over(hf.Message): ...


class Passes(hf.Actor):
    @hf.on(Over)
    def over(self, message: Over) -> None:
        self.ctx.stop()

    def on_stop(self, reason: hf.ExitReason) -> hf.ExitReason:
        return hf.KILLED


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_hook_cannot_say_that_something_else_has_ended_the_life(recovery: Any, isolation: Any) -> None:
    """Whoever hears of a kill brings a recorded life back, to end again, and that again and again."""
    async with hf.ActorSystem(log=False) as system:
        passes = hf.child("x", hf.start(Passes), restart="transient", recovery=recovery, isolation=isolation)
        one = await system.start(passes)
        with system.events() as events:
            one.tell(Over())
            failed = await events.until(hf.events.HookFailed)
            assert "on_stop: returns killed, which did not end it" in str(failed.reason)
            while (await events.until(hf.events.ActorStarted)).address != one.path:
                pass  # As after any crash: it is transient.
        await system._node.settled()
        assert (await system.get_status(one)).life == 2


class Slow(Idle):
    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(4.0)


async def test_a_recorded_end_that_nobody_can_read_is_a_crash(monkeypatch: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        one = await system.start(hf.child("x", hf.start(Slow), restart="transient", recovery=hf.hybrid()))
        with monkeypatch.context() as before:
            before.setattr(recorded_context, "check_reason", lambda where, reason: reason)  # As in earlier versions.
            one.tell(Stop(0))
            await asyncio.sleep(2.0)
        with system.events() as events:
            one.kill()  # In the middle of its end: the next life has to do what the record says.
            await asyncio.sleep(20.0)
            crashes = [str(event.reason) for event in events.take() if isinstance(event, hf.events.ActorCrashed)]
        assert len(crashes) == 1
        assert "an exit reason, {'exit': 'str'}" in crashes[0]
        assert await system.get_state(one) == {"done": 0}


class Fails(hf.Actor):
    @hf.on(Stop)
    def stop(self, message: Stop) -> None:
        raise LookupError("nobody home")


async def test_a_tree_that_fails_has_the_error_that_ended_it_as_its_cause() -> None:
    async def fail() -> None:
        async with hf.ActorSystem(log=False) as system:
            spec = hf.supervisor("top", intensity=0, children=[hf.child("x", hf.start(Fails))])
            top = await system.start(spec)
            while True:
                system.ref(f"{top.path}/x").tell(Stop(0))
                await asyncio.sleep(1.0)

    with pytest.raises(hf.errors.TreeFailed, match="/app/top/x: LookupError: nobody home") as failed:
        await fail()
    assert "in stop" in "".join(traceback.format_exception(failed.value.__cause__))


# -- calls to supervisors, registries and pools ----------------------------------------------------------------------


async def start_all(system: hf.ActorSystem) -> dict[str, hf.ActorRef[Any]]:
    specs = [
        hf.dynamic("some", template=hf.child(None, hf.start(Idle), restart="temporary")),
        hf.supervision.partitions("copies", hf.start(Idle), 2),
        hf.supervision.pool("crew", hf.start(Idle), 1),
        hf.supervision.registry("names"),
    ]
    refs = {ref.path: ref for ref in [await system.start(spec) for spec in specs]}
    await refs["/app/some"].ask(hf.StartChild(id="kid"))
    return refs


def client(refs: dict[str, hf.ActorRef[Any]], **options: Any) -> hf.ChildSpec[Client]:
    return hf.child("client", hf.start(Client), bindings={path.removeprefix("/app/"): path for path in refs}, **options)


async def standing(system: hf.ActorSystem, refs: dict[str, hf.ActorRef[Any]]) -> list[Any]:
    """What must not change."""
    lives = [(path, (await system.get_status(path)).life) for path in system.tree() if "client" not in path]
    specs = [await ref.ask(hf.WhichChildren()) for path, ref in refs.items() if path != "/app/names"]
    return [*lives, *specs]


async def test_a_wrong_value_in_a_call_is_an_answer_and_changes_nothing() -> None:
    async with hf.ActorSystem(log=False) as system:
        refs = await start_all(system)
        before = await standing(system, refs)
        assert await send_all(refs) == []
        assert await standing(system, refs) == before
        one = await system.start(client(refs))
        assert await one.ask(Send(), 1000.0) == []
        assert await standing(system, refs) == before


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_a_wrong_value_from_a_process_is_refused_there_or_an_answer() -> None:
    async with hf.ActorSystem(log=False) as system:
        refs = await start_all(system)
        before = await standing(system, refs)
        one = await system.start(client(refs, isolation="process", restart="temporary"))
        assert await one.ask(Send(), 60.0) == []
        assert await standing(system, refs) == before
        with pytest.raises(hf.RemoteCrash, match=r"ctx\.stop: takes an exit reason"):
            await one.ask(Stop(5))


async def test_a_wrong_call_that_nobody_waits_for_is_logged() -> None:
    async with hf.ActorSystem(log=False) as system:
        refs = await start_all(system)
        with system.events() as events:
            refs["/app/some"].tell(hf.TerminateChild(["kid"]))  # type: ignore[arg-type]
            refs["/app/some"].tell(hf.StartChild(id=HALF))
            refs["/app/some"].tell(hf.supervision.ChangeSupervisor(7))
            refs["/app/copies"].tell(hf.supervision.ResizePartitions(-1))
            await system._node.settled()
            told = [event.why for event in events.take() if isinstance(event, hf.events.DeadLetter)]
        assert ["refused" in why for why in told] == [True] * 4, told


async def test_a_pool_has_a_limit() -> None:
    async with hf.ActorSystem(log=False) as system:
        crew = await system.start(hf.supervision.pool("crew", hf.start(Idle), 1))
        with pytest.raises(hf.SpecError, match="size at most 100000"):
            await crew.ask(hf.supervision.ResizePool(2**40), 1.0)


# -- what takes a ref, an address, a topic, a spec or an error -------------------------------------------------------

NO_REFS: tuple[Any, ...] = ("/app/b", "b", None, 7, Idle)
NO_TOPICS: tuple[Any, ...] = ("alarms", "", None, 7, HALF, "/a\ud800", ["/x"])
NO_NAMES: tuple[Any, ...] = ("", None, 7, HALF, "x" * 5000, ["x"])
NO_STARTS: tuple[Any, ...] = ("x", None, Idle, 7)
NO_ERRORS: tuple[Any, ...] = ("no", None, ValueError("no"), hf.Refusal, 7)

IN_A_TURN: dict[str, tuple[Callable[[hf.ActorContext, Any], Any], tuple[Any, ...], str]] = {
    "link": (lambda ctx, value: ctx.link(value), NO_REFS, "ctx.link: takes a ref"),
    "unlink": (lambda ctx, value: ctx.unlink(value), NO_REFS, "ctx.unlink: takes a ref"),
    "monitor": (lambda ctx, value: ctx.monitor(value), NO_REFS, "ctx.monitor: takes a ref"),
    "watch": (lambda ctx, value: ctx.watch(value), NO_REFS, "ctx.watch: takes a ref"),
    "forward": (lambda ctx, value: ctx.forward(value), NO_REFS, "ctx.forward: takes a ref"),
    "subscribe": (lambda ctx, value: ctx.subscribe(value), NO_TOPICS, "must start with '/'"),
    "unsubscribe": (lambda ctx, value: ctx.unsubscribe(value), NO_TOPICS, "must start with '/'"),
    "publish": (lambda ctx, value: ctx.publish(value, Stop(0)), NO_TOPICS, "must start with '/'"),
    "find": (lambda ctx, value: ctx.find(value, Idle), (None, 7, ["/x"]), "takes an address"),
    "find a": (lambda ctx, value: ctx.find("/app", value), ("Idle", None, int), "the class of an actor"),
    "spawn": (lambda ctx, value: ctx.spawn(value), NO_STARTS, r"takes start\(Class"),
    "spawn as": (lambda ctx, value: ctx.spawn(hf.start(Idle), value), (*NO_NAMES[:1], *NO_NAMES[2:], "a/b"), "text"),
    "fail": (lambda ctx, value: ctx.reply_handle().fail(value), NO_ERRORS, "takes a Refusal or another HoldfastError"),
}


def on_target(verb: str) -> Callable[[hf.ActorSystem, Any], Any]:
    """The method of the system with this name, of which the value says who is meant."""
    return lambda system, value: operator.methodcaller(verb, value)(system)


FROM_OUTSIDE: dict[str, tuple[Callable[[hf.ActorSystem, Any], Any], tuple[Any, ...], str]] = {
    "spawn": (lambda system, value: system.spawn(value), NO_STARTS, r"takes start\(Class"),
    "start": (lambda system, value: system.start(value), NO_STARTS, r"takes child\("),
    "ref": (lambda system, value: system.ref(value), (None, 7, ["/x"]), "takes an address"),
    "ref to a": (lambda system, value: system.ref("/app", value), ("Idle", None, int), "the class of an actor"),
    "publish": (lambda system, value: system.publish(value, Stop(0)), NO_TOPICS, "must start with '/'"),
    "register": (lambda system, value: system.register(value, "/app"), NO_NAMES, "a name must be text"),
    "unregister": (lambda system, value: system.unregister(value), NO_NAMES, "a name must be text"),
    "whereis": (lambda system, value: system.whereis(value), NO_NAMES, "a name must be text"),
    **{
        verb: (on_target(verb), (None, 7, ["/x"], Idle), "is neither a ref nor an address")
        for verb in ("stop", "terminate", "suspend", "resume", "get_state", "get_status", "checkpoint", "pid_of")
    },
    "id": (lambda system, value: idle(value), (*NO_NAMES[:1], *NO_NAMES[2:], "a/b"), "the id must be text"),
    "bind": (lambda system, value: system.bind("/app", value, "/app"), (None, 7, ["x"]), "has no binding"),
    "registry": (lambda system, value: hf.supervision.Registry(value), NO_REFS, "Registry: takes a ref"),
    "tasks": (lambda system, value: hf.supervision.Tasks(value), NO_REFS, "Tasks: takes a ref"),
    "tell": (lambda system, value: system.from_thread().tell(value, Stop(0)), NO_REFS, "tell: takes a ref"),
    "ask": (lambda system, value: system.from_thread().ask(value, Stop(0)), NO_REFS, "ask: takes a ref"),
    "send": (lambda system, value: system.from_thread().send(value, Stop(0)), NO_REFS, "takes a ref"),
    "decorated": (lambda system, value: hf.subscribe(value), NO_TOPICS, "must start with '/'"),
}


class Try(hf.Message[str]):
    """Call the verb with the value of this number; the reply is what it raised."""

    verb: str
    number: int


class Caller(hf.Actor):
    @hf.on(Try)
    async def call(self, message: Try) -> str:
        call, values, _ = IN_A_TURN[message.verb]
        try:
            result = call(self.ctx, values[message.number])
            if inspect.isawaitable(result):
                await result
        except hf.SpecError as error:
            return str(error)
        return "nothing"


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_verb_of_an_actor_says_what_it_takes(recovery: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        caller = await system.start(hf.child("caller", hf.start(Caller), recovery=recovery))
        for verb, (_, values, says) in IN_A_TURN.items():
            for number, value in enumerate(values):
                assert re.search(says, await caller.ask(Try(verb, number))), (verb, value)
        assert (await system.get_status(caller)).life == 1


async def test_a_verb_of_the_system_says_what_it_takes() -> None:
    async with hf.ActorSystem(log=False) as system:
        for call, values, says in FROM_OUTSIDE.values():
            for value in values:
                with pytest.raises(hf.SpecError, match=says):
                    await called(call, system, value)


async def called(call: Callable[..., Any], system: hf.ActorSystem, value: Any) -> None:
    result = call(system, value)
    if inspect.isawaitable(result):
        await result
