"""A model that changes: versions, and the way back (D31)."""

import msgspec
import pytest

from holdfast.diagnosis.model import (
    Add,
    Change,
    Clause,
    Component,
    Declaration,
    Declare,
    Drop,
    Expect,
    Expectation,
    History,
    Kind,
    ModelError,
    NoSuchVersion,
    Put,
    Relate,
    Relation,
    Remove,
    Replace,
    System,
    Value,
)
from holdfast.diagnosis.model.model_history import KEPT


@pytest.fixture
def history() -> History:
    system = System()
    system.node("a", out=["/a"])
    return History(system)


def test_changes_make_versions_that_count(history: History) -> None:
    device = Component(name="h", kind=Kind.SWITCHABLE)
    driver = Component(name="b", kind=Kind.DRIVER, on=("h",), out={"/b": ()})
    model = history.change([Put(driver), Put(device)], "plugged in", 7.0)
    assert model is history.model
    assert model.version == 2
    assert model.components["b"].kind is Kind.SWITCHED_DRIVER
    assert [(one.number, one.reason, one.time) for one in history.versions] == [
        (1, "first", 0.0),
        (2, "plugged in", 7.0),
    ]


def test_every_kind_of_change_applies_and_is_taken_back(history: History) -> None:
    before = history.model.declaration
    changes: list[Change] = [
        Put(Component(name="b", out={"/b": ("/a",)})),
        Relate(Relation(("a", "a.v"), ("b", "b.v")), (Value("a.v", "/a"),)),
        Expect(Expectation("ok(memory)", ("b",))),
        Declare(("on(lamp)",)),
        Add(Clause("NAB(a) -> on(lamp)")),
    ]
    rules = list(map(str, history.change(changes).rules))
    assert "not AB(a) -> on(lamp)" in rules
    assert "not AB(b) -> ok(memory)" in rules
    back: list[Change] = [Drop("NAB(a) -> on(lamp)"), Drop("on(lamp)"), Drop("ok(memory)"), Remove("b")]
    left = history.change(back).declaration
    assert msgspec.structs.replace(left, values=()) == before


def test_a_change_that_cannot_be_used_changes_nothing(history: History) -> None:
    model, versions = history.model, history.versions
    changes: list[Change] = [Put(Component(name="b")), Put(Component(name="c", out={"/c": ("/nowhere",)}))]
    for refused in (changes, [Remove("zz")], [Drop("NAB(a) -> ok(/a)")]):
        with pytest.raises(ModelError):
            history.change(refused)
    assert history.model is model
    assert history.versions == versions


def test_going_back_is_a_new_version_with_the_old_content(history: History) -> None:
    first = history.model.declaration
    history.change([Put(Component(name="b"))])
    history.change([Put(Component(name="c"))])
    assert set(history.roll_back().components) == {"a", "b"}
    model = history.roll_back(1)
    assert model.version == 5
    assert model.declaration == first
    assert history.versions[-1].reason == "back to version 1"


def test_only_so_many_versions_are_kept(history: History) -> None:
    for i in range(KEPT + 5):
        history.change([Put(Component(name=f"n{i}"))])
    assert len(history.versions) == KEPT
    with pytest.raises(NoSuchVersion, match="no version 1 of the model"):
        history.roll_back(1)
    assert history.model.version == KEPT + 6


def test_the_whole_model_is_replaced(history: History) -> None:
    model = history.change([Replace(Declaration(components=(Component(name="z"),)))])
    assert list(model.components) == ["z"]


def test_changes_are_plain_data() -> None:
    changes: list[Change] = [Put(Component(name="b", out={"/b": ("/a",)})), Remove("b"), Declare(("on(lamp)",))]
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(changes), type=list[Change]) == changes
