"""Refs in a state: saved as addresses, and refs again wherever and whenever the actor lives on."""

from __future__ import annotations

import asyncio
import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.values import SavedRef, decode_value, describe_value, encode_value, state_digest
from holdfast.checkpoint.method import Method
from holdfast.checkpoint.snapshot.state_image import IMAGE_BYTES
from holdfast.checkpoint.store_tools import export_store
from tests.checkpoint.players import start
from tests.checkpoint.strikes import event, strike

MANY = 3000


class Enter(hf.Message[int]):
    who: hf.ActorRef[Any]


class Greet(hf.Message[list[str]]): ...


class Hello(hf.Message[str]): ...


class Same(hf.Message[bool]):
    who: hf.ActorRef[Any]


@dataclasses.dataclass(frozen=True)
class Seat:
    number: int
    of: hf.ActorRef[Any]


class Guest(hf.Actor):
    @hf.on(Hello)
    def hello(self, message: Hello) -> str:
        return self.ctx.path


class Room(hf.Actor):
    """Keeps who has entered, in every way in which a state may hold a value."""

    def __init__(self, padding: int = 0) -> None:
        self.members: dict[str, hf.ActorRef[Any]] = {}
        self.seats: list[Seat] = []
        self.seen: set[hf.ActorRef[Any]] = set()
        self.numbers: dict[hf.ActorRef[Any], int] = {}
        self.entered: list[Enter] = []
        self.me = self.ctx.ref
        self.many: list[tuple[hf.ActorRef[Any], str]] = [(self.ctx.ref, f"{n}") for n in range(padding)]
        self.padding = b"x" * (padding and IMAGE_BYTES)

    @hf.on(Enter)
    def enter(self, message: Enter) -> int:
        who = message.who
        self.members[who.path] = who
        self.seats.append(Seat(len(self.seats), who))
        self.seen.add(who)
        self.numbers[who] = len(self.seats)
        self.entered.append(message)
        return len(self.members)

    @hf.on(Greet)
    async def greet(self, message: Greet) -> list[str]:
        return [await who.ask(Hello()) for who in self.members.values()]

    @hf.on(Same, readonly=True)
    def same(self, message: Same) -> bool:
        who = message.who
        kept = [seat.of for seat in self.seats] + [*self.seen] + [*self.numbers] + [one.who for one in self.entered]
        own = [self.me, *(ref for ref, _ in self.many)]
        return self.members[who.path] == who and kept == [who] * 4 and own == [self.ctx.ref] * len(own)


def with_topic(state: dict[str, Any]) -> dict[str, Any]:
    """Change a state in which there are refs."""
    assert all(type(who) is hf.ActorRef for who in state["members"].values())
    return {**state, "padding": b"topic"}


async def guest_in(room: hf.ActorRef[Any], system: hf.ActorSystem) -> hf.ActorRef[Guest]:
    guest = await system.start(hf.child("guest", hf.start(Guest)))
    assert await room.ask(Enter(guest)) == 1
    return guest


def running(store: str | None = None) -> hf.ActorSystem:
    return hf.ActorSystem("app", log=False, intensity=1000, store=store)


@pytest.mark.pairs
@pytest.mark.parametrize("padding", [0, MANY])
@pytest.mark.parametrize("method", [hf.hybrid(interval=3600.0), hf.checkpoint_only(interval=3600.0)])
async def test_they_are_refs_again_in_the_next_life(
    isolation: str, store: str | None, method: Method, padding: int
) -> None:
    async with running(store) as system:
        room = await start(system, isolation, "room", hf.start(Room, padding), recovery=method, shutdown=8.0)
        guest = await guest_in(room, system)
        with system.events() as stream:
            await system.checkpoint(room)
            strike(system, room)
            recovered = await event(stream, hf.events.Recovered)
        assert recovered.replayed == 0
        assert await room.ask(Same(guest), timeout=20.0)
        assert await room.ask(Greet(), timeout=20.0) == ["/app/guest"]


async def test_they_are_refs_again_in_the_next_program_and_reach_who_starts_later(
    isolation: str, tmp_path: Path
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    for program in range(2):
        async with running(store) as system:
            room = await start(system, isolation, "room", hf.start(Room), recovery=hf.hybrid(), shutdown=8.0)
            if program == 0:
                await guest_in(room, system)
                await system.checkpoint(room)
            else:
                guest = await system.start(hf.child("guest", hf.start(Guest)))
                assert await room.ask(Same(guest))
                assert await room.ask(Greet()) == ["/app/guest"]


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["unrecorded", "recorded"])
async def test_they_go_along_to_a_process_and_back(system: hf.ActorSystem, recovery: Method | None) -> None:
    room = await system.start(hf.child("room", hf.start(Room), recovery=recovery))
    guest = await guest_in(room, system)
    for isolation in ("process", "task"):
        await system.set_isolation(room, isolation)
        assert await room.ask(Same(guest))
        assert await room.ask(Greet()) == ["/app/guest"]


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["unrecorded", "recorded"])
async def test_control_shows_and_replaces_a_state_that_holds_refs(
    system: hf.ActorSystem, isolation: str, recovery: Method | None
) -> None:
    room = await start(system, isolation, "room", hf.start(Room), recovery=recovery)
    guest = await guest_in(room, system)
    shown = await system.get_state(room)
    assert (shown["members"], shown["seen"], shown["me"]) == ({"/app/guest": guest}, {guest}, room)
    assert await shown["members"]["/app/guest"].ask(Hello()) == "/app/guest"
    assert (await system.replace_state(room, with_topic))["seats"] == [Seat(0, guest)]
    assert await room.ask(Same(guest))


async def test_another_class_takes_them_over(system: hf.ActorSystem) -> None:
    room = await system.start(hf.child("room", hf.start(Room), recovery=hf.hybrid()))
    guest = await guest_in(room, system)
    await system.suspend(room)
    await system.replace_code(room, Lobby)
    await system.resume(room)
    assert await room.ask(Same(guest))
    assert (await system.get_state(room))["topic"] == "/app/guest"


class Lobby(Room):
    schema_version = 2

    def __init__(self, padding: int = 0) -> None:
        super().__init__(padding)
        self.topic = ""

    @classmethod
    def migrate(cls, state: Any, from_version: int) -> Any:
        return {**state, "topic": state["seats"][0].of.path}


async def test_a_group_goes_back_to_the_refs_of_its_cut(isolation: str) -> None:
    async with running() as system:
        rooms = [
            await start(system, isolation, f"room{n}", hf.start(Room), recovery=hf.hybrid(), shutdown=8.0)
            for n in range(2)
        ]
        guest = await system.start(hf.child("guest", hf.start(Guest)))
        for room in rooms:
            await room.ask(Enter(guest))
        await system.checkpoint_group(rooms, name="cut")
        for room in rooms:
            await room.ask(Enter(room))
        await system.restore_group("cut")
        assert [await room.ask(Same(guest)) for room in rooms] == [True, True]
        assert await rooms[0].ask(Greet()) == ["/app/guest"]


async def test_a_kept_ref_leads_where_one_in_a_message_leads(isolation: str) -> None:
    """The guest has moved, with the address that the snapshot names: the ref leads to where it lives now."""
    async with running() as system:
        await system.start(hf.supervisor("upstairs"))
        room = await start(system, isolation, "room", hf.start(Room), recovery=hf.hybrid(), shutdown=8.0)
        guest = await guest_in(room, system)
        await system.checkpoint(room)
        async with system.transaction() as change:
            change.move(guest, "/app/upstairs")
        strike(system, room)
        assert await room.ask(Greet(), timeout=20.0) == ["/app/upstairs/guest"]
        assert await guest.ask(Hello()) == "/app/upstairs/guest"


async def test_an_export_has_them_as_addresses(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    async with running(f"sqlite:{path}") as system:
        room = await system.start(hf.child("room", hf.start(Room), recovery=hf.hybrid()))
        await guest_in(room, system)
        await system.checkpoint(room)
    records = [json.loads(json.dumps(record)) for record in export_store(path)]
    (state,) = [one["variables"] for one in records if one["record"] == "snapshot" and one["address"] == "/app/room"]
    assert state["members"] == {"/app/guest": {"ref": "/app/guest"}}
    assert state["seats"][0]["fields"] == {"number": 0, "of": {"ref": "/app/guest"}}


async def test_what_is_saved_of_a_ref_is_its_address(system: hf.ActorSystem) -> None:
    guest = await system.start(hf.child("guest", hf.start(Guest)))
    value: Any = [guest, {guest: (guest,)}, {guest}]
    read: Any = decode_value(encode_value(value))
    assert read == [
        SavedRef("/app/guest"),
        {SavedRef("/app/guest"): (SavedRef("/app/guest"),)},
        {SavedRef("/app/guest")},
    ]
    assert state_digest(read) == state_digest(value)
    assert decode_value(encode_value(read), refs=system._node.ref_at) == value
    assert describe_value(encode_value([guest])) == [("holdfast:ActorRef", (("path", "/app/guest"),))]
    with pytest.raises(
        hf.errors.UnsavableValue, match=r"the arguments\[0\]: a value of type .*ActorRef cannot be saved"
    ):
        encode_value([guest], where="the arguments", refs=False)


class Knows(hf.Actor):
    """Asks another process for something, and gives it a ref to do it with."""

    @hf.on(Enter)
    async def enter(self, message: Enter) -> int:
        return await asyncio.wait_for(self.ctx.effect(len, [message.who], isolation="process"), 20.0)


async def test_where_no_actors_are_a_ref_is_refused(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Knows), recovery=hf.hybrid()))
    with pytest.raises(hf.HoldfastError, match=r"the arguments.*ActorRef cannot be saved"):
        await one.ask(Enter(one), timeout=20.0)
