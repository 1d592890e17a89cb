"""Numpy arrays, scalars and generators as plain parts, if the program has imported numpy."""

from __future__ import annotations

import functools
import math
import re
import sys
from collections.abc import Callable
from itertools import accumulate
from operator import attrgetter
from typing import Any, Final, TypeAlias, cast

from ..errors import DamagedValue, UnsavableValue
from .byte_parts import ByteParts, in_one
from .forms import ARRAY, ARRAYS, BITS, GENERATOR, RANDOM_STATE, SEED, TEXT, Blob, Make

_LAST_POSITION: Final = {"MT19937": 624, "Philox": 4, "PCG64": 0, "PCG64DXSM": 0, "SFC64": 0}
# Of numbers, text, bytes, times. Other names mean objects, or (a time unit of 0 seconds) end the process.
_SMALL: Final = 1024  # bytes of an array that are copied at once
ADOPTED: Final = 64 * 1024
"""Bytes from which on an array may stay where it was read from: a small one would keep all that memory alive."""
_DTYPE_OF: Final = attrgetter("dtype")
_SHAPE_OF: Final = attrgetter("shape")
_SIZE_OF: Final = attrgetter("nbytes")
_DTYPE: Final = re.compile(r"[<>|=]([biufcSUV]\d{1,9}|[qQ]|[mM]8(\[([1-9]\d{0,8})?[a-zA-Z]+\])?)")


def is_array(kind: type) -> bool:
    """Whether it is numpy's array: nobody has one without numpy."""
    np: Any = sys.modules.get("numpy")
    return np is not None and kind is getattr(np, "ndarray", None)


def parts_of_array(x: Any, *, in_order: bool) -> tuple[Any, tuple[int, ...], str, Blob]:
    """dtype, shape, order and bytes of an array or a scalar; `in_order` keeps Fortran order."""
    known = _plain_dtypes().get(id(x.dtype))
    is_fortran = in_order and x.ndim > 1 and x.flags.f_contiguous and not x.flags.c_contiguous
    order = "F" if is_fortran else "C"
    if known is not None and x.nbytes <= _SMALL:
        return known, x.shape, order, Blob(x.tobytes(order))
    np = _numpy()
    if x.dtype.names:  # What happens to be between its fields is left out.
        x, old = np.zeros(x.shape, x.dtype, order), x  # `zeros_like` leaves there what it finds.
        x[...] = old
    flat = np.ascontiguousarray(x.T if is_fortran else x).reshape(-1)
    return _dtype_parts(x.dtype), x.shape, order, Blob(flat.view(np.uint8) if flat.nbytes else b"")


@functools.cache
def _plain_dtypes() -> dict[int, str]:
    """The names of the dtypes of numbers, which exist once, by id."""
    dtypes = [_numpy().dtype(char) for char in "?bBhHiIlLqQefdgFDG"]
    return {id(dtype): _dtype_parts(dtype) for dtype in dtypes}


Shapes: TypeAlias = tuple[int, ...] | list[tuple[int, ...]]
"""Of some arrays: the one that all of them have, or a list of those of each."""


def arrays_parts(arrays: list[Any]) -> tuple[str, Shapes, Blob] | None:
    """dtype, shapes and bytes of arrays of numbers that have one dtype and lie in C order; None of others."""
    first = arrays[0]
    dtype = _plain_dtypes().get(id(first.dtype))
    if dtype is None or len({*map(type, arrays)}) > 1 or len({*map(id, map(_DTYPE_OF, arrays))}) > 1:
        return None
    if sum(map(_SIZE_OF, arrays)) <= len(arrays) * _SMALL:
        try:
            blob = Blob(b"".join(arrays))
        except TypeError:  # Not all of them lie in C order.
            return None
    elif all(array.flags.c_contiguous for array in arrays):
        uint8 = _numpy().uint8
        blob = Blob(*(array.reshape(-1).view(uint8) for array in arrays if array.nbytes))
    else:
        return None
    shapes = [*map(_SHAPE_OF, arrays)]
    is_one = first.ndim and first.size and shapes.count(first.shape) == len(shapes)
    return dtype, first.shape if is_one else shapes, blob


def array_form(np: Any, kind: Any, x: Any, *, in_order: bool) -> list[Any] | None:
    """A mark and the parts of `x`, or None if it is not one of numpy's; `in_order` as for an array."""
    if kind is np.str_ or kind is np.bytes_:  # as an array it would lose the NULs at its end
        return [TEXT, str.__str__(x) if kind is np.str_ else bytes(x)]
    if issubclass(kind, np.generic) and kind is x.dtype.type:
        dtype, shape, _, blob = parts_of_array(x, in_order=in_order)
        return [ARRAY, dtype, shape, "", blob]
    if kind is np.random.Generator:
        return [GENERATOR, x.bit_generator]
    if kind is np.random.RandomState and (state := x.get_state(legacy=False))["bit_generator"] == "MT19937":
        return [RANDOM_STATE, state]
    if kind.__name__ in _LAST_POSITION and kind is getattr(np.random, kind.__name__):
        return [BITS, x.state, x.seed_seq]
    if kind is np.random.SeedSequence and _is_seed(x.entropy, x.spawn_key, x.pool_size):
        return [SEED, x.entropy, x.spawn_key, x.pool_size, x.n_children_spawned]
    return None


def _numpy() -> Any:
    import numpy as np

    return np


def _dtype_parts(dtype: Any) -> Any:
    """A dtype as its name, [base, shape], or [fields, size, is aligned]."""
    parts: Any = dtype.byteorder + dtype.char if dtype.char in "qQ" else dtype.str  # longlong is not int64
    if dtype.names is not None:
        fields = [[name, _dtype_parts(dtype[name]), *dtype.fields[name][1:]] for name in dtype.names]
        parts = [fields, dtype.itemsize, dtype.isalignedstruct]
    elif dtype.subdtype is not None:
        parts = [_dtype_parts(dtype.base), dtype.shape]
    try:
        made = _make_dtype(parts)
        if (made, made.type, made.metadata) == (dtype, dtype.type, dtype.metadata):
            return parts
    except (DamagedValue, TypeError, ValueError):  # of objects, or from another library
        pass
    raise UnsavableValue("", f"a numpy value of dtype {dtype}")


@functools.lru_cache(64)
def _named_dtype(name: str) -> Any:
    if not _DTYPE.fullmatch(name):
        raise DamagedValue(f"it has an array of dtype {name}")
    return _numpy().dtype(name)


def described_dtype(description: Any) -> Any:
    """The dtype that numpy's `str` or `descr` describes: of numbers, text, bytes and times, or of fields of these.

    Raises:
        DamagedValue: it is another, or none.
    """
    if isinstance(description, str):
        return _named_dtype(description)
    if not isinstance(description, (list, tuple)) or len(description) > 1024:
        raise DamagedValue(f"it has an array of dtype {description!r}")
    fields = [_described_field(field) for field in cast("list[Any]", description)]
    return _numpy().dtype(fields)


def _described_field(field: Any) -> tuple[Any, ...]:
    name, form, *shape = field
    name = tuple(name) if isinstance(name, list) else name  # title and name
    return (name, described_dtype(form), *(tuple(one) if isinstance(one, list) else one for one in shape))


def _make_dtype(parts: Any) -> Any:
    if isinstance(parts, str):
        return _named_dtype(parts)
    np = _numpy()
    if len(parts) == 2:
        base, shape = parts
        dtype = np.dtype((_make_dtype(base), shape))
    else:
        fields, size, is_aligned = parts
        columns = {
            "names": [name for name, *_ in fields],
            "formats": [_make_dtype(form) for _, form, *_ in fields],
            "offsets": [offset for _, _, offset, *_ in fields],
            "titles": [title[0] if title else None for _, _, _, *title in fields],
        }
        dtype = np.dtype({**columns, "itemsize": size}, align=is_aligned)
    if dtype.hasobject:  # Numpy would take its bytes for addresses.
        raise DamagedValue(f"it has an array of dtype {dtype}")
    return dtype


def copied(array: Any, order: str = "C") -> Any:
    """An array that owns its memory."""
    return array.copy(order)


def kept(array: Any, order: str = "C") -> Any:
    """A large array where it lies, if that is a place for one; of others a copy."""
    return array if array.nbytes >= ADOPTED and array.flags.aligned else array.copy(order)


Own: TypeAlias = Callable[..., Any]
"""Makes of an array that lies in what is read one that stays."""


def _make_array(dtype: Any, shape: Any, order: Any, data: memoryview | ByteParts, *, own: Own = copied) -> Any:
    made = _make_dtype(dtype)
    if _size(shape, made) != len(data):
        raise DamagedValue(f"it has {len(data)} bytes for an array of shape {shape} and dtype {made}")
    array = own(_numpy().ndarray(shape, made, in_one(data), order=order or "C"), order or "C")
    if array.shape != shape:
        raise DamagedValue(f"it has an array of shape {shape}")
    return array if order else array[()]


def _size(shape: Any, dtype: Any) -> int:
    """The number of bytes of an array of this shape and type."""
    sizes = cast("tuple[int, ...]", shape if type(shape) is tuple else (-1,))
    if min(sizes, default=0) < 0:  # Numpy would take -1 for "as many as there are", and divide by the size of an item.
        raise DamagedValue(f"it has an array of shape {shape}")
    return math.prod(sizes) * int(dtype.itemsize)


def _make_arrays(
    dtype: str, shapes: Shapes, data: memoryview | ByteParts, *others: Any, own: Own = copied
) -> list[Any]:
    """The arrays of `arrays_parts`; `others` are positions, and what stands there instead."""
    made, ndarray, size = _named_dtype(dtype), _numpy().ndarray, len(data)
    each, views = shapes, iter(())
    if type(shapes) is list:
        ends = [*accumulate((_size(shape, made) for shape in shapes), initial=0)]
        if ends[-1] != size:
            raise DamagedValue(f"it has {size} bytes for arrays of {ends[-1]}")
        if not isinstance(data, ByteParts):
            views = (ndarray(shape, made, data, begin) for shape, begin in zip(shapes, ends, strict=False))
    else:
        one = _size(shapes, made)
        if not shapes or not one or size % one:  # Arrays of no bytes could be any number.
            raise DamagedValue(f"it has {size} bytes for arrays of shape {shapes} and dtype {made}")
        each = [cast("tuple[int, ...]", shapes)] * (size // one)
        if not isinstance(data, ByteParts):
            views = ndarray((len(each), *shapes), made, data)
    if isinstance(data, ByteParts):
        views = (ndarray(shape, made, in_one(data.take(_size(shape, made)))) for shape in each)
    arrays = [*map(own, views)]
    for position, other in zip(others[::2], others[1::2], strict=True):
        arrays[position] = other
    return arrays


def _make_text(text: str | bytes) -> Any:
    kinds = {str: _numpy().str_, bytes: _numpy().bytes_}
    return kinds[type(text)](text)


def _make_bits(state: dict[str, Any], seed: Any) -> Any:
    kind, position = state["bit_generator"], state.get("buffer_pos", state["state"].get("pos", 0))
    if not 0 <= position <= _LAST_POSITION[kind]:  # Numpy does not check, and would read what is there.
        raise DamagedValue(f"it has a {kind} at position {position}")
    if not all(isinstance(words, int | _numpy().ndarray) for words in state["state"].values()):
        raise DamagedValue(f"it has a {kind} without a state")
    bits = getattr(_numpy().random, kind)(0 if seed is None else seed)
    bits.state = state
    return bits


def _is_seed(entropy: Any, spawn_key: tuple[int, ...], pool_size: int) -> bool:
    np = _numpy()
    words: Any = entropy if type(entropy) in (list, tuple, np.ndarray) else [0 if entropy is None else entropy]
    is_small = type(spawn_key) is tuple and pool_size <= 64  # Its time grows with the square of the pool.
    return is_small and all(isinstance(word, int | np.integer) for word in (*words, *spawn_key))


def _make_seed(entropy: Any, spawn_key: tuple[int, ...], pool_size: int, n_children: int) -> Any:
    if not _is_seed(entropy, spawn_key, pool_size):
        raise DamagedValue("it has a SeedSequence that is none")
    make = _numpy().random.SeedSequence
    return make(entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_children)


def _make_random_state(state: dict[str, Any]) -> Any:
    made = _numpy().random.RandomState(_make_bits(state, None))
    made.set_state(state)
    return made


ADOPT_ARRAYS: Final[dict[int, Make]] = {
    ARRAY.code: lambda parts: _make_array(*parts, own=kept),
    ARRAYS.code: lambda parts: _make_arrays(*parts, own=kept),
}
MAKE_ARRAYS: Final[dict[int, Make]] = {
    ARRAY.code: lambda parts: _make_array(*parts),
    ARRAYS.code: lambda parts: _make_arrays(*parts),
    TEXT.code: lambda parts: _make_text(*parts),
    BITS.code: lambda parts: _make_bits(*parts),
    SEED.code: lambda parts: _make_seed(*parts),
    GENERATOR.code: lambda parts: _numpy().random.Generator(*parts),
    RANDOM_STATE.code: lambda parts: _make_random_state(*parts),
}
