"""Tables of fields: what a store keeps of the classes whose messages it holds, and how two of them differ, in words."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

from msgspec import inspect

from ...actors.errors import HoldfastError, type_name

Record: TypeAlias = "inspect.StructType | inspect.DataclassType | inspect.NamedTupleType | inspect.TypedDictType"
RECORDS = (inspect.StructType, inspect.DataclassType, inspect.NamedTupleType, inspect.TypedDictType)
"""The types that have fields."""
LISTS = (
    inspect.ListType,
    inspect.SetType,
    inspect.FrozenSetType,
    inspect.VarTupleType,
    inspect.CollectionType,
)
"""The types of many items, which are coded alike."""
WHOLE = "="
"""The place of the row of a reply that is no record: its type in words."""


class FieldRow(NamedTuple):
    """The fields of one class in a message, or of the message itself.

    Attributes:
        place: where in the message it stands; "" is the message itself.
        by_position: whether it is coded as an array, and not by names.
        fields: their names, in order.
        types: their types in words; stores of before do not say.
        optional: whether they have defaults; stores of before do not say.
        tag: the name of the field that has the class's tag, and the tag; () if it has none; None if that is not known.
    """

    place: str
    by_position: bool
    fields: tuple[str, ...]
    types: tuple[str, ...] = ()
    optional: tuple[bool, ...] = ()
    tag: tuple[str, str | int] | tuple[()] | None = None

    def agrees(self, now: FieldRow) -> bool:
        """Whether what was coded with this row is read well with that one."""
        known = self if self.types else self._replace(types=now.types, optional=now.optional, tag=now.tag)
        return known == now


Shape: TypeAlias = "tuple[FieldRow, ...]"
"""A table: the rows of a message class, and of the classes in it."""


def as_shape(data: Any) -> Shape:
    """A table as the journal has it; stores of before have places, forms and names only."""
    return _known_shape(tuple(_row(*row) for row in data))


@functools.cache
def _known_shape(shape: Shape) -> Shape:
    """The table itself, the same one for all homes: thousands of them may have written with it."""
    return shape


def as_data(shape: Shape) -> tuple[tuple[Any, ...], ...]:
    """A table as the journal takes it: plain tuples."""
    return tuple(map(tuple, shape))


def _row(place: Any, by_position: Any, fields: Any, types: Any = (), optional: Any = (), tag: Any = None) -> FieldRow:
    return FieldRow(
        str(place),
        bool(by_position),
        tuple(map(str, fields)),
        tuple(map(str, types)),
        tuple(map(bool, optional)),
        None if tag is None else tuple(tag),
    )


@functools.cache
def shape_of(kind: Any) -> Shape:
    """The table of a message class, or of a reply's type.

    >>> from holdfast import Message
    >>> class Move(Message):
    ...     x: int
    ...     y: int = 0
    >>> shape_of(Move)
    (FieldRow(place='', by_position=True, fields=('x', 'y'), types=('int', 'int'), optional=(False, True), tag=()),)
    """
    found: dict[str, FieldRow] = {}
    try:
        info = plain(inspect.type_info(kind))
        if not isinstance(info, RECORDS):
            found[WHOLE] = FieldRow(WHOLE, by_position=False, fields=(), types=(in_words(info),), tag=())
        for row in _rows(info, "", ()):
            found[row.place] = row
    except Exception as error:  # Annotations can be of any kind; the codec says what is wrong with them.
        raise HoldfastError(f"the fields of {type_name(kind)} cannot be found out: {error}") from error
    return tuple(found.values())


def _rows(info: inspect.Type, place: str, above: tuple[type, ...]) -> Iterator[FieldRow]:
    info = plain(info)
    if isinstance(info, RECORDS):
        if info.cls in above:
            return  # It contains itself: its fields stand there already.
        fields = info.fields
        yield FieldRow(
            place,
            is_by_position(info),
            tuple(field.encode_name for field in fields),
            tuple(in_words(field.type) for field in fields),
            tuple(not field.required for field in fields),
            tag_of(info),
        )
        for field in fields:
            yield from _rows(field.type, inner(place, field.encode_name), (*above, info.cls))
    elif isinstance(info, inspect.UnionType):
        for one, where in members(info, place):
            yield from _rows(one, where, above)
    elif isinstance(info, LISTS):
        yield from _rows(info.item_type, f"{place}[]", above)
    elif isinstance(info, inspect.DictType):
        yield from _rows(info.value_type, f"{place}[]", above)
    elif isinstance(info, inspect.TupleType):
        for number, item in enumerate(info.item_types):
            yield from _rows(item, f"{place}[{number}]", above)


def plain(info: inspect.Type) -> inspect.Type:
    """A type without what was said besides it."""
    return info.type if isinstance(info, inspect.Metadata) else info


def inner(place: str, field: str) -> str:
    """Where a field stands whose class stands at a place."""
    return f"{place}.{field}" if place else field


def members(info: inspect.UnionType, place: str) -> Iterator[tuple[inspect.Type, str]]:
    """The types of a union, each with its place: several structs have places of their own."""
    types = [plain(one) for one in info.types]
    has_many = sum(isinstance(one, inspect.StructType) for one in types) > 1
    for one in types:
        yield one, f"{place}|{one.cls.__name__}" if has_many and isinstance(one, inspect.StructType) else place


def is_by_position(info: Record) -> bool:
    """Whether values of a class are coded as arrays."""
    return info.array_like if isinstance(info, inspect.StructType) else isinstance(info, inspect.NamedTupleType)


def tag_of(info: Record) -> tuple[str, str | int] | tuple[()]:
    """The field that has the tag of a class, and the tag; () if it has none."""
    if not isinstance(info, inspect.StructType) or info.tag_field is None or info.tag is None:
        return ()
    return info.tag_field, info.tag


def in_words(info: inspect.Type) -> str:
    """A type as it would be written in a program.

    >>> in_words(inspect.type_info(dict[str, list[int | None]]))
    'dict[str, list[int | None]]'
    """
    info = plain(info)
    match info:
        case inspect.StructType() | inspect.DataclassType() | inspect.NamedTupleType() | inspect.TypedDictType():
            return info.cls.__qualname__
        case inspect.EnumType() | inspect.CustomType():
            return info.cls.__qualname__
        case inspect.LiteralType():
            return f"Literal[{', '.join(map(repr, info.values))}]"
        case inspect.UnionType():
            return " | ".join(map(in_words, info.types))
        case inspect.DictType():
            return f"dict[{in_words(info.key_type)}, {in_words(info.value_type)}]"
        case inspect.TupleType():
            return f"tuple[{', '.join(map(in_words, info.item_types))}]"
        case inspect.VarTupleType():
            return f"tuple[{in_words(info.item_type)}, ...]"
        case inspect.ListType() | inspect.SetType() | inspect.FrozenSetType() | inspect.CollectionType():
            return f"{_short(info)}[{in_words(info.item_type)}]"
        case _:
            return _short(info)


def _short(info: inspect.Type) -> str:
    name = type(info).__name__.removesuffix("Type")
    return name if name in ("Any", "None") else name.lower()


def difference(old: Shape, new: Shape) -> str:
    """How a table differs from the one that was written with, in words; "" if what was written is read well.

    >>> difference(as_shape([("", True, ("a", "b"))]), as_shape([("", True, ("b", "a"))]))
    'its fields were (a, b), now they are (b, a)'
    """
    known = {row.place: row for row in new}
    for row in old:
        now = known.get(row.place)
        if row.place == WHOLE and row.types != (types := ("a record",) if now is None else now.types):
            return f"its type was {row.types[0]}, now it is {types[0]}"
        if now is not None and not row.agrees(now):
            where = f"{row.place}: its" if row.place else "its"
            has_types = bool(row.types)
            return f"{where} fields were ({_listed(row, has_types)}), now they are ({_listed(now, has_types)})"
    return ""


def _listed(row: FieldRow, has_types: bool) -> str:
    if not has_types:
        return ", ".join(row.fields)
    words = zip(row.fields, row.types, row.optional, strict=False)
    said = [f"{name}: {kind}{' = ...' if is_optional else ''}" for name, kind, is_optional in words]
    return ", ".join(said)
