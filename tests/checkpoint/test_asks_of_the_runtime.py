"""What a recorded turn asks of a supervisor, a registry or a pool that was stopped before it: the next life answers."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Seen, until
from tests.checkpoint.runtime_player import VERBS, Clerk, Kid
from tests.checkpoint.strikes import home, let_through

IN_TIME = 15.0
IS_WHOLE = bool(os.environ.get("HOLDFAST_CROSSED"))


def asked(verb: str, isolation: Any = "task", gate: Path | None = None) -> hf.ChildSpec:
    """Whoever is asked."""
    match verb:
        case "start" | "any":
            kid = hf.child(None, hf.start(Kid, "" if gate is None else str(gate)), shutdown=0.1)
            return hf.dynamic("b", template=kid, journal=verb == "start", isolation=isolation)
        case "which":
            return hf.supervisor("b", children=[hf.child("kid", hf.start(Kid))], isolation=isolation)
        case "lookup" | "register":
            return hf.supervision.registry("b")
        case "note":
            return hf.child("b", hf.start(Doer), recovery=hf.hybrid(), isolation=isolation)
        case "pool" | "size":
            return hf.supervision.pool("b", hf.start(Kid), size=2, isolation=isolation)
        case _:
            return hf.supervision.partitions("b", hf.start(Kid), count=2, isolation=isolation)


def team(verb: str, asker: Any = "task", isolation: Any = "task", *, first: str = "a", **options: Any) -> hf.ChildSpec:
    """Whoever asks (a) is started first, unless somebody else is `first`; so it is stopped last."""
    clerk = hf.child(
        "a",
        hf.start(Clerk),
        recovery=hf.hybrid(interval=3600.0),
        isolation="process" if asker == "process" else "task",
        shutdown=4 * IN_TIME,
        mechanism=hf.ftm.PBR() if asker == "pbr" else None,
    )
    a = hf.supervisor("of-a", children=[clerk], isolation="process") if asker == "subtree" else clerk
    both = [a, asked(verb, isolation, options.pop("gate", None))]
    fragile = hf.child("fragile", hf.start(Doer), rules=[hf.rule(OSError, "escalate")])
    plain = hf.child("plain", hf.start(Doer))
    order = [fragile, plain, *(both if first == "a" else reversed(both))]
    return hf.supervisor("team", children=order, intensity=1000, **options)


@contextlib.asynccontextmanager
async def running(spec: hf.ChildSpec, store: str | None = None) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        await system.start(spec)
        yield system


def root(system: hf.ActorSystem) -> hf.ActorRef[hf.Supervisor]:
    return system.ref("/app", hf.Supervisor)


def clerk(system: hf.ActorSystem, asker: str = "task") -> hf.ActorRef[Clerk]:
    return system.ref("/app/team/of-a/a" if asker == "subtree" else "/app/team/a", Clerk)


async def restarted(system: hf.ActorSystem) -> None:
    await root(system).ask(hf.RestartChild("team", running=True), timeout=4 * IN_TIME)


async def ordered(system: hf.ActorSystem) -> None:
    await root(system).ask(hf.TerminateChild("team"), timeout=4 * IN_TIME)
    await root(system).ask(hf.RestartChild("team"), timeout=IN_TIME)


async def escalated(system: hf.ActorSystem) -> None:
    system.ref("/app/team/fragile", Doer).tell(Do(["fail"]))


async def together(system: hf.ActorSystem) -> None:
    """A sibling crashes, and all behind it are restarted with it."""
    system.ref("/app/team/plain", Doer).tell(Do(["fail"]))


HOWS: dict[str, tuple[Callable[[hf.ActorSystem], Awaitable[None]], dict[str, Any]]] = {
    "restart": (restarted, {}),
    "stop and start": (ordered, {}),
    "escalation": (escalated, {}),
    "one_for_all": (together, {"strategy": "one_for_all"}),
    "rest_for_one": (together, {"strategy": "rest_for_one"}),
}


async def heard(system: hf.ActorSystem, asker: str, verb: str) -> list[str]:
    """What the one that asks has noted, when it has an answer."""
    async with asyncio.timeout(IN_TIME):
        while True:
            with contextlib.suppress(hf.ActorStopped, hf.errors.NoSuchActor):
                seen = await clerk(system, asker).ask(Seen(), timeout=IN_TIME)
                if any(one.startswith(f"{verb}:") for one in seen):
                    return seen
            await asyncio.sleep(0.002)


async def asks(system: hf.ActorSystem, asker: str, verb: str, gate: Path) -> Callable[[], bool]:
    """Have it ask as soon as it is let through; what is returned says whether the other one has been stopped."""
    await clerk(system, asker).send(Do([f"gate {gate}", "add begun", verb]))
    await until(gate.exists, IN_TIME)
    cell = system.ref("/app/team/b", hf.Actor)._cell
    return lambda: cell.state in ("down", "gone")


FEW = [
    *(("task", "task", "restart", verb) for verb in VERBS),
    *(("task", "task", how, "start") for how in HOWS if how != "restart"),
    *(("task", "task", "one_for_all", verb) for verb in ("lookup", "pool")),
    ("task", "task", "one_for_all", "note"),
    ("process", "task", "one_for_all", "note"),
    ("process", "task", "rest_for_one", "which"),
    ("task", "process", "restart", "start"),
]
PLACES = [(a, b) for a in ("task", "process", "subtree", "pbr") for b in ("task", "process")]
ORDERS = ("start", "any")
"""What may be said from a process only to those that it is bound to."""
WHOLE = [
    (a, b, how, verb) for a, b in PLACES for how in HOWS for verb in VERBS if a == "task" or verb not in ORDERS
]  # fmt: skip


@pytest.mark.parametrize(("asker", "place", "how", "verb"), WHOLE if IS_WHOLE else FEW)
async def test_the_next_life_answers(asker: str, place: str, how: str, verb: str, tmp_path: Path) -> None:
    gate, (end, options) = tmp_path / "gate", HOWS[how]
    async with running(team(verb, asker, place, **options)) as system:
        has_ended = await asks(system, asker, verb, gate)
        ending = asyncio.ensure_future(end(system))
        await until(has_ended, IN_TIME)
        let_through(gate)
        await asyncio.wait_for(ending, IN_TIME)
        assert await heard(system, asker, verb) == ["begun", f"{verb}:{VERBS[verb]}"]


PROGRAMS = [("task", "task", verb) for verb in VERBS] + [("process", "task", "which"), ("task", "process", "any")]
WHOLE_PROGRAMS = [(a, b, verb) for a, b in PLACES for verb in VERBS if a == "task" or verb not in ORDERS]


@pytest.mark.parametrize("first", ["a", "b"] if IS_WHOLE else ["a"])
@pytest.mark.parametrize(("asker", "place", "verb"), WHOLE_PROGRAMS if IS_WHOLE else PROGRAMS)
async def test_the_next_program_asks_again(asker: str, place: str, verb: str, first: str, tmp_path: Path) -> None:
    store, gate = f"sqlite:{tmp_path / 'app.db'}", tmp_path / "gate"
    async with contextlib.AsyncExitStack() as program:
        system = await program.enter_async_context(running(team(verb, asker, place, first=first), store))
        has_ended = await asks(system, asker, verb, gate)
        ending = asyncio.ensure_future(program.aclose())
        if first == "a":
            await until(has_ended, IN_TIME)
        let_through(gate)
        await asyncio.wait_for(ending, IN_TIME)
    async with running(team(verb, asker, place, first=first), store) as system:
        assert await heard(system, asker, verb) == ["begun", f"{verb}:{VERBS[verb]}"]


@pytest.mark.parametrize("how", ["restart", "one_for_all", "program"])
async def test_a_start_that_is_under_way_is_asked_for_again(how: str, tmp_path: Path) -> None:
    """Whoever is started by its id is there already, or is started by the next life."""
    store, gate, starts = f"sqlite:{tmp_path / 'app.db'}", tmp_path / "gate", tmp_path / "starts"
    _, options = HOWS.get(how, (None, {}))
    async with contextlib.AsyncExitStack() as program:
        system = await program.enter_async_context(running(team("start", gate=starts, **options), store))
        await asks(system, "task", "start", gate)
        let_through(gate)
        await until(starts.exists, IN_TIME)
        end = program.aclose() if how == "program" else HOWS[how][0](system)
        ending = asyncio.ensure_future(end)
        cell = system.ref("/app/team/b", hf.Actor)._cell
        await until(lambda: cell.state in ("down", "gone") or cell.life > 1, IN_TIME)
        let_through(starts)
        await asyncio.wait_for(ending, IN_TIME)
        if how != "program":
            assert await heard(system, "task", "start") == ["begun", f"start:{VERBS['start']}"]
            return
    async with running(team("start"), store) as system:
        assert await heard(system, "task", "start") == ["begun", f"start:{VERBS['start']}"]


@pytest.mark.parametrize("verb", ["start", "lookup", "pool"])
async def test_without_a_store_the_turn_hears_of_the_end_of_the_program(verb: str, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with contextlib.AsyncExitStack() as program:
        system = await program.enter_async_context(running(team(verb)))
        has_ended, stream = await asks(system, "task", verb, gate), system.events()
        ending = asyncio.ensure_future(program.aclose())
        await until(has_ended, IN_TIME)
        let_through(gate)
        await asyncio.wait_for(ending, IN_TIME)
        crashed = [one for one in stream.take() if isinstance(one, hf.events.ActorCrashed)]
        assert [one.address for one in crashed] == ["/app/team/a"]
        assert "ActorStopped" in str(crashed[0].reason)


@pytest.mark.parametrize("how", ["its supervisor is forgotten", "it is stopped alone"])
async def test_the_turn_hears_that_nobody_comes_back(how: str) -> None:
    async with running(team("start")) as system:
        other = await system.start(hf.child("other", hf.start(Clerk), recovery=hf.hybrid()))
        supervisor = system.ref("/app/team", hf.Supervisor)
        with system.events() as stream:
            if how == "it is stopped alone":
                await supervisor.ask(hf.TerminateChild("b"), timeout=IN_TIME)
            else:
                await root(system).ask(hf.TerminateChild("team"), timeout=IN_TIME)
            await other.send(Do(["start"]))
            if how != "it is stopped alone":
                await until(lambda: bool(home(other).calls.asks), IN_TIME)
                await root(system).ask(hf.DeleteChild("team"), timeout=IN_TIME)
            async with asyncio.timeout(IN_TIME):
                async for one in stream:
                    if isinstance(one, hf.events.ActorCrashed):
                        assert "ActorStopped" in str(one.reason)
                        break


@pytest.mark.parametrize("asker", ["task", "process"])
async def test_who_waits_already_for_one_that_is_restarted_with_it_does_not_hold_that_up(
    asker: str, tmp_path: Path
) -> None:
    gate, other = tmp_path / "gate", tmp_path / "other"
    async with running(team("note", asker, strategy="one_for_all")) as system:
        ref = system.ref("/app/team/b", Doer)
        ref.tell(Do([f"gate {other}"]))
        await until(other.exists, IN_TIME)
        await asks(system, asker, "note", gate)
        let_through(gate)
        await until(lambda: any(source.ask is not None for source in home(ref).open.values()), IN_TIME)
        await together(system)
        await until(lambda: bool(ref._cell.extra().urgent), IN_TIME)
        let_through(other)
        assert await heard(system, asker, "note") == ["begun", "note:1"]
