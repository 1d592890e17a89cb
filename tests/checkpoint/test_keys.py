"""Key variables: what an actor's state is, how it comes back, and what is refused by name (DESIGN 6, T28)."""

from __future__ import annotations

import dataclasses
import datetime as dt
import enum
import random
from collections import Counter, OrderedDict, deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.actors.state_hooks import StateMismatch
from holdfast.actors.values import DamagedValue, SavedRef, UnsavableValue
from holdfast.checkpoint.snapshot.key_variables import restore_state, save_state


class Place:
    """Stands for `ctx`: saving asks it for the address, variables that a recovery file names, and refs of its node."""

    path = "/app/it"
    _named_variables = None
    _cell = SimpleNamespace(node=SimpleNamespace(ref_at=SavedRef))


def at_place(actor: hf.Actor) -> Any:
    actor.ctx = Place()  # type: ignore[assignment]
    return actor


def moved(actor: hf.Actor, to: hf.Actor | None = None) -> Any:
    """Save the actor's state and put it into another one of its class."""
    new = at_place(to if to is not None else type(actor)())
    restore_state(new, save_state(at_place(actor)))
    return new


class Colour(enum.Enum):
    RED = "red"


@dataclasses.dataclass
class Point:
    x: int
    y: int


class Ping(hf.Message):
    n: int


class Plain(hf.Actor):
    def __init__(self) -> None:
        self.count = 0
        self._cache = "made by __init__"


class Named(Plain):
    key_variables = ("count", "_cache")

    def __init__(self) -> None:
        super().__init__()
        self.other = "made by __init__"


class Own(hf.Actor):
    def __init__(self) -> None:
        self.items: list[int] = []
        self.lock = object()

    def get_state(self) -> tuple[int, ...]:
        return tuple(self.items)

    def set_state(self, state: tuple[int, ...]) -> None:
        self.items = list(state)


def test_the_default_is_every_attribute_without_a_leading_underscore() -> None:
    actor = Plain()
    actor.count, actor._cache = 3, "changed"
    new = moved(actor)
    assert (new.count, new._cache) == (3, "made by __init__")


def test_key_variables_name_what_is_saved() -> None:
    actor = Named()
    actor.count, actor._cache, actor.other = 3, "changed", "changed"
    new = moved(actor)
    assert (new.count, new._cache, new.other) == (3, "changed", "made by __init__")


def test_get_state_and_set_state_take_the_place_of_key_variables() -> None:
    actor = Own()
    actor.items = [1, 2]
    assert moved(actor).items == [1, 2]


@pytest.mark.parametrize(
    "value",
    [
        (1, (2, "x")),
        {1, 2},
        frozenset({"a"}),
        deque([1, 2], maxlen=5),
        {(1, 2): "tuple", 3: "int", None: "none"},
        OrderedDict(b=1, a=2),
        Counter("hello"),
        bytearray(b"x"),
        2**200,
        -0.0,
        dt.datetime(2024, 2, 29, 12, tzinfo=dt.UTC),
        Colour.RED,
        Point(1, 2),
        Ping(7),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_value_returns_with_its_type(value: object) -> None:
    actor = Plain()
    actor.count = value  # type: ignore[assignment]
    back = moved(actor).count
    assert back == value
    assert type(back) is type(value)
    assert repr(back) == repr(value)


def test_arrays_and_generators_go_on_where_they_were() -> None:
    actor = Plain()
    actor.count = {  # type: ignore[assignment]
        "array": np.arange(6, dtype=np.float32).reshape(2, 3),
        "numpy": np.random.default_rng(1),
        "python": random.Random(1),
    }
    back: Any = moved(actor).count
    assert back["array"].dtype == np.float32
    assert back["array"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert back["numpy"].random() == np.random.default_rng(1).random()
    assert back["python"].random() == random.Random(1).random()


def test_what_cannot_be_saved_is_refused_with_class_variable_and_type() -> None:
    actor = Plain()
    actor.count = {"deep": [object()]}  # type: ignore[assignment]
    with pytest.raises(UnsavableValue, match=r"/app/it: .*Plain\.count\['deep'\]\[0\]: a value of type object"):
        save_state(at_place(actor))


def test_what_get_state_returns_is_refused_with_the_class() -> None:
    actor = Own()
    actor.items = [object()]  # type: ignore[list-item]
    with pytest.raises(UnsavableValue, match=r"Own\.get_state\(\).*object"):
        save_state(at_place(actor))


def test_a_declared_key_variable_that_is_missing_is_named() -> None:
    actor = Named()
    del actor._cache
    with pytest.raises(StateMismatch, match="Named has no key variable '_cache'"):
        save_state(at_place(actor))


def test_an_unknown_schema_version_is_refused() -> None:
    """T28: the data is kept, not guessed at."""

    class Newer(Plain):
        schema_version = 2

    with pytest.raises(StateMismatch, match=r"schema version 1, .*Newer 2"):
        moved(Plain(), to=Newer())


def test_a_state_of_another_form_is_refused() -> None:
    with pytest.raises(StateMismatch, match="Plain has no set_state"):
        moved(Own(), to=Plain())
    from holdfast.actors.values import encode_value

    with pytest.raises(StateMismatch, match="not written by save_state"):
        restore_state(at_place(Plain()), encode_value([1, 2]))


def test_a_damaged_state_is_refused() -> None:
    data = save_state(at_place(Plain()))
    with pytest.raises(DamagedValue):
        restore_state(at_place(Plain()), data[:-1])


class Half(Plain):
    def get_state(self) -> int:
        return self.count


class Later(Half):
    async def set_state(self, state: int) -> None:
        self.count = state


class Fixed(Plain):
    key_variables = ("count", "double")

    @property
    def double(self) -> int:
        return 2 * self.count


@pytest.mark.parametrize(
    ("kind", "problem"),
    [
        (Half, "Half has no set_state, which goes with get_state"),
        (Later, "Later.set_state is `async def`"),
        (Fixed, "Fixed.double cannot be set"),
    ],
)
async def test_a_state_that_could_not_be_put_back_is_refused_at_the_first_start(
    kind: type[hf.Actor], problem: str
) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        with pytest.raises(hf.StartFailed, match=problem) as failed:
            await system.start(hf.child("it", hf.start(kind), recovery=hf.hybrid()))
        assert isinstance(failed.value.__cause__, hf.errors.StateMismatch)
        if kind is not Fixed:  # No snapshot, nothing to put back.
            assert await system.start(hf.child("it", hf.start(kind), recovery=hf.replay_only()))


def test_key_variables_and_version_are_checked_with_the_class() -> None:
    for wrong in ("goal", (1,)):
        with pytest.raises(TypeError, match=r"Wrong.key_variables must be names"):
            type("Wrong", (hf.Actor,), {"key_variables": wrong})
    with pytest.raises(TypeError, match=r"Wrong.schema_version must be a whole number, not '2'"):
        type("Wrong", (hf.Actor,), {"schema_version": "2"})
    with pytest.raises(TypeError, match="key_variables must be names"):
        hf.adapters.wrap(Point, key_variables="x")
