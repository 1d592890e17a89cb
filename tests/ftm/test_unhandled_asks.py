"""An ask whose time is over says that it was not handled, where that is sure: in a queue, at a proxy, in a process."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf

ASKS = 12


class Hold(hf.Message[int]):
    """Block the process, no other turn runs, until there is a file."""

    path: str


class Count(hf.Message[int]): ...


class Slow(hf.Actor):
    def __init__(self) -> None:
        self.turns = 0

    @hf.on(Hold)
    def hold(self, message: Hold) -> int:
        Path(message.path + ".held").touch()
        while not Path(message.path).exists():
            time.sleep(0.001)  # It is the process that is blocked; nobody waits for a time.
        self.turns += 1
        return self.turns

    @hf.on(Count)
    def count(self, message: Count) -> int:
        self.turns += 1
        return self.turns


PLACES: dict[str, dict[str, Any]] = {
    "process": {"isolation": "process"},
    "pbr": {"mechanism": hf.ftm.PBR()},
    "lfr": {"mechanism": hf.ftm.LFR()},
    "recorded_pbr": {"mechanism": hf.ftm.PBR(), "recovery": hf.hybrid()},
}


@pytest.mark.parametrize("place", sorted(PLACES))
async def test_what_waits_behind_a_turn_that_blocks_was_not_handled(
    system: hf.ActorSystem, place: str, tmp_path: Path
) -> None:
    ref = await system.start(hf.child("slow", hf.start(Slow), **PLACES[place]))
    blocked = asyncio.ensure_future(ref.ask(Hold(str(tmp_path / "go")), timeout=120))
    async with asyncio.timeout(60):
        while not (tmp_path / "go.held").exists():
            await asyncio.sleep(0.001)
    asked = [ref.ask(Count(), timeout=0.05) for _ in range(ASKS)]
    late = await asyncio.gather(*asked, return_exceptions=True)
    (tmp_path / "go").touch()
    assert [getattr(one, "handled", one) for one in late] == [False] * ASKS
    assert await blocked == 1
    assert await ref.ask(Count(), timeout=60) == 2, "none of them has run"


@pytest.mark.parametrize("place", sorted(PLACES))
@pytest.mark.some(2)
async def test_what_has_begun_may_have_been_handled(system: hf.ActorSystem, place: str, tmp_path: Path) -> None:
    ref = await system.start(hf.child("slow", hf.start(Slow), **PLACES[place]))
    held = ref.ask(Hold(str(tmp_path / "go")), timeout=2.0)
    (late,) = await asyncio.gather(held, return_exceptions=True)
    (tmp_path / "go").touch()
    assert isinstance(late, hf.AskTimeout)
    has_run = await ref.ask(Count(), timeout=60) == 2
    if has_run:  # On a machine that is too busy, it has not even begun.
        assert late.handled is None
