"""The list "What differs from OTP" in docs/supervision.md: every entry has a test, and every test an entry."""

import asyncio
import re
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.family import Boom, Family, Life, Plan, kid, refused

TEXT = (Path(__file__).parents[2] / "docs" / "supervision.md").read_text("utf-8")
SLOW = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)

Test = Callable[[hf.ActorSystem], Awaitable[None]]
TESTS: dict[str, Test] = {}


def entry(what: str) -> Callable[[Test], Test]:
    def note(test: Test) -> Test:
        TESTS[what] = test
        return test

    return note


def entries() -> list[str]:
    found = re.search(r"^\| what \| in OTP \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", TEXT, re.M)
    assert found
    return [line.split(" | ")[0].removeprefix("| ") for line in found[1].splitlines()]


def test_every_entry_has_a_test_and_a_reason() -> None:
    assert entries() == list(TESTS)
    rows = re.findall(r"^\|.*\|$", TEXT[TEXT.index("| what | in OTP |") :], re.M)
    assert all(len([cell for cell in row.strip("|").split("|") if cell.strip()]) == 4 for row in rows)


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
async def _(system: hf.ActorSystem) -> None:
    plan = Plan()
    family = await Family.start(system, plan, kid(plan, "a"), kid(plan, "b"))
    assert list(await family.states()) == ["a", "b"]


@entry("calls while a child starts or stops")
async def _(system: hf.ActorSystem) -> None:
    top = await system.start(hf.supervisor("top", children=[hf.child("lingers", hf.start(Lingers))]))
    top.tell(hf.StartChild(hf.child("hangs", hf.start(Hangs))))
    top.tell(hf.TerminateChild("lingers"))
    states = {one.id: one.state for one in await top.ask(hf.WhichChildren())}
    assert states == {"lingers": "stopping", "hangs": "starting"}


@entry("calls about a child that is stopping")
async def _(system: hf.ActorSystem) -> None:
    top = await system.start(hf.supervisor("top", children=[hf.child("a", hf.start(Lingers))]))
    first = top.ask(hf.TerminateChild("a"))
    assert isinstance(await refused(top.ask(hf.RestartChild("a"))), hf.errors.ChildBusy)
    assert isinstance(await refused(top.ask(hf.DeleteChild("a"))), hf.errors.ChildBusy)
    await top.ask(hf.TerminateChild("a"))
    assert first.done()
    assert asyncio.get_running_loop().time() == 2.0


@entry("a start that never ends")
async def _(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.StartFailed, match="within 60 s"):
        await system.start(hf.child("a", hf.start(Hangs)))


@entry('`shutdown="infinity"` of a supervisor')
async def _(system: hf.ActorSystem) -> None:
    children = [hf.child("a", hf.start(Lingers, 1000.0), shutdown=10.0)]
    top = await system.start(hf.supervisor("top", children=children))
    await system.stop(top)  # More of it, also what hangs: test_never_waits.py
    assert asyncio.get_running_loop().time() == 10.0


@entry("a supervisor that is killed")
async def _(system: hf.ActorSystem) -> None:
    told: list[str] = []
    top = await system.start(hf.supervisor("top", restart="temporary", children=[hf.child("a", hf.start(Notes, told))]))
    top.kill()
    await system._node.settled()
    assert (system.tree(), told) == (["/app"], [])


@entry("a child that does not trap exits is told to stop")
async def _(system: hf.ActorSystem) -> None:
    told: list[str] = []
    await system.stop(await system.start(hf.child("a", hf.start(Notes, told))))
    assert told == ["shutdown"]


@entry("`on_stop` raises after a crash")
async def _(system: hf.ActorSystem) -> None:
    with system.events() as events:
        ref = await system.start(hf.child("a", hf.start(Fails)))
        ref.tell(Boom())
        await system._node.settled()
        (restarted,) = [event for event in events.take() if isinstance(event, hf.events.ChildRestarted)]
    assert str(restarted.reason) == "ValueError: boom"


@entry("restart window")
async def _(system: hf.ActorSystem) -> None:
    plan = Plan()
    family = await Family.start(system, plan, kid(plan, "a"), intensity=1, period=1.0)
    for _ in range(3):
        await family.after("a", Boom())
        await asyncio.sleep(1.01)
    assert (await family.states()) == {"a": "running"}


@entry("the default intensity of a dynamic supervisor")
async def _(system: hf.ActorSystem) -> None:
    plan = Plan()
    top = await system.start(hf.dynamic("top", restart="temporary"))
    ref = await top.ask(hf.StartChild(kid(plan, "a")))
    ref.tell(Boom())
    ref.tell(Boom())
    await system._node.settled()
    assert system.tree() == ["/app"]


@entry("a reference")
async def _(system: hf.ActorSystem) -> None:
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
        return self.told


@entry("monitors of one actor by another")
async def _(system: hf.ActorSystem) -> None:
    target = system.spawn(hf.start(hf.Actor), "target")
    watcher = system.spawn(hf.start(Watches, target.path))
    await watcher.ask(Watch())
    target.kill()
    await system._node.settled()
    assert await watcher.ask(Told()) == ["/app/target"]


@entry("what is wrong with a spec")
async def _(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.SpecError, match="child 'a': restart must be one of permanent, transient, temporary"):
        hf.child("a", hf.start(hf.Actor), restart=cast_any("always"))


def cast_any(value: Any) -> Any:
    return value


@entry("`GetChildSpec` of a supervisor in another process")
async def _(system: hf.ActorSystem) -> None:
    top = await system.start(
        hf.supervisor("top", isolation="process", children=[hf.child("a", hf.start(Lingers, 0.0))])
    )
    assert not isinstance(await top.ask(hf.supervision.GetChildSpec("a"), 60.0), hf.ChildSpec)


@entry("siblings while a `rest_for_one` retry waits for its back-off")
async def _(system: hf.ActorSystem) -> None:
    plan = Plan()
    children = [kid(plan, name, backoff=SLOW if name == "b" else None) for name in "abc"]
    family = await Family.start(system, plan, *children, strategy="rest_for_one")
    plan.todo["b"] = ["fail"]
    await family.after("a", Boom())
    assert await family.states() == {"a": "running", "b": "restarting", "c": "stopped"}


@entry("statistics")
async def _(system: hf.ActorSystem) -> None:
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


VIRTUAL = [what for what in TESTS if "another process" not in what]


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("what", VIRTUAL)
async def test_it_is_so(what: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        await TESTS[what](system)


@pytest.mark.parametrize("what", [what for what in TESTS if what not in VIRTUAL])
async def test_it_is_so_in_another_process(what: str) -> None:
    async with hf.ActorSystem(log=False) as system:
        await TESTS[what](system)
