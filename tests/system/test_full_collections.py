"""A tree that starts is looked at by few full garbage collections, and nothing is left of that behind it."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

import holdfast as hf

Thresholds = tuple[int, int, int]


class Looks(hf.Actor):
    """Knows how often is collected while it starts."""

    def __init__(self, seen: list[Thresholds], *, fails: bool = False) -> None:
        seen.append(gc.get_threshold())
        if fails:
            raise ValueError("no")


@pytest.fixture
def usual() -> Iterator[Thresholds]:
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield 700, 10, 10
    gc.set_threshold(*before)


@pytest.mark.parametrize("fails", [False, True])
async def test_full_collections_are_rare_while_a_tree_starts(
    system: hf.ActorSystem, usual: Thresholds, fails: bool
) -> None:
    seen: list[Thresholds] = []
    start = system.start(hf.child("one", hf.start(Looks, seen, fails=fails)))
    if fails:
        with pytest.raises(hf.errors.StartFailed):
            await start
    else:
        await start
    assert seen == [(700, 10, 1_000)]
    assert gc.get_threshold() == usual


@pytest.mark.parametrize("own", [(700, 10, 5_000), (700, 10, 0), (0, 0, 0)])
async def test_what_a_program_has_set_itself_stays(system: hf.ActorSystem, usual: Thresholds, own: Thresholds) -> None:
    gc.set_threshold(*own)
    seen: list[Thresholds] = []
    await system.start(hf.child("one", hf.start(Looks, seen)))
    assert seen == [own]
    assert gc.get_threshold() == own


class Sets(hf.Actor):
    def __init__(self) -> None:
        gc.set_threshold(900, 10, 10)


async def test_what_is_set_meanwhile_stays(system: hf.ActorSystem, usual: Thresholds) -> None:
    await system.start(hf.child("one", hf.start(Sets)))
    assert gc.get_threshold() == (900, 10, 10)
