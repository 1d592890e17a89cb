"""Turns that ask the world instead of their context are found: at the call, or by the state a replay leaves (T21)."""

from __future__ import annotations

import asyncio
import datetime as dt
import gc
import logging
import os
import random
import secrets
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from datetime import date, datetime
from pathlib import Path
from random import randint
from time import time as now
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from tests.checkpoint.players import start

WORLD = "a message, or ctx.pipe_to_self(),"
CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "time.time": (lambda: time.time(), "ctx.now()"),
    "time.monotonic": (lambda: time.monotonic(), "ctx.now()"),
    "time.time, imported by name": (lambda: now(), "ctx.now()"),
    "datetime.now": (lambda: datetime.now(dt.UTC), "ctx.now()"),
    "date.today": (lambda: date.today(), "ctx.now()"),
    "random.random": (lambda: random.random(), "ctx.random"),
    "random.randint": (lambda: randint(1, 6), "ctx.random"),
    "random.choice": (lambda: random.choice([1, 2]), "ctx.random"),
    "random.shuffle": (lambda: random.shuffle([1, 2, 3]), "ctx.random"),
    "random.Random": (lambda: random.Random(), "ctx.random"),
    "random.gauss": (lambda: random.gauss(), "ctx.random"),
    "uuid.uuid4": (lambda: uuid.uuid4(), "ctx.uuid()"),
    "uuid.uuid1": (lambda: uuid.uuid1(), "ctx.uuid()"),
    "os.urandom": (lambda: os.urandom(4), "ctx.random"),
    "secrets.token_hex": (lambda: secrets.token_hex(), "ctx.random"),
    "secrets.choice": (lambda: secrets.choice([1, 2]), "ctx.random"),
    "numpy.random": (lambda: np.random.rand(), "ctx.random"),
    "os.getpid": (lambda: os.getpid(), "ctx.path"),
    "os.listdir": (lambda: os.listdir("."), WORLD),
    "os.getenv": (lambda: os.getenv("HOME"), WORLD),
    "os.environ.get": (lambda: os.environ.get("HOME"), WORLD),
    "os.environ.__getitem__": (lambda: os.environ["PATH"], WORLD),
    "open": (lambda: open(os.devnull).close(), WORLD),
    "Path.read_text": (lambda: Path(__file__).read_text(), WORLD),
    "Path.exists": (lambda: Path(__file__).exists(), WORLD),
    "id": (lambda: id(object()), "ctx.path"),
    "loop.time": (lambda: asyncio.get_running_loop().time(), "ctx.now() or ctx.pipe_to_self()"),
    "asyncio.ensure_future": (lambda: asyncio.ensure_future(asyncio.Future()), "ctx.pipe_to_self()"),
}


NAMES = {
    "loop.time": "asyncio.get_running_loop",
    "secrets.choice": "random.SystemRandom.choice",
}  # where it does not call itself as it is called


class Call(hf.Message[str]):
    what: str
    swallow: bool = False
    behind_an_await: bool = False


class Fine(hf.Message[str]): ...


class Done(hf.Message): ...


class Asker(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    @hf.on(Done)
    def done(self, message: Done) -> None:
        self.count += 1

    @hf.on(Call)
    async def call(self, message: Call) -> str:
        if message.behind_an_await:
            await asyncio.sleep(0)
        try:
            CALLS[message.what][0]()
        except hf.errors.NotDeterministic:
            if not message.swallow:
                raise
        return "it was let through"

    @hf.on(Fine)
    async def fine(self, message: Fine) -> str:
        self.count += 1
        logging.getLogger("fine").debug("has a time stamp")
        self.ctx.random.randint(1, 6)
        self.ctx.random.shuffle([1, 2, 3])
        random.Random(3).random()
        {"a": 1}.get("a")
        str(np.arange(3))
        np.random.default_rng(3).random()
        dt.datetime.fromtimestamp(self.ctx.now(), dt.UTC)
        self.ctx.pipe_to_self(asyncio.sleep(0), lambda _: Done())
        async with asyncio.timeout(30.0):
            await asyncio.sleep(0)
        return f"{self.ctx.uuid().version} {asyncio.current_task() is not None}"


STRICT = hf.hybrid(interval=1000.0, strict=True)


@pytest.mark.parametrize("what", sorted(CALLS))
async def test_each_way_to_ask_the_world_is_stopped_at_the_call(system: hf.ActorSystem, what: str) -> None:
    ref = await start(system, "task", "asker", hf.start(Asker), recovery=STRICT)
    free = await start(system, "task", "free", hf.start(Asker), recovery=hf.hybrid(interval=1000.0))
    for message in (Call(what), Call(what, swallow=True), Call(what, behind_an_await=True)):
        assert await free.ask(message) == "it was let through"  # The others may do as they like, in the same process.
        with pytest.raises(hf.RemoteCrash, match="NotDeterministic") as caught:
            await ref.ask(message, timeout=20.0)
        assert f"use {CALLS[what][1]} instead" in caught.value.text
        if what != "numpy.random":
            assert NAMES.get(what, what.partition(",")[0]) in caught.value.text
            assert f"{__file__}:" in caught.value.text
        time.time()  # Nothing is left behind.


class Lives(hf.Message[int]): ...


class Reborn(hf.Actor):
    def __init__(self) -> None:
        self.first = self.ctx.life

    async def on_start(self, restored: bool) -> None:
        if restored:  # Else it is a turn, too.
            self._began = self.ctx.life

    @hf.on(Lives)
    def lives(self, message: Lives) -> int:
        return self.ctx.life


async def test_the_number_of_the_life_differs_in_a_replay(system: hf.ActorSystem, isolation: str) -> None:
    ref = await start(system, isolation, "reborn", hf.start(Reborn), recovery=STRICT)
    with pytest.raises(hf.RemoteCrash, match="NotDeterministic") as caught:
        await ref.ask(Lives(), timeout=20.0)
    assert "ctx.life was called" in caught.value.text
    assert "use a count in the state instead" in caught.value.text


async def test_a_replay_that_replies_its_life_names_that(system: hf.ActorSystem) -> None:
    ref = await start(system, "task", "reborn", hf.start(Reborn), recovery=hf.hybrid(interval=1000.0))
    with system.events() as events:
        assert await ref.ask(Lives(), timeout=20.0) == 1
        ref._cell.kill()
        failed = await events.until(hf.events.RecoveryFailed, timeout=20.0)
    assert "ctx.life" in failed.reason


async def test_where_it_lives_does_not_matter(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await start(system, isolation, "asker", hf.start(Asker), recovery=STRICT)
        with pytest.raises(hf.RemoteCrash, match=r"time\.time was called at"):
            await ref.ask(Call("time.time"), timeout=20.0)
        assert await ref.ask(Fine(), timeout=20.0) == "4 True"


async def test_what_comes_from_the_context_and_what_is_not_the_turns_own_is_let_through(
    system: hf.ActorSystem,
) -> None:
    ref = await start(system, "task", "asker", hf.start(Asker), recovery=STRICT)
    assert await ref.ask(Fine()) == "4 True"
    ref.kill()
    assert await ref.ask(Fine(), timeout=20.0) == "4 True"  # It was replayed, strictly.


LAZY = """
import sys, holdfast as hf, numpy
from holdfast.checkpoint.life.determinism_guard import DeterminismGuard, NotDeterministic
assert "numpy.random" not in sys.modules
try:
    DeterminismGuard().call(lambda: numpy.random.rand())
except NotDeterministic:
    print("caught")
"""


def test_the_first_use_of_numpys_generator_is_seen_too() -> None:
    """numpy loads it then only."""
    run = subprocess.run([sys.executable, "-c", LAZY], capture_output=True, text=True, timeout=60.0, check=False)
    assert run.stdout == "caught\n", run.stderr


class Put(hf.Message[list[str]]):
    text: str
    quirk: str = ""


class Forgetful(hf.Actor):
    """Its state depends on a file outside."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.names: set[str] = set()

    @hf.on(Put)
    def put(self, message: Put) -> list[str]:
        if message.quirk and Path(message.quirk).exists():
            self.texts.append("quirk")
        self.texts.append(message.text)
        self.names.add(message.text)
        return self.texts


CHECKED = hf.hybrid(interval=1000.0, check_replay=True)


async def test_the_first_turn_that_a_replay_handles_otherwise_is_named(
    isolation: str, store: str | None, tmp_path: Path
) -> None:
    quirk = tmp_path / "quirk"
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await start(system, isolation, "one", hf.start(Forgetful), recovery=CHECKED, backoff=hf.Backoff())
        await ref.ask(Put("a"))
        await ref.ask(Put("b", str(quirk)))
        await ref.ask(Put("c"))
        quirk.touch()
        why = ""
        with system.events() as events:
            ref.kill()
            async with asyncio.timeout(30.0):
                async for event in events:
                    if isinstance(event, hf.events.RecoveryFailed):
                        why = event.reason
                        break
        assert "turn 2: after tests.checkpoint.test_strict:Put" in why
        quirk.unlink()
        assert await ref.ask(Put("d"), timeout=30.0) == ["a", "b", "c", "d"]


async def test_a_replay_that_leads_to_the_same_state_is_none_the_wiser(isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    for life in range(3):  # In each, sets have another order.
        async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
            ref = await start(system, isolation, "one", hf.start(Forgetful), recovery=CHECKED)
            for text in "abcdefgh":
                await ref.ask(Put(f"{life}{text}"), timeout=20.0)
            ref.kill()
            assert len(await ref.ask(Put("last"), timeout=20.0)) == 9 * life + 9


def test_the_settings_are_checked() -> None:
    wrongs: list[dict[str, Any]] = [{"strict": 1}, {"check_replay": "yes"}, {"durability": "disk"}]
    for wrong in wrongs:
        with pytest.raises(hf.SpecError, match=f"hybrid: {next(iter(wrong))} must be"):
            hf.hybrid(**wrong)


class Garbage:
    """Is in a circle, so only the collector can end it; and it asks the world then."""

    ended = 0

    def __init__(self) -> None:
        self.me = self

    def __del__(self) -> None:
        Garbage.ended += bool(time.time())


class Litter(hf.Message[int]):
    explicit: bool


class Litterer(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    @hf.on(Litter)
    async def litter(self, message: Litter) -> int:
        for _ in range(3):
            self.count += len([[Garbage()] for _ in range(2_000)])
            if message.explicit:
                gc.collect()
            await asyncio.sleep(0)
        return self.count


@pytest.mark.parametrize("explicit", [False, True])
async def test_a_turn_is_not_blamed_for_what_the_collector_runs(system: hf.ActorSystem, explicit: bool) -> None:
    calls: list[float] = []

    def others(phase: str, info: dict[str, int]) -> None:
        calls.append(time.perf_counter())

    ref = await start(system, "task", "one", hf.start(Litterer), recovery=STRICT)
    before = Garbage.ended
    gc.callbacks.append(others)
    try:
        assert await ref.ask(Litter(explicit), timeout=30.0) == 6_000
        gc.collect()
    finally:
        gc.callbacks.remove(others)
    assert calls
    assert Garbage.ended - before == 6_000
    assert gc.isenabled()
