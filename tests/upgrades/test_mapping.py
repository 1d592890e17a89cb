"""Bodies are mapped by the names of their fields, and back."""

from __future__ import annotations

import random
from typing import Any, NamedTuple, NotRequired, TypedDict

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.kernel.codec import Codec
from holdfast.checkpoint.upgrade.field_tables import Shape, as_shape, difference, shape_of
from holdfast.checkpoint.upgrade.mapping import BodyMapper, BodyUnmapper, NotMapped
from tests.upgrades import schemas

CODEC = Codec(lambda path: pytest.fail(path))


def mapped(kind: Any, table: Shape, value: Any) -> Any:
    made = BodyMapper("m:Old", "m:New", kind, table, CODEC).mapped(msgspec.msgpack.encode(value))
    return msgspec.msgpack.decode(made, type=kind)


def unmapped(kind: Any, table: Shape, value: Any) -> Any:
    return msgspec.msgpack.decode(BodyUnmapper(table, CODEC).unmapped(kind, msgspec.msgpack.encode(value)))


class Leaf(msgspec.Struct, array_like=True, tag="leaf"):
    n: int


class Node(msgspec.Struct, array_like=True, tag="node"):
    left: Leaf | Node
    right: Leaf | Node


class Tree(hf.Message):
    top: Node


def test_a_class_that_contains_itself_and_one_of_several() -> None:
    """Each has its tag in front; what was written has the fields of a leaf in another order, and one less."""
    table = tuple(
        row._replace(fields=("n", "gone"), types=("int", "str"), optional=(False, False))
        if row.place.endswith("Leaf")
        else row
        for row in shape_of(Tree)
    )
    old = [["node", ["leaf", 1, "x"], ["node", ["leaf", 2, "x"], ["leaf", 3, "x"]]]]
    assert mapped(Tree, table, old) == Tree(Node(Leaf(1), Node(Leaf(2), Leaf(3))))
    with pytest.raises(NotMapped):
        unmapped(Tree, table, Tree(Node(Leaf(1), Leaf(2))))


class Pair(NamedTuple):
    y: int
    x: int = 5


class Words(TypedDict):
    a: int


@hf.renamed(here="there")
class Mixed(hf.Message, kw_only=True):
    pair: Pair
    words: Words
    here: int
    there: int = 7
    two: tuple[Pair, int] = (Pair(0), 0)


def test_named_tuples_typed_dicts_and_names_that_are_used_again() -> None:
    rows = [
        ("", True, ("there", "words", "pair", "two")),
        ("words", False, ("a", "b")),
        ("pair", True, ("x", "y")),
        ("two[0]", True, ("x", "y")),
    ]
    old = [1, {"a": 2, "b": 3}, [4, 5], [[6, 7], 8]]
    assert mapped(Mixed, as_shape(rows), old) == Mixed(pair=Pair(5, 4), words={"a": 2}, here=1, two=(Pair(7, 6), 8))


class Note(TypedDict):
    text: str
    size: NotRequired[int]


class Noted(hf.Message):
    notes: list[Note]


def test_a_key_that_need_not_be_there_is_left_out() -> None:
    older = as_shape([("", True, ("notes",)), ("notes[]", False, ("text",), ("str",))])
    assert mapped(Noted, older, [[{"text": "a"}]]) == Noted([{"text": "a"}])
    other = tuple(row._replace(fields=row.fields[::-1], types=row.types[::-1]) for row in shape_of(Noted))
    for note in (Note(text="a"), Note(text="a", size=1)):
        assert mapped(Noted, other, unmapped(Noted, other, Noted([note]))) == Noted([note])


def test_what_the_newest_program_wrote_has_both_names() -> None:
    table = shape_of(Mixed)
    message = Mixed(pair=Pair(1), words={"a": 1}, here=2, there=3)
    assert not difference(table, shape_of(Mixed))
    other = tuple(
        row._replace(fields=row.fields[::-1], types=row.types[::-1]) if not row.place else row for row in table
    )
    assert mapped(Mixed, other, unmapped(Mixed, other, message)) == message


def test_a_body_with_more_fields_than_its_table_is_refused() -> None:
    with pytest.raises(NotMapped, match="is in its journal"):
        mapped(Mixed, as_shape([("", True, ("pair",))]), [[1, 2], 3])


def test_a_reply_that_is_no_record_has_its_type_in_words() -> None:
    assert difference(shape_of(int), shape_of(str)) == "its type was int, now it is str"
    assert difference(shape_of(dict[str, list[int | None]]), shape_of(Pair)) == (
        "its type was dict[str, list[int | None]], now it is a record"
    )
    assert not difference(shape_of(None), shape_of(None))


@pytest.mark.parametrize("seed", range(20))
def test_what_loses_nothing_is_mapped_back_as_it_was(seed: int, tmp_path: Any) -> None:
    from tests.upgrades.generations import program
    from tests.upgrades.test_random_generations import made

    chance = random.Random(seed)
    schema = schemas.first(chance)
    with program(schema.text(), tmp_path / "old") as old:
        table = shape_of(old.Add)
        bodies = [msgspec.msgpack.encode(made(old, schema.value(chance))) for _ in range(5)]
    for _ in range(4):
        schema.step(chance, [], ("add", "swap", "rename", "form", "class"))
    with program(schema.text(), tmp_path / "new") as new:
        mapper = BodyMapper("upgraded:Add", "upgraded:Other", new.Add, table, CODEC)
        for body in bodies:
            assert BodyUnmapper(table, CODEC).unmapped(new.Add, mapper.mapped(body)) == body


def test_a_rename_of_what_is_not_there_is_an_error() -> None:
    with pytest.raises(TypeError, match="Leaf has no field 'm'"):
        hf.renamed(m="n")(Leaf)


@pytest.mark.parametrize(
    ("renames", "problem"),
    [
        ({"a": "b", "b": "a"}, "names cannot be swapped"),
        ({"b": "a", "c": "b"}, "names cannot be swapped or handed on"),
        ({"b": "a", "c": ("older", "b")}, "names cannot be swapped or handed on"),
        ({"b": "old", "c": "old"}, "say it of one of them"),
    ],
)
def test_names_that_were_swapped_handed_on_or_said_twice_are_refused(renames: Any, problem: str) -> None:
    """A record could mean either: mapped by guess, values would stand under the wrong names."""

    class Fields(msgspec.Struct):
        a: int = 0
        b: int = 0
        c: int = 0

    with pytest.raises(TypeError, match=problem):
        hf.renamed(**renames)(Fields)

    class Base(hf.Actor): ...

    with pytest.raises(TypeError, match=problem):
        hf.renamed(**renames)(Base)


def test_a_rename_that_a_base_says_counts_too() -> None:
    @hf.renamed(b="a")
    class Base(hf.Actor): ...

    with pytest.raises(TypeError, match="names cannot be swapped or handed on"):

        @hf.renamed(c="b")
        class Derived(Base): ...
