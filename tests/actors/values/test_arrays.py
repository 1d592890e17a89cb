"""Arrays, scalars and generators of numpy come back as they were."""

import random
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from holdfast.actors.values import encode_value
from tests.actors.values.samples import ARRAYS, SCALARS, again, is_same


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype.str} {array.shape} {array.strides}")
def test_array_returns_writable_with_memory_of_its_own(array: Any) -> None:
    before = array.copy()
    for result in (again(array), again({"a": [1, array]})["a"][1]):
        assert is_same(result, array)
        assert result.dtype.fields == array.dtype.fields
        assert result.dtype.isalignedstruct == array.dtype.isalignedstruct
        assert result.flags.writeable
        assert result.flags.owndata
        assert result.flags.aligned
        if array.flags.forc:
            assert result.flags.f_contiguous == array.flags.f_contiguous
        if result.size and result.dtype.itemsize:
            result[...] = np.zeros((), result.dtype)
    assert is_same(array, before)


@pytest.mark.parametrize("scalar", SCALARS, ids=lambda scalar: type(scalar).__name__)
def test_numpy_scalar_returns_with_its_type(scalar: Any) -> None:
    assert is_same(again(scalar), scalar)
    if not isinstance(scalar, np.void):
        assert is_same(again({scalar: (scalar,)}), {scalar: (scalar,)})


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_numpy_generator_goes_on_where_it_was(kind: str) -> None:
    generator = np.random.Generator(getattr(np.random, kind)(np.random.SeedSequence([1, 2**70], spawn_key=(3,))))
    generator.integers(10, size=3, dtype="u4")  # leaves half a word in the buffer
    generator.spawn(1)
    result = again(generator)
    assert type(result.bit_generator) is type(generator.bit_generator)
    for draw in (
        lambda g: g.integers(100, size=700, dtype="u4"),
        lambda g: g.normal(size=5),
        lambda g: g.spawn(2)[1].random(3),
    ):
        assert draw(result).tolist() == draw(generator).tolist()


@pytest.mark.parametrize("seed", [None, 3, np.int64(3), [1, 2**40], (1, 2), np.array([1, 2])], ids=repr)
def test_generator_keeps_the_seed_it_spawns_from(seed: Any) -> None:
    generator = np.random.default_rng(seed)
    assert again(generator).spawn(1)[0].random(3).tolist() == generator.spawn(1)[0].random(3).tolist()


def test_generators_over_one_source_stay_together() -> None:
    source = np.random.PCG64(1)
    first, second = again([np.random.Generator(source), np.random.Generator(source)])
    expected = np.random.Generator(np.random.PCG64(1)).random(2)
    assert [first.random(), second.random()] == expected.tolist()


def test_random_state_and_random_go_on_where_they_were() -> None:
    for old, draw in (
        (np.random.RandomState(1), lambda r: r.normal(size=7).tolist()),
        (random.Random(1), lambda r: [r.gauss(0, 1) for _ in range(7)]),
    ):
        draw(old)  # an odd number: one normal deviate is left over
        assert draw(again(old)) == draw(old)


def test_numpy_is_imported_for_arrays_only() -> None:
    program = (
        "import sys; from holdfast.actors.values import encode_value, decode_value\n"
        "data = encode_value({'a': (1, {2}, 3j)}); decode_value(data); assert 'numpy' not in sys.modules\n"
        f"assert decode_value(bytes.fromhex('{encode_value(np.arange(3)).hex()}')).tolist() == [0, 1, 2]"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
