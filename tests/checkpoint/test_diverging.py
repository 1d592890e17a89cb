"""A replay that goes another way is stopped, and the error says what is really the matter (R34, T21, T28)."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Seen, start
from tests.checkpoint.strikes import NEVER, event, strike


class Roll(hf.Message[int]): ...


class Remember(hf.Message): ...


class Recall(hf.Message): ...


class Player(hf.Actor):
    """Does what cannot be handled again."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Roll)
    def roll(self, message: Roll) -> int:
        return int.from_bytes(os.urandom(7))

    @hf.on(Remember)
    def remember(self, message: Remember) -> None:
        self._secret = self.count

    @hf.on(Recall)
    def recall(self, message: Recall) -> None:
        self.count += self._secret


async def failure(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> str:
    with system.events() as stream:
        strike(system, ref)
        return (await event(stream, hf.events.RecoveryFailed)).reason


async def player(system: hf.ActorSystem, isolation: str) -> hf.ActorRef[Player]:
    recipe, method = hf.start(Player), hf.hybrid(interval=NEVER)
    return await start(system, isolation, "player", recipe, recovery=method, backoff=hf.Backoff())


async def test_a_reply_is_part_of_what_replay_compares(isolation: str, store: str | None) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await player(system, isolation)
        ref.tell(Roll())  # Nobody has heard of this one's.
        await ref.ask(Roll(), timeout=30.0)
        why = await failure(system, ref)
        assert "turn 2: the reply to tests.checkpoint.test_diverging:Roll is not what it was" in why


async def test_replies_that_are_the_same_are_given_once(isolation: str, store: str | None) -> None:
    """Refusals, promised and forwarded ones too."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=NEVER))
        notes = await system.start(hf.child("sink", hf.start(Doer)))
        assert await ref.ask(Do(["world", "add x"]), timeout=30.0) == "4"
        with pytest.raises(hf.Refusal):
            await ref.ask(Do(["refuse so"]), timeout=30.0)
        later = ref.ask(Do(["later"]), timeout=60.0)
        assert await ref.ask(Do(["reply this"]), timeout=30.0) == "4"
        assert await later == "this"
        assert await ref.ask(Do(["forward"], notes), timeout=30.0)
        for _ in range(2):
            strike(system, ref)
            assert len(await ref.ask(Seen(), timeout=30.0)) == 4


async def test_an_exception_under_replay_is_named(isolation: str, tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        recipe, method = hf.start(Doer), hf.hybrid(interval=NEVER)
        ref = await start(system, isolation, "doer", recipe, recovery=method, backoff=hf.Backoff())
        ref.tell(Do([f"replayed {tmp_path / 'once'}"]))
        await ref.ask(Seen(), timeout=30.0)
        why = await failure(system, ref)
        assert "players:Do was handled well before the crash; handling it again raised RuntimeError" in why
        assert "it fails the second time" in why


async def test_a_variable_that_no_snapshot_holds_is_named(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await player(system, isolation)
        await ref.ask(Remember(), timeout=30.0)
        await system.checkpoint(ref, timeout=30.0)
        await ref.ask(Recall(), timeout=30.0)
        why = await failure(system, ref)
        assert "no attribute '_secret'" in why
        assert "an attribute with a leading underscore that a turn has set" in why


def of_version(number: int) -> type[hf.Actor]:
    """A class of the program, and what became of it."""

    class Program(hf.Actor):
        def __init__(self) -> None:
            self.count = 0

        if number == 1:

            @hf.on(Remember)
            def remember(self, message: Remember) -> None:
                self.count += 1

        @hf.on(Seen, readonly=True)
        def read(self, message: Seen) -> list[str]:
            return [str(self.count)]

    return Program


async def test_a_handler_that_is_gone_is_named(tmp_path: Path) -> None:
    store, why, before = f"sqlite:{tmp_path / 'app.db'}", "", list[str]()
    for version in (1, 2, 1):
        spec = hf.child("one", hf.start(of_version(version)), recovery=hf.replay_only(), restart="temporary")
        async with hf.ActorSystem("app", log=False, store=store) as system:
            if version == 1:
                ref = await system.start(spec)
                before = await ref.ask(Seen())
                ref.tell(Remember())
                assert await ref.ask(Seen()) == [str(int(before[0]) + 1)]
            else:
                with pytest.raises(hf.StartFailed) as failed:
                    await system.start(spec)
                why = str(failed.value)
    assert before == ["1"], "what was recorded has stayed"
    assert "it cannot be handled any more" in why
    assert "test_diverging.Remember" in why
    assert "deterministic" not in why


async def test_a_message_that_the_actor_does_not_know_is_a_dead_letter(isolation: str) -> None:
    """Sent from a process that does not know the class of whom it writes to."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await player(system, isolation)
        blind: hf.ActorRef[Any] = system.ref(ref.path, hf.Actor)
        other = await start(system, "process", "other", hf.start(Doer))
        with system.events() as stream:
            await other.ask(Do(["tell unknown"], blind), timeout=30.0)
            async with asyncio.timeout(30.0):
                async for one in stream:
                    if isinstance(one, hf.events.DeadLetter):
                        break
        assert await ref.ask(Roll(), timeout=30.0)
