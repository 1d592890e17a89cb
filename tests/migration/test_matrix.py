"""Every actor, wherever it lives, taken to every other place: the table in docs/moves.md, cell by cell.

No cell refuses. Ways through many cells, with faults, are in `test_travels.py`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.migration.travellers import KINDS, Luggage, Stream, Traveller, path, take, tree

TEXT = (Path(__file__).parents[2] / "docs" / "moves.md").read_text("utf-8")


def cells() -> list[Any]:
    """(place, kind, step) of each cell that is a change."""
    found = re.search(r"^\| it lives in \|.*\n\|[-|]+\|\n(?:\|.*\n)+", TEXT, re.M)
    assert found, "the table of moves"
    head, _, *rows = ([text.strip().strip("`") for text in row.strip("|").split("|")] for row in found[0].splitlines())
    return [
        pytest.param(row[0], kind, step, id=f"{row[0]}-{kind}-{step}")
        for row in rows
        for step, cell in zip(head[1:], row[1:], strict=True)
        for kind in KINDS
        if cell != "–"
    ]


def test_the_table_refuses_nothing() -> None:
    rows = re.findall(r"^\| (?:a task|a process|replicas).*$", TEXT, re.M)
    assert len(rows) == 6
    assert not [row for row in rows if re.search(r"\| no\b", row)]


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        await running.start(hf.supervisor("there", intensity=1000))
        yield running


@pytest.mark.pairs
@pytest.mark.parametrize(("place", "kind", "step"), cells())
@pytest.mark.some(16)
async def test_an_actor_is_taken_there_with_all_it_has(
    system: hf.ActorSystem, place: str, kind: str, step: str
) -> None:
    """Under a stream of asks and tells, with a stash, a timer, a link, a bounded mailbox and a reply that it owes."""
    await system.start(tree(place, kind))
    ref = system.ref(path(place), Traveller)
    luggage, stream = Luggage(system, ref), Stream(ref)
    await luggage.pack()
    await stream.reached(20)
    await take(system, ref, step)
    await stream.reached(20)
    await stream.stop()
    seen = await luggage.unpack()
    stream.judge(seen["added"])
