"""What cannot be saved is refused by name, and the refusal says where it sits."""

import random
import socket
import time as clock
import types
from collections import OrderedDict, UserDict, defaultdict, deque
from collections.abc import Callable
from datetime import datetime
from typing import Any

import msgpack
import numpy as np
import pytest

from holdfast.actors.values import UnsavableValue, encode_value
from tests.actors.values.samples import (
    HERE,
    Box,
    Loose,
    MyBytes,
    MyDate,
    MyDict,
    MyFloat,
    MyInt,
    MyList,
    MySet,
    MyStr,
    MyTuple,
    MyZone,
    Node,
    Point,
    RichDict,
    Size,
    Slotted,
    again,
    cyclic_list,
    cyclic_node,
    imposter,
    is_same,
    local_class,
)

REFUSED: list[tuple[Any, str]] = [
    (lambda: {"x": [1, 2, 3, {"socket": len}]}, "['x'][3]['socket']: a value of type builtin_function_or_method"),
    (object, ": a value of type object"),
    (lambda: [is_same], "[0]: a value of type function"),
    (lambda: (1, [types]), "[1][0]: a value of type module"),
    (lambda: [int], "[0]: a value of type type"),
    (lambda: {"a": slice(1)}, "['a']: a value of type slice"),
    (lambda: [...], "[0]: a value of type ellipsis"),
    (lambda: [memoryview(b"x")], "[0]: a value of type memoryview"),
    (lambda: {memoryview(b"x"): 1}, ".keys()[0]: a value of type memoryview"),
    (lambda: [msgpack.Timestamp(1)], "[0]: a value of type msgpack.ext.Timestamp"),
    (lambda: [ValueError("x")], "[0]: a value of type ValueError"),
    (lambda: deque([1, object()]), "[1]: a value of type object"),
    (lambda: {1, (2, object())}, "{...}[1]: a value of type object"),
    (lambda: {(1, object()): 2}, ".keys()[0][1]: a value of type object"),
    (lambda: {(1,): 2, (2,): object()}, "[(2,)]: a value of type object"),
    (lambda: {"k" * 1000: object()}, "['kkkkkkkkkkkk...kkkkkkkkkkkkk']: a value of type object"),
    (lambda: OrderedDict(a=object()), "['a']: a value of type object"),
    (lambda: defaultdict(list, {1: object()}), "[1]: a value of type object"),
    (lambda: [defaultdict(lambda: 1)], "[0].default_factory: a value of type function"),
    (lambda: defaultdict(socket.socket), ".default_factory: a value of type type"),
    (lambda: [Point(1, [object()])], "[0].y[0]: a value of type object"),
    (lambda: Slotted(1, object()), "._b: a value of type object"),  # type: ignore[arg-type]
    (lambda: Loose(some_field=1, other=object()), ".other: a value of type object"),  # type: ignore[arg-type]
    (lambda: Size(1, object()), ".height: a value of type object"),
    (lambda: MyList([1]), f": a value of type {HERE}.MyList"),
    (lambda: [MyDict()], f"[0]: a value of type {HERE}.MyDict"),
    (lambda: [MyTuple()], f"[0]: a value of type {HERE}.MyTuple"),
    (lambda: [MyInt(1)], f"[0]: a value of type {HERE}.MyInt"),
    (lambda: [MyFloat(1)], f"[0]: a value of type {HERE}.MyFloat"),
    (lambda: [MyStr("x")], f"[0]: a value of type {HERE}.MyStr"),
    (lambda: {MyStr("x"): 1}, f".keys()[0]: a value of type {HERE}.MyStr"),
    (lambda: [MyBytes(b"x")], f"[0]: a value of type {HERE}.MyBytes"),
    (lambda: [MySet()], f"[0]: a value of type {HERE}.MySet"),
    (lambda: [MyDate(2020, 1, 1)], f"[0]: a value of type {HERE}.MyDate"),
    (lambda: [datetime(2020, 1, 1, tzinfo=MyZone())], f"[0].tzinfo: a value of type {HERE}.MyZone"),
    (lambda: [random.SystemRandom()], "[0]: a value of type random.SystemRandom"),
    (lambda: [RichDict(note="n")], f"[0]: a value of type {HERE}.RichDict"),
    (lambda: UserDict(a=1), ": a value of type collections.UserDict"),
    (lambda: types.MappingProxyType({}), ": a value of type mappingproxy"),
    (lambda: clock.gmtime(0), ": a value of type time.struct_time"),
    (lambda: [local_class()], f"[0]: a value of type {HERE}.local_class.<locals>.Local, whose class is not found"),
    (lambda: [imposter()], f"[0]: a value of type {HERE}.Point, whose class is not found"),
    (cyclic_list, "[1]['k'][0]: a list that contains itself"),
    (cyclic_node, f".next.next: a {HERE}.Node that contains itself"),
    (lambda: [np.array([object()])], "[0]: a numpy value of dtype object"),
    (lambda: [np.zeros(1, [("a", "O")])], "[0]: a numpy value of dtype object"),
    (lambda: np.array(["a"], np.dtypes.StringDType()), ": a numpy value of dtype StringDType()"),
    (lambda: [np.zeros(1, [("a", "i4")]).view(np.recarray)], "[0]: a value of type numpy.rec.recarray"),
    (lambda: np.zeros(1, np.dtype((np.record, [("a", "i4")]))),
     ": a numpy value of dtype (numpy.record, [('a', '<i4')])"),
    (lambda: np.ma.masked_array([1], [True]), ": a value of type numpy.ma.MaskedArray"),
    (lambda: np.zeros(1, np.dtype("i4", metadata={"a": 1})), ": a numpy value of dtype int32"),
    (lambda: [np.random.RandomState(np.random.PCG64(1))], "[0]: a value of type numpy.random.mtrand.RandomState"),
    (lambda: [np.dtype("i4")], "[0]: a value of type numpy.dtypes.Int32DType"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "text"), REFUSED, ids=[text for _, text in REFUSED])
def test_refusal_names_what_and_where(make: Callable[[], object], text: str) -> None:
    value = make()
    for encode in (
        lambda: encode_value(value, where="self.balance"),
        lambda: encode_value([1, value], where="self.balance"),
    ):
        with pytest.raises(UnsavableValue) as caught:
            encode()
        assert text.lstrip(":") in str(caught.value)
        assert str(caught.value).startswith("self.balance")
        assert "cannot be saved; make it a key variable of a supported type" in str(caught.value)
    with pytest.raises(UnsavableValue) as caught:
        encode_value(value, where="self.balance")
    if not text.startswith("{"):
        assert str(caught.value).startswith(f"self.balance{text}")


def test_refusal_is_found_behind_what_is_shared_deeper() -> None:
    shared = [1]
    with pytest.raises(UnsavableValue, match=r"^value\[2\]: a value of type object"):
        encode_value([[[[shared]]], [[[shared]]], object()])


def test_bytearray_can_grow_while_the_refusal_is_kept() -> None:
    buffer = bytearray(b"x")
    with pytest.raises(UnsavableValue) as caught:
        encode_value([buffer, buffer, object()])
    buffer.append(1)
    assert caught.value.where == "value[2]"


def test_dict_of_an_object_is_seen_through() -> None:
    box = Box(bytearray(b"x"))
    assert is_same(again([vars(box), 1]), [{"content": bytearray(b"x")}, 1])


def test_refusal_says_what_to_do() -> None:
    with socket.socket() as used, pytest.raises(UnsavableValue) as caught:
        encode_value({"x": [0, 1, 2, Box(used)]}, where="balance")
    assert str(caught.value) == (
        "balance['x'][3].content: a value of type socket.socket cannot be saved; make it a key variable of a supported "
        "type, name it with a leading underscore, or define get_state/set_state"
    )
    assert UnsavableValue(*caught.value.args) == caught.value or str(UnsavableValue(*caught.value.args)) == str(
        caught.value
    )


def content(value: Any) -> Any:
    return value.next if isinstance(value, Node) else next(iter(value.values() if isinstance(value, dict) else value))


@pytest.mark.parametrize(
    "wrap", [lambda x: [x], lambda x: {"k": x}, lambda x: (x,), Node], ids=["list", "dict", "tuple", "dataclass"]
)
def test_deep_nesting_returns_or_is_refused(wrap: Callable[[Any], Any]) -> None:
    value: Any = None
    for _ in range(100):
        value = wrap(value)
    depth, result = 0, again(value)
    while result is not None:
        result, depth = content(result), depth + 1
    assert depth == 100
    for _ in range(100_000):
        value = wrap(value)
    with pytest.raises(UnsavableValue, match=r"^v: a value that is nested too deep"):
        encode_value(value, where="v")
    while value is not None:  # freed one by one: the interpreter would do it recursively
        value = content(value)


def test_long_path_is_cut_in_the_middle() -> None:
    value: Any = object()
    for index in range(100):
        value = [value] if index else {"end": value}
    with pytest.raises(UnsavableValue) as caught:
        encode_value(value)
    assert caught.value.where.startswith("value[0][0][0]")
    assert caught.value.where.endswith("[0][0]['end']")
    assert len(caught.value.where) < 250
