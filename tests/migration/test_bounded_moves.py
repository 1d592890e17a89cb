"""The mailbox of an actor that is moved again and again stays bounded, and who waits for room goes on waiting."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from tests.migration.travellers import BELOW, KINDS, Add, Seen, Traveller, take

CAPACITY = 3
IN_TIME = 60.0
ROUTE = ("process", "task", "move", "process", "move", "task", "protect", "unprotect", "process", "task", "protect")
SENT = 1000


async def begun(system: hf.ActorSystem, place: str, kind: str) -> hf.ActorRef[Traveller]:
    more: dict[str, Any] = {} if KINDS[kind] is None else {"recovery": KINDS[kind]}
    one = hf.child("one", hf.start(Traveller), mailbox=hf.bounded(CAPACITY), **more)
    isolation: Any = "process" if place == BELOW else "task"
    await system.start(hf.supervisor("here", children=[one], isolation=isolation, intensity=1000))
    await system.start(hf.supervisor("there", intensity=1000))
    return system.ref("/app/here/one", Traveller)


@pytest.mark.parametrize("place", ["a task", BELOW])
@pytest.mark.parametrize("kind", list(KINDS))
async def test_a_suspended_actor_has_no_more_in_its_mailbox_after_many_moves(kind: str, place: str) -> None:
    """A home counts one message as in hand, which it is not as long as the actor is suspended."""
    async with hf.ActorSystem("app", log=False) as system:
        one = await begun(system, place, kind)
        has_had_home = kind != "plain"
        await system.suspend(one)
        asks = [one.ask(Add(n), IN_TIME) for n in range(1, 10)]
        sends = [asyncio.ensure_future(one.send(Add(n))) for n in (SENT, SENT + 1)]
        for step in ROUTE:
            await take(system, one, step)
            has_had_home |= step == "protect"
            asks.append(one.ask(Add(len(asks) + 1), IN_TIME))
            status = await system.get_status(one)
            assert (status.state, status.queued) == ("suspended", CAPACITY + has_had_home)
            waiting: list[asyncio.Future[Any]] = [*asks, *sends]
            assert not [step for done in waiting if done.done()]
        await system.resume(one)
        await asyncio.gather(*asks, *sends)
        added = (await one.ask(Seen(), IN_TIME))["added"]
        assert [n for n in added if n < SENT] == list(range(1, len(asks) + 1))
        assert sorted(n for n in added if n >= SENT) == [SENT, SENT + 1]


@pytest.mark.parametrize("place", ["a task", BELOW])
async def test_who_gives_up_waiting_for_room_is_never_let_in(place: str) -> None:
    """What waits for room has not been admitted, wherever it waits by now: nobody handles it later."""
    async with hf.ActorSystem("app", log=False) as system:
        one = await begun(system, place, "plain")
        await system.suspend(one)
        admitted = [one.ask(Add(n), IN_TIME) for n in range(CAPACITY)]
        late = [one.ask(Add(SENT + n), 2.0) for n in range(4)]
        for step in ("process", "task", "move", "process"):
            await take(system, one, step)
        told = await asyncio.gather(*late, return_exceptions=True)
        assert [type(error) for error in told] == [hf.AskTimeout] * len(late)
        with pytest.raises(hf.AskTimeout):  # By now it is known everywhere that their time is over.
            await one.ask(Seen(), 1.0)
        await system.resume(one)
        await asyncio.gather(*admitted)
        assert (await one.ask(Seen(), IN_TIME))["added"] == list(range(CAPACITY))
