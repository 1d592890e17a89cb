"""Runs of messages in one frame, and large arrays that are written from where they are: nobody can tell (DESIGN 4)."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.actors.process.wire.connection import RUN_BYTES
from holdfast.actors.process.wire.frame_encoder import LARGE_ARRAY

pytestmark = pytest.mark.pairs


class Number(hf.Message[int]):
    value: int
    padding: bytes = b""


class Word(hf.Message[int]):
    text: str


class All(hf.Message[list[str]]): ...


class Grids(hf.Message[list[Any]]):
    """Arrays, wherever they stand."""

    grids: list[Any]
    one: Any = None


class Keeper(hf.Actor):
    """Keeps what it gets, in order."""

    def __init__(self) -> None:
        self.got: list[str] = []

    @hf.on(Number)
    def number(self, message: Number) -> int:
        if message.value < 0:
            raise ValueError("negative")
        self.got.append(str(message.value))
        return message.value

    @hf.on(Word)
    async def word(self, message: Word) -> int:
        self.got.append(message.text)
        return len(self.got)

    @hf.on(All, readonly=True)
    def all(self, message: All) -> list[str]:
        return self.got

    @hf.on(Grids)
    def grids(self, message: Grids) -> list[Any]:
        assert all(grid.flags.writeable and grid.flags.owndata for grid in message.grids if grid.ndim)
        return [*message.grids, message.one]


@pytest.fixture(params=[None, hf.hybrid()], ids=["bare", "recorded"])
async def keeper(system: hf.ActorSystem, request: pytest.FixtureRequest) -> hf.ActorRef[Keeper]:
    return await system.start(hf.child("keeper", hf.start(Keeper), isolation="process", recovery=request.param))


@pytest.mark.parametrize("seed", range(5))
async def test_messages_of_all_kinds_and_sizes_keep_their_order(keeper: hf.ActorRef[Keeper], seed: int) -> None:
    rng, expected = random.Random(seed), []
    asks: list[Any] = []
    for step in range(2000):
        expected.append(str(step))
        match rng.randrange(6):
            case 0:
                keeper.tell(Word(str(step)))
            case 1:
                asks.append(keeper.ask(Number(step)))
            case 2:
                keeper.tell(Number(step, b"x" * rng.choice([RUN_BYTES // 8, RUN_BYTES, 3 * RUN_BYTES])))
            case _:
                keeper.tell(Number(step))
    for ask in asks:
        await ask
    assert await keeper.ask(All(), timeout=20.0) == expected, f"seed {seed}"


async def test_a_message_that_does_not_fit_is_alone_in_its_trouble(
    system: hf.ActorSystem, keeper: hf.ActorRef[Keeper]
) -> None:
    """Its neighbours in the run are handled."""
    await keeper.ask(Number(0))
    for value in (1, 2, "three", 4):
        keeper.tell(Number(value))  # type: ignore[arg-type]
    assert await keeper.ask(All()) == ["0", "1", "2", "4"]


async def test_what_cannot_be_coded_raises_at_the_call_and_the_run_goes_on(keeper: hf.ActorRef[Keeper]) -> None:
    await keeper.ask(Number(0))
    keeper.tell(Number(1))
    with pytest.raises(hf.errors.BadMessage, match="padding"):
        keeper.tell(Number(2, object()))  # type: ignore[arg-type]
    keeper.tell(Number(3))
    assert await keeper.ask(All()) == ["0", "1", "3"]


async def test_a_crash_in_the_middle_of_a_run_costs_one_message(system: hf.ActorSystem) -> None:
    """DESIGN 4: queued messages are kept."""
    ref = await system.start(hf.child("keeper", hf.start(Keeper), isolation="process", recovery=hf.fresh()))
    await ref.ask(Number(0))
    for value in (1, -1, 2, 3):
        ref.tell(Number(value))
    assert await ref.ask(All(), timeout=30.0) == ["2", "3"]


@pytest.mark.parametrize("dtype", ["u1", "f8", "complex64", "M8[s]", [("a", "i4"), ("b", "f8")]])
async def test_arrays_come_back_as_they_were(keeper: hf.ActorRef[Keeper], dtype: Any) -> None:
    size = LARGE_ARRAY // np.dtype(dtype).itemsize
    rng = np.random.default_rng(7)
    raw = rng.integers(0, 100, size=(3, size + 3), dtype="u1").astype("i8")
    large = raw.astype(dtype) if np.dtype(dtype).names is None else np.zeros((3, size), dtype)
    given = [large, large[0, :5], large.T, large[:, ::2], np.asfortranarray(large), large[:0], np.array(large[0, 0])]
    back = await keeper.ask(Grids(given, large), timeout=20.0)
    for sent, got in zip([*given, large], back, strict=True):
        assert np.array_equal(sent, np.asarray(got, dtype=sent.dtype))


async def test_an_array_that_is_too_large_is_refused_by_name(keeper: hf.ActorRef[Keeper]) -> None:
    await keeper.ask(Number(1))
    with pytest.raises(hf.errors.BadMessage, match=r"field 'one'.*the limit is"):
        keeper.tell(Grids([], np.zeros(17 * 1024 * 1024, "u1")))
    with pytest.raises(hf.errors.BadMessage, match=r"cannot be sent"):
        keeper.tell(Grids([np.zeros(LARGE_ARRAY), np.array([object()] * LARGE_ARRAY)]))
    small = np.arange(LARGE_ARRAY, dtype="u1")
    assert np.array_equal((await keeper.ask(Grids([small])))[0], small), "what was left of the refused ones is gone"
