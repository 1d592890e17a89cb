"""While an effect is out, asks that change nothing are answered beside its turn; everything else waits."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.effects.clerk import IN_TIME, lines, note
from tests.effects.test_long_waits import end_of, running
from tests.history.players import until

PATH = "/app/poster"


class Post(hf.Message[list[str]]):
    """Make effects that last until there are files of these names, one after another, and compute before each."""

    folder: str
    names: list[str]
    at_most_once: bool = False
    seconds: float = 0.0


class See(hf.Message[list[str]]): ...


class Die(hf.Message[str]):
    folder: str


class Add(hf.Message[int]): ...


async def file_there(folder: str, name: str) -> str:
    note(f"{folder}/begun", name)
    while not Path(folder, name).exists():
        await asyncio.sleep(0.005)
    return name


def wait_for_file(folder: str, name: str) -> str:
    return asyncio.run(file_there(folder, name))


THERE: dict[bool, Callable[[str, str], Any]] = {True: wait_for_file, False: file_there}
"""What waits for a file, in a thread and not."""


class Poster(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[str] = []

    @hf.on(Post)
    async def post(self, message: Post) -> list[str]:
        for name in message.names:
            self.seen.append(f"to {name}")
            time.sleep(message.seconds)
            there = THERE[name == "in a thread"]
            done = await self.ctx.effect(there, message.folder, name, key=name, at_most_once=message.at_most_once)
            self.seen.append(done)
        return self.seen

    @hf.on(See, readonly=True)
    def see(self, message: See) -> list[str]:
        return self.seen

    @hf.on(Die, readonly=True)
    def die(self, message: Die) -> str:
        if note(f"{message.folder}/died", "x") == 1:
            os.kill(os.getpid(), 9)
        return self.seen[-1]

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append("added")
        return len(self.seen)


def poster(isolation: Any = "task", **options: Any) -> hf.ChildSpec[Poster]:
    method = options.pop("recovery", hf.hybrid(interval=1000.0))
    return hf.child("poster", hf.start(Poster), isolation=isolation, recovery=method, **options)


async def begun(folder: Path, times: int) -> None:
    await until(lambda: len(lines(folder / "begun")) >= times)


@pytest.mark.parametrize("recovery", [hf.hybrid(interval=1000.0), hf.hybrid(strict=True)])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_it_is_seen_what_there_was_before_the_effect_and_all_else_waits(
    tmp_path: Path, isolation: str, recovery: Any
) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(poster(isolation, recovery=recovery))
        asked = ref.ask(Post(str(tmp_path), ["a", "b"]), IN_TIME)
        early, added = ref.ask(See(), IN_TIME), ref.ask(Add(), IN_TIME)
        assert await early == ["to a"]
        assert await ref.ask(See(), IN_TIME) == ["to a"]
        (tmp_path / "a").touch()
        await begun(tmp_path, 2)
        assert await ref.ask(See(), IN_TIME) == ["to a", "a", "to b"]
        assert not added.done()
        (tmp_path / "b").touch()
        assert await asked == ["to a", "a", "to b", "b"]
        assert await added == 5
        assert ref._cell.life == 1


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_kills_between_all_steps_change_nothing(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(poster(isolation))
        asked = asyncio.ensure_future(ref.ask(Post(str(tmp_path), list("abc"), seconds=0.05), IN_TIME))
        said, count = list[str](), 0
        for name in "abc":
            said.append(f"to {name}")
            count += 1
            await begun(tmp_path, count)
            seen = [ref.ask(See(), IN_TIME)]
            await end_of(system, isolation, PATH)
            count += 1
            while not seen[0].done():  # Whoever asks while the next life comes so far again sees nothing older.
                seen.append(ref.ask(See(), IN_TIME))
                await asyncio.sleep(0.001)
            await begun(tmp_path, count)
            assert all(one == said for one in await asyncio.gather(*seen))
            assert await ref.ask(See(), IN_TIME) == said
            (tmp_path / name).touch()
            said.append(name)
        assert await asked == said
        await end_of(system, isolation, PATH)
        assert await ref.ask(See(), IN_TIME) == said
    async with running(tmp_path, "os") as system:
        ref = await system.start(poster(isolation))
        assert await ref.ask(See(), IN_TIME) == said
        assert lines(tmp_path / "begun") == ["a", "a", "b", "b", "c", "c"]


async def test_one_that_ends_the_process_is_blamed_and_not_the_turn_with_the_effect(tmp_path: Path) -> None:
    async with running(tmp_path) as system:
        recovery = hf.hybrid(interval=1000.0, max_deliveries=1)
        ref = await system.start(poster("process", recovery=recovery))
        asked = ref.ask(Post(str(tmp_path), ["a"]), IN_TIME)
        await begun(tmp_path, 1)
        with pytest.raises(hf.Quarantined):
            await ref.ask(Die(str(tmp_path)), IN_TIME)
        await begun(tmp_path, 2)
        assert await ref.ask(See(), IN_TIME) == ["to a"]
        (tmp_path / "a").touch()
        assert await asked == ["to a", "a"]


async def test_the_process_that_dies_of_the_effect_is_still_held_against_its_turn(tmp_path: Path) -> None:
    """Of one in a thread, which may end it unseen; an async one that waits is nobody's death."""
    async with running(tmp_path) as system:
        recovery = hf.hybrid(interval=1000.0, max_deliveries=1)
        ref = await system.start(poster("process", recovery=recovery))
        asked = ref.ask(Post(str(tmp_path), ["a", "in a thread"]), IN_TIME)
        for times, seen in ((1, ["to a"]), (3, ["to a", "a", "to in a thread"])):
            await begun(tmp_path, times)
            assert await ref.ask(See(), IN_TIME) == seen
            os.kill(system.pid_of(ref), 9)
            await begun(tmp_path, 2)
            (tmp_path / "a").touch()
        with pytest.raises(hf.Quarantined):
            await asked


async def test_behind_a_mechanism_they_wait(tmp_path: Path) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(poster(mechanism=hf.ftm.PBR()))
        asked = ref.ask(Post(str(tmp_path), ["a"]), IN_TIME)
        await begun(tmp_path, 1)
        seen = ref.ask(See(), IN_TIME)
        await asyncio.sleep(0.2)
        assert not seen.done()
        (tmp_path / "a").touch()
        assert await asked == await seen == ["to a", "a"]
