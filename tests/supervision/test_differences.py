"""The tables of docs/differs-from-otp.md: every entry has a reason and a test, and every test an entry."""

import asyncio
import os
import re
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import probe
from tests.supervision.family import Boom, Family, Leave, Life, Plan, kid, refused

TEXT = (Path(__file__).parents[2] / "docs" / "differs-from-otp.md").read_text("utf-8")
SLOW = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)

Test = Callable[[hf.ActorSystem], Awaitable[None]]
TESTS: dict[str, Test] = {}
ENTRIES: dict[str, str] = {}
"""What differs, and the name of the test that shows it."""


def entry(what: str) -> Callable[[Test], Test]:
    def note(test: Test) -> Test:
        ENTRIES[what] = test.__name__
        TESTS[test.__name__] = test
        return test

    return note


def test_every_entry_has_a_test_and_a_reason() -> None:
    """The cells of a row: what differs, what OTP does, what holdfast does, why, and the test."""
    rows = [[cell.strip() for cell in row.split(" | ")] for row in re.findall(r"^\| (.+) \|$", TEXT, re.M)]
    entries = [row for row in rows if row[0] != "what"]
    assert all(len(row) == 5 and all(row) for row in entries)
    assert {row[0]: row[4].strip("`") for row in entries} == ENTRIES


class Hangs(hf.Actor):
    async def on_start(self, restored: bool) -> None:
        await asyncio.Event().wait()


class Lingers(hf.Actor):
    def __init__(self, seconds: float = 2.0) -> None:
        self.seconds = seconds

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(self.seconds)


class Fails(hf.Actor):
    def on_stop(self, reason: hf.ExitReason) -> None:
        raise OSError("disk full")

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


class Notes(hf.Actor):
    def __init__(self, told: list[str]) -> None:
        self.told = told

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.told.append(str(reason))


@entry("order of `WhichChildren`")
async def children_in_start_order(system: hf.ActorSystem) -> None:
    plan = Plan()
    family = await Family.start(system, plan, kid(plan, "a"), kid(plan, "b"))
    assert list(await family.states()) == ["a", "b"]


@entry("calls while a child starts or stops")
async def calls_are_answered(system: hf.ActorSystem) -> None:
    top = await system.start(hf.supervisor("top", children=[hf.child("lingers", hf.start(Lingers))]))
    top.tell(hf.StartChild(hf.child("hangs", hf.start(Hangs))))
    top.tell(hf.TerminateChild("lingers"))
    states = {one.id: one.state for one in await top.ask(hf.WhichChildren())}
    assert states == {"lingers": "stopping", "hangs": "starting"}


@entry("calls about a child that is stopping")
async def a_stopping_child_is_busy(system: hf.ActorSystem) -> None:
    top = await system.start(hf.supervisor("top", children=[hf.child("a", hf.start(Lingers))]))
    first = top.ask(hf.TerminateChild("a"))
    assert isinstance(await refused(top.ask(hf.RestartChild("a"))), hf.errors.ChildBusy)
    assert isinstance(await refused(top.ask(hf.DeleteChild("a"))), hf.errors.ChildBusy)
    await top.ask(hf.TerminateChild("a"))
    assert first.done()
    assert asyncio.get_running_loop().time() == 2.0


@entry("a start that never ends")
async def a_start_is_limited(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.StartFailed, match="within 60 s"):
        await system.start(hf.child("a", hf.start(Hangs)))


@entry('`shutdown="infinity"` of a supervisor')
async def infinity_of_a_supervisor_is_limited(system: hf.ActorSystem) -> None:
    children = [hf.child("a", hf.start(Lingers, 1000.0), shutdown=10.0)]
    top = await system.start(hf.supervisor("top", children=children))
    await system.stop(top)  # More of it, also what hangs: test_never_waits.py
    assert asyncio.get_running_loop().time() == 10.0


@entry("a supervisor that is killed")
async def children_are_killed_with_it(system: hf.ActorSystem) -> None:
    told: list[str] = []
    top = await system.start(hf.supervisor("top", restart="temporary", children=[hf.child("a", hf.start(Notes, told))]))
    top.kill()
    await system._node.settled()
    assert (system.tree(), told) == (["/app"], [])


@entry("a child that does not trap exits is told to stop")
async def on_stop_is_called_without_traps(system: hf.ActorSystem) -> None:
    told: list[str] = []
    await system.stop(await system.start(hf.child("a", hf.start(Notes, told))))
    assert told == ["shutdown"]


@entry("`on_stop` raises after a crash")
async def the_first_crash_is_the_reason(system: hf.ActorSystem) -> None:
    with system.events() as events:
        ref = await system.start(hf.child("a", hf.start(Fails)))
        ref.tell(Boom())
        await system._node.settled()
        (restarted,) = [event for event in events.take() if isinstance(event, hf.events.ChildRestarted)]
    assert str(restarted.reason) == "ValueError: boom"


@entry("restart window")
async def the_window_is_exact(system: hf.ActorSystem) -> None:
    plan = Plan()
    family = await Family.start(system, plan, kid(plan, "a"), intensity=1, period=1.0)
    for _ in range(3):
        await family.after("a", Boom())
        await asyncio.sleep(1.01)
    assert (await family.states()) == {"a": "running"}


@entry("restarts that take longer than the period")
async def slow_restarts_add_up(system: hf.ActorSystem) -> None:
    plan = Plan()
    plan.todo["a"] = [0.0, 7.0, 7.0]
    slow = kid(plan, "a", late=True)
    family = await Family.start(system, plan, slow, intensity=1, period=5.0, restart="temporary")
    for _ in range(2):
        await family.after("a", Boom())
        await asyncio.sleep(1.0)  # It is up again by now.
    assert not family.is_alive


@entry("children that end by one common cause")
async def one_cause_is_one_restart(system: hf.ActorSystem) -> None:
    plan, cause = Plan(), hf.ForkServerDied(1, "SIGKILL")
    family = await Family.start(system, plan, *(kid(plan, name) for name in "abc"), intensity=1, restart="temporary")
    for name in "abc":
        family.ref(name).tell(Leave(cause))
    await family.rest()
    assert (await family.states()) == {"a": "running", "b": "running", "c": "running"}
    await family.after("a", Leave(cause))  # It would not end by the same cause for ever.
    assert not family.is_alive


@entry("the default intensity of a dynamic supervisor")
async def one_default_intensity(system: hf.ActorSystem) -> None:
    plan = Plan()
    top = await system.start(hf.dynamic("top", restart="temporary"))
    ref = await top.ask(hf.StartChild(kid(plan, "a")))
    ref.tell(Boom())
    ref.tell(Boom())
    await system._node.settled()
    assert system.tree() == ["/app"]


@entry("the exit reason of a supervisor that gives up")
async def giving_up_names_the_crash(system: hf.ActorSystem) -> None:
    plan = Plan()
    top = await system.start(hf.supervisor("top", intensity=0, restart="temporary", children=[kid(plan, "a")]))
    watcher = probe(system)
    watcher.monitor(top)
    system.ref("/app/top/a", hf.Actor).tell(Boom())
    reason = (await watcher.expect_down(top)).reason
    assert reason.is_clean
    assert "the last to end was /app/top/a: ValueError: boom" in str(reason)


@entry("a reference")
async def a_ref_is_an_address(system: hf.ActorSystem) -> None:
    plan = Plan()
    family = await Family.start(system, plan, kid(plan, "a"))
    ref = family.ref("a")
    ref.tell(Boom())
    assert await ref.ask(Life()) == 2


class Watch(hf.Message[None]): ...


class Told(hf.Message[list[str]]): ...


class Watches(hf.Actor):
    def __init__(self, path: str) -> None:
        self.path, self.told = path, list[str]()

    @hf.on(Watch)
    def watch(self, message: Watch) -> None:
        target = self.ctx.find(self.path, hf.Actor)
        first, _ = self.ctx.monitor(target), self.ctx.monitor(target)
        first.cancel()

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append(source.path)

    @hf.on(Told)
    def look(self, message: Told) -> list[str]:
        return list(self.told)


@entry("monitors of one actor by another")
async def monitors_have_the_source(system: hf.ActorSystem) -> None:
    target = system.spawn(hf.start(hf.Actor), "target")
    watcher = system.spawn(hf.start(Watches, target.path))
    await watcher.ask(Watch())
    target.kill()
    await system._node.settled()
    assert await watcher.ask(Told()) == ["/app/target"]


@entry("what is wrong with a spec")
async def spec_errors_in_words(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.SpecError, match="child 'a': restart must be one of permanent, transient, temporary"):
        hf.child("a", hf.start(hf.Actor), restart=cast_any("always"))


def cast_any(value: Any) -> Any:
    return value


@entry("`GetChildSpec` of a supervisor in another process")
async def specs_from_processes_stay_packed(system: hf.ActorSystem) -> None:
    top = await system.start(
        hf.supervisor("top", isolation="process", children=[hf.child("a", hf.start(Lingers, 0.0))])
    )
    assert not isinstance(await top.ask(hf.supervision.GetChildSpec("a"), 60.0), hf.ChildSpec)


@entry("siblings while a `rest_for_one` retry waits for its back-off")
async def siblings_wait_for_the_back_off(system: hf.ActorSystem) -> None:
    plan = Plan()
    children = [kid(plan, name, backoff=SLOW if name == "b" else None) for name in "abc"]
    family = await Family.start(system, plan, *children, strategy="rest_for_one")
    plan.todo["b"] = ["fail"]
    await family.after("a", Boom())
    assert await family.states() == {"a": "running", "b": "restarting", "c": "stopped"}


@entry("statistics")
async def statistics_of_an_address(system: hf.ActorSystem) -> None:
    plan = Plan()
    family = await Family.start(system, plan, kid(plan, "a"))
    ref = family.ref("a")
    await system.statistics(ref, True)
    await ref.ask(Life())
    await family.after("a", Boom())
    await ref.ask(Life())
    found = await system.statistics(ref)
    assert found is not None
    assert (found.messages_in, found.restarts) == (3, 1)


# -- gen_server, gen_statem, gen_event -------------------------------------------------------------------------------


class Word(hf.Message):
    text: str


class Hold(hf.Message): ...


class Open(hf.Message): ...


class Scribe(hf.Actor):
    """Writes down what comes. While it is shut it puts that aside."""

    def __init__(self) -> None:
        self.told = list[str]()
        self.is_open = True

    def on_start(self, restored: bool) -> Any:
        return self.ctx.subscribe("/words")

    @hf.on(Word)
    def word(self, message: Word) -> None:
        if message.text == "crash":
            raise ValueError("crash")
        if message.text == "shut":
            self.is_open = False
        elif message.text == "later":
            self.ctx.ref.tell(Word("told itself"))
            self.ctx.tell_after(0.0, Word("time-out 0"))
        elif self.is_open:
            self.told.append(message.text)
        else:
            self.ctx.stash()

    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        await asyncio.sleep(1.0)

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Told)
    def look(self, message: Told) -> list[str]:
        return list(self.told)

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.told.append(str(reason))


class LoudScribe(Scribe):
    schema_version = 2

    @classmethod
    def migrate(cls, state: dict[str, Any], from_version: int) -> dict[str, Any]:
        assert from_version == 1
        return {**state, "told": [text.upper() for text in state["told"]]}


async def scribe(system: hf.ActorSystem, name: str = "scribe", kind: type[Scribe] = Scribe) -> hf.ActorRef[Scribe]:
    return await system.start(hf.child(name, hf.start(kind)))


@entry("a call whose caller has given up while it was queued")
async def a_late_call_is_not_handled(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    ref.tell(Hold())
    with pytest.raises(hf.AskTimeout) as late:
        await ref.ask(Word("late"), timeout=0.5)
    assert late.value.handled is False
    assert await ref.ask(Told()) == []


@entry("`gen_server:call(Pid, Msg, infinity)`")
async def no_call_waits_for_ever(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    with pytest.raises(hf.SpecError):
        await ref.ask(Told(), timeout=float("inf"))


@entry("new code and the children of a template")
async def a_template_keeps_its_class(system: hf.ActorSystem) -> None:
    top = await system.start(hf.dynamic("top", template=hf.child(None, hf.start(Scribe))))
    one = await top.ask(hf.StartChild(id="one"))
    await system.suspend(one)
    await system.replace_code(one, LoudScribe)
    await top.ask(hf.StartChild(id="two"))
    kinds = [type(system.ref(f"/app/top/{name}", Scribe)._cell.actor) for name in ("one", "two")]
    assert kinds == [LoudScribe, Scribe]


@entry("`code_change`")
async def migrate_is_of_the_new_class(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    ref.tell(Word("quiet"))
    assert await ref.ask(Told()) == ["quiet"]
    await system.suspend(ref)
    await system.replace_code(ref, LoudScribe)
    await system.resume(ref)
    assert await ref.ask(Told()) == ["QUIET"]


@entry("`exit(Pid, Reason)`")
async def others_end_an_actor_in_good_order_or_kill_it(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    actor: Any = ref._cell.actor
    assert await system.terminate(ref, hf.Shutdown("enough")) == hf.Shutdown("enough")
    assert actor.told == ["shutdown (enough)"]


@entry("`gen_event:sync_notify`")
async def who_publishes_does_not_wait_for_handlers(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    ref.tell(Hold())
    await system._node.settled()
    await system.publish("/words", Word("published"))
    actor: Any = ref._cell.actor
    assert actor.told == []
    assert await ref.ask(Told()) == ["published"]


@entry("handlers of one event")
async def handlers_have_no_order_and_a_supervisor(system: hf.ActorSystem) -> None:
    slow, quick = await scribe(system, "slow"), await scribe(system, "quick")
    slow.tell(Hold())
    await system.publish("/words", Word("one"))
    assert await quick.ask(Told()) == ["one"]  # The other one, which came first, has not seen it yet.
    quick.tell(Word("crash"))
    await system._node.settled()
    await system.publish("/words", Word("two"))
    assert await quick.ask(Told()) == ["two"]  # It was started again, and hears again.
    assert await slow.ask(Told()) == ["one", "two"]


@entry("`next_event`, and a time-out of 0")
async def what_an_actor_tells_itself_comes_behind(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    for text in ("later", "queued"):
        ref.tell(Word(text))
    await asyncio.sleep(0.1)  # Of virtual time: the time-out is a timer.
    assert await ref.ask(Told()) == ["queued", "told itself", "time-out 0"]


@entry("postponed events after a crash")
async def what_was_put_aside_outlives_a_crash(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    for text in ("shut", "aside", "crash"):
        ref.tell(Word(text))
    await system._node.settled()
    assert await ref.ask(Told()) == ["aside"]


@entry("selective `receive`, and priorities")
async def a_mailbox_is_handled_in_order(system: hf.ActorSystem) -> None:
    ref = await scribe(system)
    for text in ("first", "urgent"):
        ref.tell(Word(text))
    assert await ref.ask(Told()) == ["first", "urgent"]


class Teller(hf.Actor):
    """Tells the scribe, changes itself, and then comes to an end in the middle of its turn."""

    scribe: hf.Binding[Scribe]

    def __init__(self, seen: list[str]) -> None:
        self.seen, self.half = seen, False

    @hf.on(Word)
    def word(self, message: Word) -> None:
        self.half = True
        self.scribe.tell(Word(message.text))
        if message.text == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        raise ValueError(message.text)

    @hf.on(Told)
    def look(self, message: Told) -> list[str]:
        return ["half"] if self.half else []

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.seen.append("half" if self.half else "whole")


async def teller(
    system: hf.ActorSystem, *, seen: list[str] | None = None, **options: Any
) -> tuple[hf.ActorRef[Scribe], hf.ActorRef[Teller]]:
    to = await scribe(system)
    start = hf.start(Teller, [] if seen is None else seen)
    return to, await system.start(hf.child("teller", start, bindings={"scribe": to.path}, **options))


@entry("what a turn has sent when it crashes")
async def a_recorded_turn_that_crashes_takes_back_what_it_has_told(system: hf.ActorSystem) -> None:
    to, one = await teller(system, recovery=hf.hybrid())
    one.tell(Word("crash it"))
    assert await one.ask(Told()) == []
    assert await to.ask(Told()) == []
    await system.terminate(one)
    plain = await system.start(hf.child("plain", hf.start(Teller, []), bindings={"scribe": to.path}))
    plain.tell(Word("crash this"))
    assert await plain.ask(Told()) == []
    assert await to.ask(Told()) == ["crash this"]


@entry("what a turn has sent when its process is killed")
async def what_a_turn_has_told_leaves_its_process_behind_it(system: hf.ActorSystem) -> None:
    to, one = await teller(system, isolation="process")
    one.tell(Word("kill"))
    assert await one.ask(Told()) == []
    assert await to.ask(Told()) == []


@entry("`terminate` after a crash")
async def on_stop_sees_the_state_as_the_crash_has_left_it(system: hf.ActorSystem) -> None:
    seen: list[str] = []
    _, one = await teller(system, seen=seen)
    one.tell(Word("crash it"))
    assert await one.ask(Told()) == []
    assert seen == ["half"]


class Ticking(hf.Actor):
    def __init__(self) -> None:
        self.ticks = 0

    def on_start(self, restored: bool) -> None:
        self.ctx.every(1.0, Open())

    @hf.on(Open)
    def tick(self, message: Open) -> None:
        self.ticks += 1

    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        await asyncio.sleep(10.5)

    @hf.on(Told)
    def look(self, message: Told) -> list[str]:
        return ["tick"] * self.ticks


@entry("`timer:send_interval` of a process that is busy")
async def ticks_are_left_out_while_one_waits(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("ticking", hf.start(Ticking)))
    await ref.ask(Hold(), timeout=60.0)
    assert await ref.ask(Told()) == ["tick"]


class Link(hf.Message): ...


class Tie(hf.Message):
    path: str
    by: str


class Nap(hf.Message):
    seconds: float


class Linked(Scribe):
    def on_start(self, restored: bool) -> None:
        self.ctx.trap_exits = True

    @hf.on(Link)
    def link(self, message: Link) -> None:
        self.ctx.link(self.ctx.find(f"{self.ctx.path.rpartition('/')[0]}/other", Scribe))

    def on_exit(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason) -> None:
        self.told.append(str(reason))


@entry("a link with an actor that recovers")
async def a_link_hears_nothing_of_a_crash_that_is_recovered_from(system: hf.ActorSystem) -> None:
    ref = await scribe(system, kind=Linked)
    other = await system.start(hf.child("other", hf.start(Scribe), recovery=hf.hybrid()))
    await ref.ask(Link())
    other.tell(Word("crash"))
    await other.ask(Told())
    assert await ref.ask(Told()) == []
    await system.stop(other)
    assert await ref.ask(Told()) == ["shutdown"]


class Follows(Scribe):
    """Linked with, monitors or watches another one, and traps no exits."""

    @hf.on(Tie)
    def tie(self, message: Tie) -> None:
        other = self.ctx.find(message.path, hf.Actor)
        {"link": self.ctx.link, "monitor": self.ctx.monitor, "watch": self.ctx.watch}[message.by](other)

    @hf.on(Nap)
    async def nap(self, message: Nap) -> None:
        await asyncio.sleep(message.seconds)
        self.told.append("slept")

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        self.told.append(f"{reason}, {recovering}")


async def linked(system: hf.ActorSystem) -> hf.ActorRef[Follows]:
    """Whoever ends with `other`; its queue is empty."""
    await system.start(hf.child("other", hf.start(Scribe), restart="temporary"))
    one = await system.start(hf.child("one", hf.start(Follows), restart="temporary"))
    await one.ask(Tie(f"{one.path.rpartition('/')[0]}/other", "link"))
    return one


@entry("an EXIT that is not trapped")
async def an_exit_waits_for_its_place(system: hf.ActorSystem) -> None:
    one = await linked(system)
    one.tell(Nap(10.0))
    queued = [one.ask(Told(), 30.0) for _ in range(3)]
    begin = asyncio.get_running_loop().time()
    system.ref(f"{one.path.rpartition('/')[0]}/other").kill()
    await asyncio.sleep(1.0)
    with pytest.raises(hf.ActorStopped):
        await one.ask(Told(), 30.0)
    assert asyncio.get_running_loop().time() - begin == pytest.approx(10.0)
    assert await asyncio.gather(*queued) == 3 * [["slept"]]


@entry("an EXIT to a suspended process")
async def a_suspended_actor_ends_when_it_is_resumed(system: hf.ActorSystem) -> None:
    one = await linked(system)
    await system.suspend(one)
    system.ref(f"{one.path.rpartition('/')[0]}/other").kill()
    await asyncio.sleep(1.0)
    assert (await system.get_status(one)).state == "suspended"
    await system.resume(one)
    with pytest.raises(hf.ActorStopped):
        await one.ask(Told())


@entry("DOWN of an actor that recovers")
async def a_life_may_end_by_two_downs(system: hf.ActorSystem) -> None:
    child = hf.child("other", hf.start(Scribe), recovery=hf.hybrid())
    await system.start(hf.supervisor("team", intensity=0, restart="temporary", children=[child]))
    one = await system.start(hf.child("one", hf.start(Follows)))
    root = one.path.rpartition("/")[0]
    for by in ("monitor", "watch"):
        await one.ask(Tie(f"{root}/team/other", by))
    system.ref(f"{root}/team/other").kill()
    await asyncio.sleep(1.0)
    assert sorted(await one.ask(Told())) == ["killed, False", "killed, False", "killed, True"]


@entry("a pid of an address where nobody lives")
async def find_raises_where_nobody_lives(system: hf.ActorSystem) -> None:
    for recovery in (None, hf.hybrid()):
        one = await system.start(hf.child(f"one-{recovery}", hf.start(Follows), recovery=recovery))
        tied = one.ask(Tie(f"{one.path.rpartition('/')[0]}/nobody", "monitor"))
        if recovery is None:
            with pytest.raises(hf.RemoteCrash, match="NoSuchActor"):
                await tied
        else:
            await tied
            assert await one.ask(Told()) == ["no such actor, False"]


class LastWord(Lingers):
    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop()


@entry("`{stop, Reason, Reply, State}`")
async def a_last_reply_leaves_before_on_stop(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(LastWord, 2.0), restart="temporary"))
    begin = asyncio.get_running_loop().time()
    await one.ask(Leave())
    assert asyncio.get_running_loop().time() - begin < 2.0
    await system.stop(one)
    assert asyncio.get_running_loop().time() - begin == pytest.approx(2.0)


REAL = ["specs_from_processes_stay_packed", "what_a_turn_has_told_leaves_its_process_behind_it"]
"""Those that start a process, and so cannot live in virtual time."""


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("name", [name for name in TESTS if name not in REAL])
async def test_it_is_so(name: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        await TESTS[name](system)


@pytest.mark.parametrize("name", REAL)
async def test_it_is_so_in_another_process(name: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        await TESTS[name](system)
