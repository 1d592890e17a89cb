"""The tables of the pages on supervision against real runs: each cell is a test."""

import asyncio
import re
from pathlib import Path
from typing import Any, cast

import pytest

import holdfast as hf
from holdfast.supervision.spec import Restart, Strategy
from tests.supervision.family import Boom, Family, Kid, Leave, Life, Plan, kid

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("supervision.md", "supervision-calls.md", "supervision-recovery.md")
TEXT = "\n".join((DOCS / page).read_text("utf-8") for page in PAGES)
SLOW = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)


def cells(corner: str) -> list[Any]:
    """(row, column, cell) of the table with this text in its first cell."""
    found = re.search(rf"^\| {corner} \|.*\n\|[-|]+\|\n(?:\|.*\n)+", TEXT, re.M)
    assert found, corner
    head, _, *rows = (
        [text.strip().strip("`") for text in line.strip("|").split("|")] for line in found[0].splitlines()
    )
    return [
        pytest.param(row[0], column, cell, id=f"{row[0]}-{column}")
        for row in rows
        for column, cell in zip(head[1:], row[1:], strict=True)
    ]


async def end(family: Family, name: str, how: str) -> None:
    if how == "kill":
        family.ref(name).kill()
    elif how == "crash":
        family.ref(name).tell(Boom())
    else:
        reasons = {"NORMAL": None, "SHUTDOWN": hf.SHUTDOWN, 'Shutdown("x")': hf.Shutdown("x")}
        family.ref(name).tell(Leave(reasons[how]))
    await family.rest()


@pytest.mark.parametrize(("how", "restart", "expected"), cells("end by itself"))
async def test_who_is_restarted(how: str, restart: str, expected: str) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a", restart=cast("Restart", restart)))
        await end(family, "a", how)
        state = (await family.states()).get("a")
        assert state == {"restarted": "running", "kept": "stopped", "forgotten": None}[expected]
        if expected == "restarted":
            assert await family.ref("a").ask(Life()) == 2


TOLD = {
    "untouched": [],
    "restarted": ["-sibling", "+sibling"],
    "started": ["+sibling"],
    "forgotten": ["-sibling"],
}


@pytest.mark.parametrize(("strategy", "sibling", "expected"), cells("strategy"))
async def test_what_becomes_of_siblings(strategy: str, sibling: str, expected: str) -> None:
    place, state = sibling.split(", ")
    restart: Restart = "temporary" if state == "temporary" else "permanent"
    plan = Plan()
    names = ["sibling", "x"] if place == "earlier" else ["x", "sibling"]
    async with hf.ActorSystem(log=False) as system:
        children = [kid(plan, name, restart=restart if name == "sibling" else "permanent") for name in names]
        family = await Family.start(system, plan, *children, strategy=cast("Strategy", strategy))
        if state == "stopped":
            await family.top.ask(hf.TerminateChild("sibling"))
        plan.take()
        family.ref("x").tell(Boom())
        told = [word for word in (await family.rest()).split() if word.endswith("sibling")]
        assert (
            told
            == {
                "untouched": [],
                "restarted": ["-sibling", "+sibling"],
                "started": ["+sibling"],
                "forgotten": ["-sibling"],
            }[expected]
        )
        assert ("sibling" in await family.states()) is (expected != "forgotten")


async def answer(supervisor: hf.ActorRef[Any], call: hf.Message[Any]) -> str:
    """What a call gives, in the words of the document."""
    try:
        reply = await supervisor.ask(call, 60.0)
    except hf.Refusal as no:
        return type(no).__name__
    return {hf.ActorRef: "ref", hf.ChildSpec: "spec", type(None): "None"}[type(reply)]


def call_of(name: str, plan: Plan) -> hf.Message[Any]:
    kind: Any = getattr(hf, name, None) or getattr(hf.supervision, name)
    return hf.StartChild(kid(plan, "a")) if kind is hf.StartChild else cast("hf.Message[Any]", kind("a"))


@pytest.mark.parametrize(("call", "state", "expected"), cells("call"))
async def test_admin_calls(call: str, state: str, expected: str) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        if state == "starting":
            plan.todo["a"] = [60.0]
        children = [] if state in ("unknown", "starting") else [kid(plan, "a", backoff=SLOW)]
        if state == "stopping":
            children = [hf.child("a", hf.start(Lingers))]
        family = await Family.start(system, plan, *children)
        if state == "stopped":
            await family.top.ask(hf.TerminateChild("a"))
        elif state == "restarting":
            await end(family, "a", "crash")
        elif state == "starting":
            family.top.tell(hf.StartChild(kid(plan, "a", late=True)))
        elif state == "stopping":
            family.top.tell(hf.TerminateChild("a"))
        assert (await family.states()).get("a", "unknown") == state
        assert await answer(family.top, call_of(call, plan)) == expected


@pytest.mark.parametrize(("call", "state", "expected"), cells("dynamic"))
async def test_admin_calls_to_a_dynamic_supervisor(call: str, state: str, expected: str) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        top = await system.start(hf.dynamic("top", intensity=9))
        family = Family(system, plan)
        if state != "unknown":
            one = kid(plan, "a", backoff=SLOW)
            if "recorded" in state:
                one = hf.child("a", hf.start(RecordedKid, plan, False), restart="transient", recovery=hf.hybrid())
            await top.ask(hf.StartChild(one))
        if state == "starting, restarting":
            await end(family, "a", "crash")
            state = "restarting"
        if state == "ended, recorded":
            await end(family, "a", "NORMAL")
            state = "unknown"
        assert (await family.states()).get("a", "unknown") == state
        assert await answer(top, call_of(call, plan)) == expected


class RecordedKid(Kid):
    """Has no state that is worth keeping, and is recorded."""

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop()

    def get_state(self) -> int:
        return 0

    def set_state(self, state: int) -> None: ...


class Lingers(hf.Actor):
    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(2.0)


class Ends(hf.Actor):
    """Tells whether its hook was called."""

    def __init__(self, told: list[str], how: str) -> None:
        self.told, self.how = told, how
        self.ctx.trap_exits = "trapping" in how and "or not" not in how

    def on_start(self, restored: bool) -> None:
        if "start" in self.how:
            raise OSError("no")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.told.append(str(reason))

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop(message.why)

    @hf.on(Life)
    def life(self, message: Life) -> int:
        self.ctx.link(self.ctx.find("/app/peer", hf.Actor))
        return self.ctx.life


@pytest.mark.parametrize(("how", "_column", "expected"), cells("end of a life"))
async def test_whom_on_stop_is_called_for(how: str, _column: str, expected: str) -> None:
    told: list[str] = []
    async with hf.ActorSystem(log=False) as system:
        peer = system.spawn(hf.start(hf.Actor), "peer")
        start = system.start(hf.child("a", hf.start(Ends, told, how), restart="temporary"))
        if "start" in how:
            with pytest.raises(hf.StartFailed):
                await start
        else:
            ref = await start
            await ref.ask(Life())
            if how == "kill":
                ref.kill()
            elif "told" in how:
                await system.stop(ref)
            elif "EXIT" in how:
                peer.kill()
            else:
                ref.tell(Leave() if "ctx" in how else Boom())
        await system._node.settled()
        await system._node.settled()
        assert "/app/a" not in system.tree()
        assert bool(told) is (expected == "called")


class Work(hf.Message[str]):
    crash: bool = False


class Worker(hf.Actor):
    @hf.on(Work)
    async def work(self, message: Work) -> str:
        await asyncio.sleep(2.0)
        if message.crash:
            raise ValueError("boom")
        return "done"


async def outcome(ask: asyncio.Future[str]) -> str:
    try:
        await ask
    except hf.HoldfastError as error:
        return type(error).__name__
    return "answered"


FATES: dict[str, list[str]] = {}
for parameter in cells("what happens to the child"):
    FATES.setdefault(parameter.values[0], []).append(parameter.values[2])


# That of a supervisor above has tests of its own, in test_restarted_above.py.
@pytest.mark.parametrize(("what", "expected"), [fate for fate in FATES.items() if "above" not in fate[0]])
async def test_the_fate_of_messages(what: str, expected: list[str]) -> None:
    what = what.replace("`", "")
    plan = Plan()
    restart: Restart = "temporary" if "not restarted" in what else "permanent"
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(
            system,
            plan,
            hf.child("w", hf.start(Worker), restart=restart),
            kid(plan, "sibling"),
            strategy="one_for_all" if "one_for_all" in what else "one_for_one",
            intensity=0 if "gives up" in what else 5,
            restart="temporary",
        )
        worker = system.ref("/app/top/w", Worker)
        asks = [worker.ask(Work("crash" in what and "sibling" not in what), 60.0), worker.ask(Work(), 60.0)]
        await asyncio.sleep(1.0)
        stopping: Any = None
        if what.startswith("kill"):
            worker.kill()
        elif what == "TerminateChild":
            stopping = asyncio.ensure_future(family.top.ask(hf.TerminateChild("w"), 60.0))
        elif what.startswith("a sibling's crash"):
            system.ref("/app/top/sibling", Kid).tell(Boom())
        told = [await outcome(ask) for ask in asks]
        if stopping is not None:
            await stopping
        await family.rest()
        assert [*told, await outcome(worker.ask(Work(), 60.0))] == expected
