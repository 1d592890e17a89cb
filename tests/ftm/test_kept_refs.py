"""Refs in a state that replicas keep: alike in all of them, and refs wherever the actor lives on."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged, Masked, StatesDiffer
from tests.ftm.test_failover import two_again

IN_TIME = 25.0


class Enter(hf.Message[int]):
    who: hf.ActorRef[Any]


class Greet(hf.Message[list[str]]): ...


class Hello(hf.Message[str]): ...


class Fail(hf.Message): ...


class Guest(hf.Actor):
    @hf.on(Hello)
    def hello(self, message: Hello) -> str:
        return self.ctx.path


class Room(hf.Actor):
    def __init__(self) -> None:
        self.members: list[hf.ActorRef[Any]] = []
        self.seen: set[hf.ActorRef[Any]] = {self.ctx.ref}

    @hf.on(Enter)
    def enter(self, message: Enter) -> int:
        self.note(message.who)
        return len(self.seen)

    def note(self, who: hf.ActorRef[Any]) -> None:
        self.members.append(who)
        self.seen.add(who)

    @hf.on(Greet)
    async def greet(self, message: Greet) -> list[str]:
        return [await who.ask(Hello()) for who in self.members]

    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        self.members.clear()
        raise ValueError("undone")


class Telling(Room):
    """Says itself what has changed."""

    def __init__(self) -> None:
        super().__init__()
        self._new: list[hf.ActorRef[Any]] = []

    def note(self, who: hf.ActorRef[Any]) -> None:
        self._new.append(who)
        super().note(who)

    def get_delta(self) -> list[hf.ActorRef[Any]]:
        new, self._new = self._new, []
        return new

    def apply_delta(self, delta: list[hf.ActorRef[Any]]) -> None:
        self.members += delta
        self.seen.update(delta)


STACKS: dict[str, Any] = {
    "pbr": hf.ftm.PBR(),
    "lfr": hf.ftm.LFR(),
    "tmr": hf.ftm.TMR(),
    "tr": hf.ftm.TR(),
    "pbr+tr": hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
}


@pytest.mark.parametrize("kind", [Room, Telling])
@pytest.mark.parametrize("name", list(STACKS))
async def test_each_replica_has_the_same_refs_and_can_use_them(name: str, kind: type[Room]) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        guests = [await system.start(hf.child(f"guest{n}", hf.start(Guest))) for n in range(3)]
        room = await system.start(hf.child("room", hf.start(kind)))
        await room.ask(Enter(guests[0]))
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(room, STACKS[name])
        with system.events() as events:
            assert await room.ask(Enter(guests[1]), timeout=IN_TIME) == 3
            with pytest.raises(hf.RemoteCrash, match="undone"):
                await room.ask(Fail(), timeout=IN_TIME)
            assert await room.ask(Greet(), timeout=IN_TIME) == ["/app/guest0", "/app/guest1"]
            if name != "tr":
                await two_again(room)
                os.kill(system.pid_of(system.ref("/app/room/ftm/r1", hf.Actor)), signal.SIGKILL)
                assert await room.ask(Enter(guests[2]), timeout=IN_TIME) == 4
                assert await room.ask(Greet(), timeout=IN_TIME) == ["/app/guest0", "/app/guest1", "/app/guest2"]
            async with system.transaction(timeout=IN_TIME) as change:
                change.protect(room, None)
            assert [who.path for who in (await system.get_state(room))["members"]][:2] == ["/app/guest0", "/app/guest1"]
            assert await room.ask(Greet(), timeout=IN_TIME) == [who.path for who in guests[: 2 if name == "tr" else 3]]
            assert not [one for one in events.take() if isinstance(one, Diverged | StatesDiffer | Masked)]
