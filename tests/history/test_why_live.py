"""What `why` says of real systems, whose actors fail for each cause in turn."""

import asyncio
import dataclasses
import os
import re
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.actors.kernel import links
from holdfast.system.history.evidence import Told, collect
from holdfast.system.history.why import why
from tests.history.players import (
    Caller,
    Do,
    Fickle,
    Killer,
    Pass,
    Sleeper,
    SlowStarter,
    Strike,
    Stubborn,
    Worker,
    failed,
    until,
)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A system that bears many restarts."""
    async with hf.ActorSystem("app", log=False, intensity=100) as running:
        yield running


def worker(name: str = "worker", **options: object) -> hf.ChildSpec[Worker]:
    return hf.child(name, hf.start(Worker), **options)  # type: ignore[arg-type]


async def said(system: hf.ActorSystem, target: hf.ActorRef[hf.Actor] | str) -> str:
    return " ".join(await system.why(target))


def heard(system: hf.ActorSystem, target: hf.ActorRef[Any]) -> str:
    """What `why` would say of the children, without a wait: for `until`."""
    assert system._history is not None
    overview = target._cell.actor._overview()  # type: ignore[union-attr]  # it is up
    return " ".join(why(collect(system._node, system._history, target.path, Told(None, None, overview), [])))


async def test_nobody_and_nothing(system: hf.ActorSystem) -> None:
    assert await said(system, "/app/nobody") == "Nobody lives at /app/nobody, and the history knows of no life there."
    ref = await system.start(worker())
    assert await said(system, ref) == "/app/worker is running, in life 1, and nothing is wrong as far as is known."


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["unrecorded", "recorded"])
async def test_a_process_that_stands_still_is_told(system: hf.ActorSystem, recovery: Any) -> None:
    ref = await system.start(worker(isolation="process", recovery=recovery))
    pid = system.pid_of(ref)
    os.kill(pid, signal.SIGSTOP)
    try:
        [told] = await system.why(ref, timeout=1.0)
        with pytest.raises(hf.AskTimeout):
            await system.get_status(ref, timeout=0.2)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert told == f"The process of /app/worker (pid {pid}) is stopped, as by SIGSTOP: SIGCONT lets it go on."
    assert "nothing is wrong" in await said(system, ref)


async def test_a_crash_loop() -> None:
    async with hf.ActorSystem("app", log=False, intensity=3, period=60.0) as system:
        ref = await system.start(worker())
        for _ in range(3):
            await failed(ref, "crash")
        await ref.ask(Do("well"))
        text = await said(system, ref)
    assert text.startswith("/app/worker restarted 3 times in the last ")
    assert "each time handling tests.history.players.Do; ZeroDivisionError: nothing to divide at players.py:" in text
    assert text.endswith("its supervisor allows 3 in 60 s and gives up at the next.")


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("kill", "its process was ended by SIGKILL, which nobody can catch"),
        ("exit", "process exited with code 3"),
        ("eat", "out of memory: all gone"),
    ],
)
async def test_a_process_that_ends(system: hf.ActorSystem, what: str, reason: str) -> None:
    ref = await system.start(worker(isolation="process"))
    await failed(ref, what)
    await ref.ask(Do("well"), 30.0)
    text = await said(system, ref)
    assert text.startswith("/app/worker ended ")
    assert reason in text
    assert "and was restarted" in text


async def test_a_process_that_hangs(system: hf.ActorSystem) -> None:
    ref = await system.start(worker(isolation="process", limits=hf.Limits(hung_after=1.0)))
    await failed(ref, "hang")
    await ref.ask(Do("well"), 30.0)
    assert "s: a loop without await, a blocking call or a lock" in await said(system, ref)


async def test_a_poison_message(system: hf.ActorSystem) -> None:
    ref = await system.start(worker(isolation="process", recovery=hf.hybrid(max_deliveries=2)))
    await failed(ref, "kill")
    await ref.ask(Do("well"), 30.0)
    text = await said(system, ref)
    assert "each time handling tests.history.players.Do" in text
    assert "The message tests.history.players.Do was put into quarantine" in text
    assert "it had ended the process 2 times in a row" in text
    system.drop(system.quarantined(ref)[0])
    assert "after 2 deaths of the process, and is not there any more" in await said(system, ref)


async def test_a_start_that_fails(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.StartFailed):
        await system.start(hf.child("stubborn", hf.start(Stubborn)))
    text = await said(system, "/app/stubborn")
    assert text.startswith("/app/stubborn could not be started ")
    assert "FileNotFoundError: no file of settings" in text


async def test_a_restart_that_fails(system: hf.ActorSystem) -> None:
    Fickle.started = 0
    backoff = hf.Backoff(initial=30.0, maximum=30.0)
    ref = await system.start(hf.child("fickle", hf.start(Fickle), restart="permanent", backoff=backoff))
    ref.tell(Do("crash"))
    await until(lambda: bool(system.lives(ref)) and system.lives(ref)[-1].is_over)
    assert "/app/fickle has no life at the moment" in await said(system, ref)


async def test_a_replay_that_leads_elsewhere() -> None:
    async with hf.ActorSystem("app", log=False, intensity=1) as system:
        inner = hf.supervisor("inner", intensity=0, children=[worker(isolation="process", recovery=hf.hybrid())])
        await system.start(inner)
        ref = system.ref("/app/inner/worker", Worker)
        await ref.ask(Do("clock"))
        await failed(ref, "kill")
        await until(lambda: any(life.is_over for life in system.lives("/app/inner")))
        text = await said(system, "/app/inner/worker")
    assert "/app/inner gave up" in text or "cannot be recovered" in text


async def test_who_has_stopped_it(system: hf.ActorSystem) -> None:
    first, second = await system.start(worker("first")), await system.start(worker("second"))
    await system.stop(first)
    assert "/app/first was ended by the program" in await said(system, "/app/first")
    async with system.transaction() as change:
        change.remove(second)
    assert "/app/second was ended by a transaction of the program" in await said(system, "/app/second")
    third = system.spawn(hf.start(Worker), "third")
    await system.stop(third)
    assert "/app/third was ended by the program" in await said(system, "/app/third")
    fourth = await system.start(worker("fourth", restart="transient"))
    await fourth.ask(Do("stop"))
    await until(lambda: system.lives("/app/fourth")[-1].is_over)
    assert "/app/fourth ended by itself" in await said(system, "/app/fourth")


async def test_a_sibling_s_restart(system: hf.ActorSystem) -> None:
    await system.start(hf.supervisor("family", strategy="one_for_all", children=[worker("one"), worker("two")]))
    one, two = system.ref("/app/family/one", Worker), system.ref("/app/family/two", Worker)
    await failed(two, "crash")
    await one.ask(Do("well"))
    text = await said(system, one)
    assert "/app/family/one was ended by /app/family" in text
    assert "/app/family/two has ended, and they are restarted together (one_for_all)" in text


async def test_a_supervisor_that_gives_up(system: hf.ActorSystem) -> None:
    await system.start(hf.supervisor("family", intensity=0, children=[worker("one"), worker("two")]))
    await failed(system.ref("/app/family/two", Worker), "crash")
    await until(lambda: len(system.lives("/app/family")) > 1)
    assert "/app/family gave up" in await said(system, "/app/family/one")
    text = await said(system, "/app/family")
    assert "its child two had failed too often (ZeroDivisionError: nothing to divide)" in text


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_supervisor_tells_of_its_children(system: hf.ActorSystem, isolation: Any) -> None:
    children = [worker("one"), worker("two", restart="temporary"), worker("three")]
    spec = hf.supervisor("family", intensity=5, period=60.0, children=children, isolation=isolation)
    family = await system.start(spec)
    one, two, three = (system.ref(f"/app/family/{name}", Worker) for name in ("one", "two", "three"))
    for _ in range(2):
        await failed(one, "crash")
    await failed(three, "crash")
    await failed(two, "crash")
    await three.ask(Do("well"))
    text = await said(system, family)
    assert "it restarted one 2 times (ZeroDivisionError: nothing to divide), three once (Zero" in text
    assert "it allows 5 in 60 s, of which it has counted 3." in text
    assert "Its child two ended " in text
    assert "and is not there: ZeroDivisionError: nothing to divide." in text
    assert "one ended" not in text


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_supervisor_tells_of_trouble_at_any_depth(system: hf.ActorSystem, isolation: Any) -> None:
    inner = hf.supervisor("inner", intensity=9, children=[worker(f"w{number}") for number in range(5)])
    middle = hf.supervisor("middle", children=[inner], isolation=isolation)
    await system.start(hf.supervisor("outer", children=[middle]))
    assert "nothing is wrong" in await said(system, "/app/outer")
    with system.events() as events:
        for number in range(5):
            await failed(system.ref(f"/app/outer/middle/inner/w{number}", Worker), "crash")
            await events.until(hf.events.ChildRestarted)
    for above in ("/app", "/app/outer", "/app/outer/middle"):
        told = await said(system, above)
        assert "Below it, /app/outer/middle/inner/w0 was restarted once" in told
        assert "2 more are in trouble below it." in told
        assert [one.cause for one in await system.causes(above)] == ["trouble further below"] * 4


async def test_a_supervisor_tells_who_made_it_give_up(system: hf.ActorSystem) -> None:
    await system.start(hf.supervisor("family", intensity=1, children=[worker("one"), worker("two")]))
    two = system.ref("/app/family/two", Worker)
    for _ in range(2):
        await failed(two, "crash")
    await until(lambda: len(system.lives("/app/family")) > 1)
    text = await said(system, "/app/family")
    assert "/app/family gave up " in text
    assert "its child two had failed too often (ZeroDivisionError: nothing to divide)" in text
    assert "it restarted two once (ZeroDivisionError: nothing to divide)" in text


async def test_a_supervisor_tells_who_starts_and_who_hangs_in_a_stop(system: hf.ActorSystem, tmp_path: Path) -> None:
    family = await system.start(hf.supervisor("family", children=[worker("one", shutdown=30.0)]))
    one, file = system.ref("/app/family/one", Worker), tmp_path / "up"
    asked = one.ask(Do("wait"), 60.0)
    slow = family.ask(hf.StartChild(hf.child("slow", hf.start(SlowStarter, str(file)))), 60.0)
    await asyncio.sleep(1.1)  # A turn is long from one second on.
    text = await said(system, family)
    assert "Its child one does not get on: it has been in the turn of tests.history.players.Do for 1." in text
    assert " at players.py:" in text
    assert "await asyncio.sleep(60.0)" in text
    assert "Its child slow is starting" in text
    file.touch()
    await slow
    stopping = family.ask(hf.TerminateChild("one"), 60.0)
    await until(lambda: "Its child one is being stopped: it has been in the turn of" in heard(system, family))
    one.kill()
    await stopping
    with pytest.raises(hf.HoldfastError):
        await asked


async def test_a_supervisor_says_who_is_suspended_and_who_was_stopped(system: hf.ActorSystem) -> None:
    family = await system.start(hf.supervisor("family", children=[worker("one"), worker("two")]))
    await system.suspend(system.ref("/app/family/one"))
    async with system.transaction() as change:
        change.stop("/app/family/two")
    text = await said(system, family)
    assert "Its child one is suspended." in text
    assert "Its child two ended " in text
    assert "by a transaction of the program" in text


PLACES: dict[str, tuple[Any, dict[str, Any]]] = {
    "task": ("task", {}),
    "process": ("task", {"isolation": "process"}),
    "recorded process": ("task", {"isolation": "process", "recovery": hf.hybrid()}),
    "below a process": ("process", {}),
    "recorded below a process": ("process", {"recovery": hf.hybrid()}),
    "process below a process": ("process", {"isolation": "process"}),
    "replicas": ("task", {"mechanism": hf.ftm.PBR()}),
}
"""Where a child lives: the isolation of its supervisor, and its own options."""


async def family(system: hf.ActorSystem, place: str, **options: Any) -> hf.ActorRef[Worker]:
    """A worker in a place, below /app/family."""
    isolation, own = PLACES[place]
    child = worker("one", **{**own, **options})
    await system.start(hf.supervisor("family", isolation=isolation, intensity=3, period=60.0, children=[child]))
    return system.ref("/app/family/one", Worker)


async def comes_to_say(system: hf.ActorSystem, target: str, words: str) -> str:
    """What is said of the target as soon as it has these words."""
    async with asyncio.timeout(10.0):
        while words not in (text := await said(system, target)):
            await asyncio.sleep(0.05)
    return text


@pytest.mark.parametrize("place", PLACES)
async def test_a_supervisor_says_who_does_not_get_on_wherever_that_one_lives(
    system: hf.ActorSystem, place: str
) -> None:
    one = await family(system, place)
    await system.suspend(one)
    assert await said(system, "/app/family") == "Its child one is suspended."
    assert await said(system, "/app") == "Below it, /app/family/one is suspended: ask why of /app/family/one."
    await system.resume(one)
    asked = one.ask(Do("wait"), 60.0)
    told = await comes_to_say(system, "/app/family", "Its child one does not get on: it has been in the turn of ")
    assert "await asyncio.sleep(60.0)" in told
    assert "Below it, /app/family/one does not get on" in await said(system, "/app")
    asked.cancel()
    await system.terminate(system.ref("/app/family", hf.Actor), reason=hf.KILLED)


@pytest.mark.parametrize("place", [place for place in PLACES if place != "replicas"])
@pytest.mark.parametrize("end", ["kill", "stop"])
async def test_who_ends_with_its_supervisor_is_said_to_wherever_it_lives(
    system: hf.ActorSystem, place: str, end: str
) -> None:
    one = await family(system, place)
    above = system.ref("/app/family", hf.Supervisor)
    if end == "kill":
        above.kill()
        await until(lambda: system.lives("/app/family/one")[-1].started != system.lives("/app/family/one")[0].started)
    else:
        await system.stop(above)
    first = system.lives("/app/family/one")[0]
    assert (first.number, first.reason_kind) == (1, "Killed" if end == "kill" else "Shutdown")
    assert (first.by, first.because) == ("/app/family", "its supervisor has ended")
    text = await said(system, one)
    assert re.match(r"/app/family/one was ended by /app/family \d+(\.\d)? s ago: its supervisor has ended\.", text)
    assert len(system.lives("/app/family/one")) == (2 if end == "kill" else 1)


@pytest.mark.parametrize("place", ["task", "process", "below a process"])
async def test_the_program_is_named_that_has_ended_a_child(system: hf.ActorSystem, place: str) -> None:
    one = await family(system, place)
    one.kill()
    await until(lambda: len(system.lives(one)) > 1)
    await one.ask(Do("well"), 20.0)
    await system.ref("/app/family", hf.Supervisor).ask(hf.TerminateChild("one"), 20.0)
    assert [life.author for life in system.lives(one)] == [
        "the program (it was killed by `ref.kill()`)",
        "the program (it was stopped by order)",
    ]


@pytest.mark.parametrize("place", ["task", "below a process", "process below a process"])
async def test_what_the_supervisor_allows_is_said_wherever_it_lives(system: hf.ActorSystem, place: str) -> None:
    one = await family(system, place)
    for _ in range(3):
        await failed(one, "crash")
    await one.ask(Do("well"), 20.0)
    assert (await said(system, one)).endswith("its supervisor allows 3 in 60 s and gives up at the next.")
    assert [life.number for life in system.lives(one)] == [1, 2, 3, 4]


class Unwilling(Worker):
    """Does not want to be started."""

    def __init__(self) -> None:
        raise hf.Ignore("not today")


class Late(Worker):
    """Starts once, and then cannot at first."""

    def on_start(self, restored: bool) -> None:
        if self.ctx.life in (2, 3):
            raise FileNotFoundError("the file of settings has gone")


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_who_did_not_want_to_be_started_has_not_lived(system: hf.ActorSystem, isolation: Any) -> None:
    child = hf.child("one", hf.start(Unwilling), isolation=isolation)
    await system.start(hf.supervisor("family", children=[child]))
    assert system.lives("/app/family/one") == []
    assert "nothing is wrong" in await said(system, "/app/family")


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_start_that_fails_is_one_life(system: hf.ActorSystem, isolation: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Late), isolation=isolation))
    await failed(one, "crash")
    await one.ask(Do("well"), 20.0)
    assert [(life.number, life.reason_kind) for life in system.lives(one)] == [
        (1, "Crash"),
        (2, "StartFailed"),
        (3, "StartFailed"),
        (4, ""),
    ]


@pytest.mark.parametrize("killed_in", ["task", "process"])
@pytest.mark.parametrize("killer_in", ["task", "process"])
async def test_whoever_kills_is_named(system: hf.ActorSystem, killer_in: Any, killed_in: Any) -> None:
    ref = await system.start(worker(isolation=killed_in))
    spec = hf.child("killer", hf.start(Killer), isolation=killer_in, bindings={"whom": ref.path})
    killer = await system.start(spec)
    killer.tell(Strike())
    await until(lambda: len(system.lives(ref)) > 1)
    assert (await said(system, ref)).startswith("/app/worker was ended by /app/killer ")
    await ref.ask(Do("well"))
    ref.kill()
    await until(lambda: len(system.lives(ref)) > 2)
    life = system.lives(ref)[1]
    assert (life.by, life.because) == ("the program", "it was killed by `ref.kill()`")
    await ref.ask(Do("well"))


async def test_an_actor_that_is_terminated_at_once_does_not_end_its_turn(system: hf.ActorSystem) -> None:
    ref = await system.start(worker(shutdown="infinity"))
    asked = ref.ask(Do("wait"), 60.0)
    await until(lambda: ref._cell.more is not None and ref._cell.more.turn is not None)
    assert await system.terminate(ref, hf.KILLED) == hf.KILLED
    with pytest.raises(hf.AskFailed):
        await asked
    await ref.ask(Do("well"))


async def test_memory_that_is_nearly_used_up(system: hf.ActorSystem) -> None:
    ref = await system.start(
        worker(isolation="process", limits=hf.Limits(memory_bytes=10_000_000, watch_interval=60.0))
    )
    assert "MB of memory, and is ended at 10 MB" in await said(system, ref)


async def test_the_turns_of_a_life(system: hf.ActorSystem) -> None:
    recorded = await system.start(worker("recorded", recovery=hf.hybrid()))
    plain, counted = await system.start(worker("plain")), await system.start(worker("counted"))
    await system.statistics(counted, True)
    for ref in (recorded, plain, counted):
        for n in (3, 2):
            for _ in range(n):
                await ref.ask(Do("well"))
            await failed(ref, "crash")
        await ref.ask(Do("well"))
    assert [life.turns for life in system.lives(recorded)] == [4, 3, 1]
    assert [life.turns for life in system.lives(plain)] == [None, None, None]
    assert [life.turns for life in system.lives(counted)] == [
        None,
        3,
        1,
    ]  # The first began before anybody counted.
    assert {life.longest_message for life in system.lives(counted)} == {"tests.history.players.Do"}
    assert all(life.longest_turn > 0.0 for life in system.lives(counted))


async def test_the_longest_turn_is_known_when_turns_are_watched() -> None:
    async with hf.ActorSystem("app", log=False, watch_turns=0.05) as system:
        ref = await system.start(worker())
        await ref.ask(Do("block"))
        await until(lambda: system.lives(ref)[-1].longest_message)
        life = system.lives(ref)[-1]
        assert life.longest_message == "tests.history.players.Do"
        assert life.longest_turn >= 0.05


async def test_a_link(system: hf.ActorSystem) -> None:
    one = await system.start(worker("one"))
    two = await system.start(worker("two"))
    links.link(one._cell, two._cell)
    await failed(one, "crash")
    await two.ask(Do("well"))
    text = await said(system, two)
    assert "/app/two was ended by /app/one" in text
    assert "it is linked to it" in text


async def test_a_turn_that_waits(system: hf.ActorSystem) -> None:
    caller = await system.start(hf.child("caller", hf.start(Caller)))
    ref = await system.start(worker(shutdown="brutal_kill"))
    asked = caller.ask(Pass(ref, "wait"), 60.0)
    await until(lambda: bool(system._node.deadlines.waiting()))
    await asyncio.sleep(1.1)
    text = await said(system, caller)
    assert "/app/caller has been in the turn of tests.history.players.Pass for 1." in text
    assert "it waits for /app/worker to answer tests.history.players.Do, asked 1." in text
    assert "it waits for something that is no ask" in await said(system, ref)
    ref.kill()
    with pytest.raises(hf.HoldfastError):
        await asked


@pytest.mark.parametrize("places", [("task", "process"), ("process", "task"), ("process", "process")], ids="-".join)
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["none", "hybrid"])
@pytest.mark.some(3)
async def test_a_turn_that_waits_wherever_both_live(
    system: hf.ActorSystem, places: tuple[Any, Any], recovery: hf.Method | None
) -> None:
    one, other = places
    spec = hf.child("caller", hf.start(Caller), isolation=one, recovery=recovery, shutdown="brutal_kill")
    caller = await system.start(spec)
    ref = await system.start(worker(isolation=other, recovery=recovery, shutdown="brutal_kill"))
    asked = caller.ask(Pass(ref, "wait"), 60.0)
    await asyncio.sleep(1.2)
    text = await said(system, caller)
    assert "it waits for /app/worker to answer tests.history.players.Do, asked " in text
    await system.stop(caller)
    with pytest.raises(hf.HoldfastError):
        await asked


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("sleep", r"; it has slept for 1\.\d s, and sleeps until \d\d:\d\d:\d\d \(\d\d?\.\d s from now\)\."),
        ("effect", r"; it waits for the effect upload, which has been out for 1\.\d s\."),
    ],
    ids=["sleep", "effect"],
)
@pytest.mark.parametrize("place", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["none", "hybrid"])
@pytest.mark.some(4)
async def test_a_turn_that_rests_as_it_has_said(
    system: hf.ActorSystem, place: Any, recovery: hf.Method | None, what: str, says: str
) -> None:
    spec = hf.child("sleeper", hf.start(Sleeper), isolation=place, recovery=recovery, shutdown="brutal_kill")
    sleeper = await system.start(spec)
    sleeper.tell(Do(what))
    sleeper.tell(Do("well"))
    await asyncio.sleep(1.3)
    text, above = await said(system, sleeper), await said(system, "/app")
    assert re.search(rf"/app/sleeper has been in the turn of tests.history.players.Do for 1\.\d s.*{says}", text), text
    assert above.startswith("/app is running, in life 1, and nothing is wrong as far as is known."), above
    if place == "task" or recovery is not None:  # Else only its process knows.
        assert re.search(rf"Its child sleeper .*{says.removeprefix('; it ')}", above), above
    late = sleeper.ask(Do("well"), 1.0)
    with pytest.raises(hf.AskTimeout):
        await late
    if place == "task" or recovery is not None:
        assert "Its child sleeper does not get on" in await said(system, "/app")


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["unrecorded", "recorded"])
async def test_suspended_and_full(system: hf.ActorSystem, recovery: Any, isolation: Any) -> None:
    ref = await system.start(worker(recovery=recovery, isolation=isolation))
    waits = "it handles nothing, and 150 messages wait for `resume`."
    with system.events() as events:
        await system.suspend(ref)
        assert (await events.until(hf.events.ActorSuspended)).by == "the program"
        for _ in range(150):
            ref.tell(Do("well"))
        assert re.fullmatch(rf"/app/worker was suspended 0\.\d s ago by the program: {waits}", await said(system, ref))
        await system.resume(ref)
        assert (await events.until(hf.events.ActorResumed)).address == ref.path
    await ref.ask(Do("well"), 20.0)
    async with system.transaction() as change:
        change.suspend(ref)
    assert "ago by the program: it handles nothing, and what comes waits for `resume`." in await said(system, ref)
    async with system.transaction() as change:
        change.resume(ref)
    assert "nothing is wrong" in await said(system, ref)


class Sit(hf.Message[None]): ...


def luck() -> int:
    return 7


def fate() -> int:
    return 8


class Sitting(hf.Actor):
    """Waits for days; a release that has another effect before that cannot go on with what was begun."""

    draws: ClassVar[list[Callable[[], int]]] = [luck]

    @hf.on(Sit)
    async def sit(self, message: Sit) -> None:
        await self.ctx.effect(self.draws[0])
        await self.ctx.sleep(1e6)


async def test_who_does_not_come_up_with_a_release_was_not_restarted_and_with_the_old_one_all_is_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, backoff = f"sqlite:{tmp_path / 'app.db'}", hf.Backoff(initial=0.05, maximum=0.05)
    template = hf.child(None, hf.start(Sitting), recovery=hf.hybrid(), backoff=backoff)
    exam = hf.supervisor("exam", children=[hf.dynamic("hall", template=template, journal=True, intensity=1000)])
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(exam)
        ann = await system.ref("/app/exam/hall", hf.Supervisor).ask(hf.StartChild(id="ann"))
        ann.tell(Sit())
        await until(lambda: "it has slept" in heard(system, system.ref("/app/exam/hall")))
    monkeypatch.setattr(Sitting, "draws", [fate])
    async with hf.ActorSystem("app", store=store, log=False) as system:
        with system.events() as events:
            await system.start(exam)
            for _ in range(3):
                await events.until(hf.events.ChildStartFailed)
        above, own = await said(system, "/app/exam"), await said(system, "/app/exam/hall")
        assert re.search(r"Below it, /app/exam/hall/ann could not be started \d+ times within the last 1 s \(", above)
        assert re.search(r"it could not start ann \d+ times \(", own)
        for told in (above, own):
            assert "diverged at turn 1" in told
            assert "effect" in told
            assert "restarted" not in told
            assert "ctx.now()" not in told
    monkeypatch.setattr(Sitting, "draws", [luck])
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(exam)
        await until(lambda: "it has slept" in heard(system, system.ref("/app/exam/hall")))
        told = await said(system, "/app/exam")
        assert "nothing is wrong" in told
        assert "start" not in told


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["unrecorded", "recorded"])
async def test_messages_that_wait_for_long_are_told(system: hf.ActorSystem, isolation: Any, recovery: Any) -> None:
    ref = await system.start(worker(isolation=isolation, recovery=recovery, shutdown="brutal_kill"))
    await system.statistics(ref, True)
    await ref.ask(Do("well"), 20.0)
    ref.tell(Do("wait"))
    late = await asyncio.gather(*(ref.ask(Do("well"), 1.0) for _ in range(3)), return_exceptions=True)
    assert [type(error) for error in late] == [hf.AskTimeout] * 3
    async with asyncio.timeout(20.0):
        while "one has waited for 1" not in (text := await said(system, ref)):
            await asyncio.sleep(0.05)
    assert "3 messages wait in its mailbox; most of them are tests.history.players.Do; one has waited for " in text
    assert "; nobody waits for the answers of 3 any more; a turn takes " in text or isolation == "process"
    assert re.search(r"Its child worker does not get on.*; 3 messages wait for it, one for", await said(system, "/app"))


async def test_a_mailbox_that_grows(system: hf.ActorSystem) -> None:
    ref = await system.start(worker(shutdown="brutal_kill"))
    ref.tell(Do("wait"))
    for _ in range(150):
        ref.tell(Do("well"))

    async def feed() -> None:
        while True:
            ref.tell(Do("well"))
            await asyncio.sleep(0.01)

    feeding = asyncio.create_task(feed())
    assert "messages wait in its mailbox, and they become more" in await said(system, ref)
    feeding.cancel()


async def test_replicas(system: hf.ActorSystem) -> None:
    spec = worker(mechanism=hf.ftm.PBR())
    ref = await system.start(spec)
    await ref.ask(Do("well"))
    await until(lambda: "ReplicaJoined" in {event.kind for event in system.history(ref).events}, 30.0)
    os.kill(system.pid_of(ref), signal.SIGKILL)
    await ref.ask(Do("well"), 30.0)
    text = await said(system, ref)
    assert "Replica r1 was lost " in text
    assert "Replica r2 took over " in text
    assert ", in epoch 2: its process has ended (SIGKILL)." in text
    assert "Of its child worker, a replica was lost " in await said(system, "/app")
    await until(lambda: len([one for one in system.history(ref).events if one.kind == "ReplicaJoined"]) > 1, 30.0)
    text = await said(system, ref)  # It is back, and what has happened is told all the same.
    assert "Replica r1 was lost " in text
    assert "It is whole again, for r1 came back " in text
    assert text.endswith("r1 follows, r2 leads, epoch 2.")
    assert any(life.by == "failover" for life in system.lives(ref))


async def test_a_supervisor_that_gave_up_or_shut_itself_down_has_not_done_its_work(system: hf.ActorSystem) -> None:
    one = worker("one", restart="transient", significant=True)
    shop = hf.supervisor("shop", children=[one], intensity=0, auto_shutdown="any_significant", restart="transient")
    for name, order in (("gives-up", Do("crash")), ("shuts-down", Do("stop"))):
        with system.events() as events:
            ref = await system.start(dataclasses.replace(shop, id=name))
            system.ref(f"/app/{name}/one", Worker).tell(order)
            async with asyncio.timeout(20.0):
                while not any(isinstance(event, hf.events.ChildStopped) for event in events.take()):
                    await asyncio.sleep(0.01)
        text = await said(system, ref)
        wanted = "gave up" if name == "gives-up" else "by its `auto_shutdown`: its child one ended"
        assert wanted in text
        assert "ended by itself" not in text


async def test_who_gave_up_below_and_runs_again_is_in_no_trouble(system: hf.ActorSystem) -> None:
    inner = hf.supervisor("inner", children=[worker("one")], intensity=0)
    await system.start(hf.supervisor("shop", children=[inner]))
    with system.events() as events:
        system.ref("/app/shop/inner/one", Worker).tell(Do("crash"))
        await events.until(hf.events.SupervisorGaveUp)
        while (await events.until(hf.events.ActorStarted)).address != "/app/shop/inner/one":
            continue
    await until(lambda: system._history.lives.at("/app/shop/inner/one")[-1].started)  # type: ignore[union-attr]
    assert "gave up" not in await said(system, "/app")
