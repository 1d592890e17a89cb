"""Fencing tokens: what an effect gets is larger for each later life, whoever lives it, also in the next program."""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.homes import TOKEN_BITS, _first_token
from holdfast.checkpoint.journal import MemoryJournal
from holdfast.ftm import LFR, PBR, TR
from tests.effects.clerk import IN_TIME, note
from tests.effects.clerk import lines as lines_of

METHODS = {"recorded": hf.hybrid(interval=1000.0), "fresh": hf.fresh()}


class Write(hf.Message[list[int]]):
    """Write so many tokens, one in a thread; `dies`: the process is killed by the last of them, if it is the first."""

    file: str
    times: int = 2
    dies: bool = False


class Outside(hf.Message[str]): ...


def in_thread(file: str) -> int:
    note(file, f"token {hf.fencing_token()}")
    return hf.fencing_token()


async def written(file: str, dies: bool) -> int:
    token = hf.fencing_token()
    await asyncio.sleep(0)
    assert hf.fencing_token() == token
    note(file, f"token {token}")
    if dies and not Path(f"{file}.died").exists():
        Path(f"{file}.died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return token


class Writer(hf.Actor):
    @hf.on(Write)
    async def write(self, message: Write) -> list[int]:
        calls = [self.ctx.effect(written, message.file, False) for _ in range(message.times)]
        found = [*await asyncio.gather(*calls), await self.ctx.effect(in_thread, message.file)]
        return [*found, await self.ctx.effect(written, message.file, message.dies)]

    @hf.on(Outside)
    def outside(self, message: Outside) -> str:
        try:
            return str(hf.fencing_token())
        except hf.HoldfastError as error:
            return str(error)


def tokens(file: str) -> list[int]:
    return [int(line.split()[1]) for line in lines_of(file)]


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("method", METHODS)
async def test_all_effects_of_a_life_have_one_and_those_of_the_next_a_larger(
    tmp_path: Path, isolation: Any, method: str
) -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        spec = hf.child("writer", hf.start(Writer), recovery=METHODS[method], isolation=isolation, restart="permanent")
        ref = await system.start(spec)
        seen = list[int]()
        for _ in range(3):
            said = await ref.ask(Write(str(tmp_path / "world")), IN_TIME)
            assert len(set(said)) == 1
            seen.append(said[0])
            with system.events() as stream:
                ref.kill()
                async for event in stream:
                    if isinstance(event, hf.events.ActorStarted):
                        break
        assert seen == sorted(set(seen))


@pytest.mark.parametrize("stack", [(), (PBR(),), (LFR(),), (TR(),)], ids=["process", "pbr", "lfr", "tr"])
async def test_whoever_makes_an_effect_again_has_a_larger_one(tmp_path: Path, stack: tuple[Any, ...]) -> None:
    """Be it the next life or the replica that leads next, which has been there as long as the one that has died."""
    file = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        options: dict[str, Any] = {"mechanism": stack} if stack else {"isolation": "process"}
        ref = await system.start(hf.child("writer", hf.start(Writer), recovery=METHODS["recorded"], **options))
        async with asyncio.timeout(IN_TIME):
            while stack and not (await system.protection(ref)).is_whole:
                await asyncio.sleep(0.01)
        said = await ref.ask(Write(file, dies=True), IN_TIME)
        behind = await ref.ask(Write(file), IN_TIME)
    assert said[0] == said[1] == said[2] < said[3] == behind[0]
    assert tokens(file) == sorted(tokens(file))


@pytest.mark.parametrize("store", [False, True])
async def test_the_next_program_has_larger_ones(tmp_path: Path, store: bool) -> None:
    seen = list[int]()
    for _ in range(3):
        options: dict[str, Any] = {"store": f"sqlite:{tmp_path / 'app.db'}"} if store else {}
        async with hf.ActorSystem("app", log=False, **options) as system:
            ref = await system.start(hf.child("writer", hf.start(Writer), recovery=METHODS["recorded"]))
            seen += (await ref.ask(Write(str(tmp_path / "world")), IN_TIME))[:1]
    assert seen == sorted(set(seen))


def test_a_clock_that_was_set_back_makes_them_no_smaller() -> None:
    journal = MemoryJournal()
    found = [_first_token(journal, now) for now in (2e9 + 0.9, 1e9, 1e9, 2e9 + 5.5)]
    assert all(later - sooner >= 1 << TOKEN_BITS for sooner, later in itertools.pairwise(found))
    assert found[-1] >= (2 * 10**9 + 5) << TOKEN_BITS
    assert _first_token(MemoryJournal(), 4.2e9) < 1 << 63


async def test_there_is_none_outside_an_effect() -> None:
    with pytest.raises(hf.HoldfastError, match=r"ctx\.effect"):
        hf.fencing_token()
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("writer", hf.start(Writer), recovery=METHODS["recorded"]))
        assert "ctx.effect" in await ref.ask(Outside())


async def test_the_children_of_a_process_have_those_of_their_process(tmp_path: Path) -> None:
    """Also when it has begun anew."""
    file, seen = str(tmp_path / "world"), list[int]()
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        child = hf.child("writer", hf.start(Writer), recovery=hf.fresh(), restart="permanent")
        team = await system.start(hf.supervisor("team", children=[child], isolation="process", intensity=99))
        ref = system.ref("/app/team/writer", Writer)
        for ends in ("child", "process", "child"):
            seen += (await ref.ask(Write(file), IN_TIME))[:1]
            with system.events() as stream:
                if ends == "child":
                    ref.kill()
                else:
                    os.kill(system.pid_of(team), signal.SIGKILL)
                async with asyncio.timeout(IN_TIME):
                    async for event in stream:
                        if isinstance(event, hf.events.ActorStarted) and event.address == "/app/team/writer":
                            break
        seen += (await ref.ask(Write(file), IN_TIME))[:1]
    assert seen == sorted(set(seen))
