"""Bindings that a supervisor in another process makes in its own `init`: known to the root, and granting nothing."""

from __future__ import annotations

import os
import signal
from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from tests.actors.process.waiting import SECONDS, next_event
from tests.system.own_init import TOP, WHO, Die, Kill, Nest, Other, Owner, Top, Where
from tests.system.trees import Stumble

# A refused or failed transaction ends with its block, which collects several steps.
# ruff: noqa: PT012

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

KINDS = ["plain", "recorded", "protected"]


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system with two actors that others can be bound to."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        for name in ("first", "other"):
            await running.start(hf.child(name, hf.start(Other)))
        yield running


async def start(system: hf.ActorSystem, kind: str) -> hf.ActorRef[Owner]:
    """Start the supervisor in its process; the one with the binding."""
    await system.start(hf.child("top", hf.start(Top, kind), isolation="process"))
    return system.ref(WHO, Owner)


async def is_held(system: hf.ActorSystem, target: str) -> bool:
    """Whether a change goes by it that the one below `top` is bound to `target`; nothing is changed."""
    why = ""
    try:
        async with system.transaction(dry_run=True) as change:
            change.remove(target)
    except hf.TransactionRefused as refused:
        why = str(refused)
    assert not why or f"{WHO}: its binding 'port' would point at {target}, which is removed" in why
    return bool(why)


async def bind(system: hf.ActorSystem, who: hf.ActorRef[Owner], target: str) -> None:
    async with system.transaction() as change:
        change.bind(who, "port", target)


@pytest.mark.parametrize("kind", KINDS)
async def test_who_is_bound_to_is_not_removed_nor_stopped(system: hf.ActorSystem, kind: str) -> None:
    await start(system, kind)
    assert await is_held(system, "/app/first")
    assert not await is_held(system, "/app/other")
    with pytest.raises(hf.TransactionRefused, match="a binding of it would point at /app/first, which is stopped"):
        async with system.transaction() as change:
            change.stop("/app/first")
    async with system.transaction() as change:  # Those below it may be bound among themselves.
        change.stop(TOP)
    assert TOP not in system.tree()


@pytest.mark.parametrize("kind", KINDS)
async def test_a_binding_is_put_back_when_its_change_is_undone(system: hf.ActorSystem, kind: str) -> None:
    who = await start(system, kind)
    with pytest.raises(hf.TransactionFailed, match="there was a stone"):
        async with system.transaction() as change:
            change.bind(who, "port", "/app/other")
            change.step(Stumble())
    assert await who.ask(Where(), timeout=SECONDS) == "/app/first"
    assert await is_held(system, "/app/first")
    assert not await is_held(system, "/app/other")


@pytest.mark.parametrize("kind", KINDS)
async def test_a_binding_is_not_taken_away_here_alone(system: hf.ActorSystem, kind: str) -> None:
    who = await start(system, kind)
    with pytest.raises(hf.TransactionRefused, match="it lives in another process, which keeps a binding"):
        async with system.transaction() as change:
            change.unbind(who, "port")
    assert await who.ask(Where(), timeout=SECONDS) == "/app/first"


@pytest.mark.parametrize("kind", KINDS)
async def test_what_is_known_is_what_is_in_force_after_a_restart(system: hf.ActorSystem, kind: str) -> None:
    who = await start(system, kind)
    await bind(system, who, "/app/other")
    assert not await is_held(system, "/app/first")
    who.tell(Die())  # The address keeps what it was bound to.
    assert await who.ask(Where(), timeout=SECONDS) == "/app/other"
    assert await is_held(system, "/app/other")
    with system.events() as events:
        os.kill(system.pid_of(system.ref(TOP, Top)), signal.SIGKILL)  # `init` is asked again.
        await next_event(events, hf.events.ActorStarted, lambda event: event.address == TOP)
    now = await system.ref(WHO, Owner).ask(Where(), timeout=SECONDS)
    assert now == ("/app/other" if kind == "protected" else "/app/first")  # The root binds replicas.
    assert await is_held(system, now)
    assert not await is_held(system, "/app/first" if kind == "protected" else "/app/other")


@pytest.mark.parametrize("kind", KINDS)
async def test_it_grants_nothing_but_what_the_root_binds(system: hf.ActorSystem, kind: str) -> None:
    who = await start(system, kind)
    with system.events() as events:
        assert "may not order /app/first" in await who.ask(Kill(), timeout=SECONDS)
        with pytest.raises(hf.TransactionFailed, match="there was a stone"):
            async with system.transaction() as change:
                change.bind(who, "port", "/app/other")
                change.step(Stumble())
        assert "may not order /app/first" in await who.ask(Kill(), timeout=SECONDS)
        await bind(system, who, "/app/other")
        assert await who.ask(Kill(), timeout=SECONDS) == ""
        assert (await next_event(events, hf.events.ChildTerminated)).address == "/app/other"
        assert hf.events.TrustBreached not in [type(event) for event in events.take()]


async def test_of_a_grandchild(system: hf.ActorSystem) -> None:
    await system.start(hf.child("top", hf.start(Nest), isolation="process"))
    who = system.ref(f"{TOP}/inner/who", Owner)
    with pytest.raises(hf.TransactionRefused, match="inner/who: its binding 'port' would point at /app/first"):
        async with system.transaction() as change:
            change.remove("/app/first")
    assert "may not order /app/first" in await who.ask(Kill(), timeout=SECONDS)
    async with system.transaction() as change:
        change.remove("/app/first")
        change.bind(who, "port", "/app/other")
    assert await who.ask(Where(), timeout=SECONDS) == "/app/other"


async def test_who_is_added_by_a_change_is_granted_what_it_is_bound_to(system: hf.ActorSystem) -> None:
    """Who is added by `StartChild` is not: whoever sent that, the root does not see what it says."""
    top = await system.start(hf.supervisor("top", isolation="process", intensity=1000))
    added = hf.child("who", hf.start(Owner), bindings={"port": "/app/first"})
    await top.ask(hf.StartChild(added), timeout=SECONDS)
    who = system.ref(WHO, Owner)
    assert "may not order /app/first" in await who.ask(Kill(), timeout=SECONDS)
    assert await is_held(system, "/app/first")
    below = [hf.child("who", hf.start(Owner), bindings={"port": "/app/other"})]
    async with system.transaction() as change:
        change.add(top, hf.supervisor("inner", children=below))
    with system.events() as events:
        assert await system.ref(f"{TOP}/inner/who", Owner).ask(Kill(), timeout=SECONDS) == ""
        assert (await next_event(events, hf.events.ChildTerminated)).address == "/app/other"
