"""Maps what was coded with one table to a class whose fields are others now, by the names of the fields; and back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import inspect

from ...actors.errors import HoldfastError
from ...actors.kernel.message import message_name
from ...actors.values.renamed import former_members, former_names
from .field_tables import (
    LISTS,
    RECORDS,
    FieldRow,
    Record,
    Shape,
    difference,
    in_words,
    inner,
    is_by_position,
    members,
    plain,
    shape_of,
    tag_of,
)

if TYPE_CHECKING:
    from ...actors.kernel.codec import Codec


class NotMapped(HoldfastError, text="{problem}"):
    """Something that was recorded cannot be read by the class that has its name now, or the other way round."""

    problem: str


Above = dict[type, str]
"""The classes that contain a value, and where each stands in the table: a class may contain itself."""


class _Walk:
    """One way through a value, along the types of the present class and the rows of the table.

    A subclass says what becomes of a value that has fields.
    """

    def __init__(self, table: Shape, codec: Codec) -> None:
        self._rows = {row.place: row for row in table}
        self._codec = codec

    def of(self, value: Any, info: inspect.Type, place: str, above: Above) -> Any:
        """What becomes of a value of this type, decoded without one, that stands at a place of the table."""
        info = plain(info)
        if isinstance(info, RECORDS):
            row = self._row(info, place, above)
            return value if row is None else self._record(value, info, row, {**above, info.cls: row.place})
        if isinstance(info, inspect.UnionType):
            found = next((one for one, _ in members(info, place) if self._suits(value, one, place, above)), None)
            return value if found is None else self.of(value, found, place, above)
        if isinstance(info, LISTS) and isinstance(value, list):
            return [self.of(item, info.item_type, f"{place}[]", above) for item in value]
        if isinstance(info, inspect.DictType) and isinstance(value, dict):
            return {key: self.of(item, info.value_type, f"{place}[]", above) for key, item in value.items()}
        if isinstance(info, inspect.TupleType) and isinstance(value, list) and len(value) == len(info.item_types):
            items = zip(value, info.item_types, strict=True)
            return [self.of(item, kind, f"{place}[{number}]", above) for number, (item, kind) in enumerate(items)]
        return value

    def _row(self, info: Record, place: str, above: Above) -> FieldRow | None:
        """The row of a class at a place, under whichever name it has there; None: it was another type altogether."""
        names = (message_name(info.cls), *former_names(info.cls))
        places = [place, *(f"{place}|{name.rpartition(':')[2].rpartition('.')[2]}" for name in names)]
        if info.cls in above:
            places.append(above[info.cls])
        return next((self._rows[where] for where in places if where in self._rows), None)

    def _suits(self, value: Any, info: inspect.Type, place: str, above: Above) -> bool:
        """Whether a value can be of this type, which is one of several."""
        if isinstance(info, RECORDS):
            row = self._row(info, place, above)
            return row is not None and self._named(value, info, row) is not None
        if isinstance(info, (*LISTS, inspect.TupleType)):
            return isinstance(value, list)
        return isinstance(info, inspect.DictType) and isinstance(value, dict)

    def _record(self, value: Any, info: Record, row: FieldRow, above: Above) -> Any:
        raise NotImplementedError

    def _named(self, value: Any, info: Record, row: FieldRow) -> dict[str, Any] | None:
        """The values of the fields by name, if it is a value of this class."""
        raise NotImplementedError


class BodyMapper(_Walk):
    """Maps bodies that were written with a table to what the present class reads.

    Args:
        written: under which name they were written.
        name: what that is called now.
        kind: the class, or the type of a reply.
        table: with which the bodies were written; None: nobody has said, and only the name is another one.
        codec: decodes what has come of them.
    """

    def __init__(self, written: str, name: str, kind: Any, table: Shape | None, codec: Codec) -> None:
        super().__init__(table or (), codec)
        self.written, self.name, self._kind = written, name, kind
        self._difference = "" if table is None else difference(table, shape_of(kind))
        self._info = inspect.type_info(kind)

    @property
    def change(self) -> str:
        """What has changed, in words, as it goes on behind the name."""
        name = f", which is {self.name} now" if self.written != self.name else ""
        return f"{name}: {self._difference}" if self._difference else name

    def mapped(self, body: bytes) -> bytes:
        """The same body as the present class reads it.

        Raises:
            NotMapped: it does not; the difference in words.
        """
        if not body or not self._difference:
            return body
        try:
            made = msgspec.msgpack.encode(self.of(msgspec.msgpack.decode(body), self._info, "", {}))
            self._codec.decode(self._kind, made)
        except (NotMapped, msgspec.MsgspecError) as error:
            raise NotMapped(f"{self.written} is in its journal{self.change}: {error}") from error
        return made

    def _record(self, value: Any, info: Record, row: FieldRow, above: Above) -> Any:
        named = self._named(value, info, row)
        if named is None:
            return value  # Another type of a union, say: the codec judges.
        made: dict[str, Any] = {}
        for field, old in sources(info, row):
            if old in named:
                made[field.encode_name] = self.of(named[old], field.type, inner(row.place, old), above)
            elif field.required:
                raise NotMapped(
                    f"{field.name} is new and has no default; give it one, or say what it was: "
                    f"@hf.renamed({field.name}='...')"
                )
            elif not may_be_missing(field):
                made[field.encode_name] = self._default(field)
        return coded(made, info)

    def _default(self, field: inspect.Field) -> Any:
        default = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
        return msgspec.msgpack.decode(self._codec.encoder.encode(default))

    def _named(self, value: Any, info: Record, row: FieldRow) -> dict[str, Any] | None:
        return named_by(value, row.fields, row.tag if row.tag is not None else tag_of(info), in_order=row.by_position)


class BodyUnmapper(_Walk):
    """Says how a table would have coded what the present class codes: so its digest can be compared with an old one."""

    def unmapped(self, kind: Any, body: bytes) -> bytes:
        """The body as it would have been written.

        Raises:
            NotMapped: that cannot be known.
        """
        if not body:
            return body
        return msgspec.msgpack.encode(self.of(msgspec.msgpack.decode(body), inspect.type_info(kind), "", {}))

    def _record(self, value: Any, info: Record, row: FieldRow, above: Above) -> Any:
        named = self._named(value, info, row)
        if named is None:
            return value
        made: dict[str, Any] = {}
        found = {old: field for field, old in sources(info, row)}
        for index, old in enumerate(row.fields):
            field = found.get(old)
            is_other = field is None or (row.types and in_words(field.type) != row.types[index])
            is_missing = field is not None and field.encode_name not in named
            if field is None or is_other or (is_missing and not may_be_missing(field)):
                raise NotMapped(f"{old} is not what it was")
            if is_missing:
                continue
            made[old] = self.of(named[field.encode_name], field.type, inner(row.place, old), above)
        tag = row.tag if row.tag is not None else tag_of(info)
        return _coded(made, tag, in_order=row.by_position)

    def _named(self, value: Any, info: Record, row: FieldRow) -> dict[str, Any] | None:
        names = tuple(field.encode_name for field in info.fields)
        return named_by(value, names, tag_of(info), in_order=is_by_position(info))


def may_be_missing(field: inspect.Field) -> bool:
    """Whether a value may be without it, and has nothing in its place: a key of a `TypedDict` that is `NotRequired`."""
    return not field.required and field.default is field.default_factory is msgspec.NODEFAULT


def sources(info: Record, row: FieldRow) -> Iterator[tuple[inspect.Field, str]]:
    """The present fields of a class, each with what it is called in a row ("": it is not there)."""
    former = former_members(info.cls)
    before = {
        field.encode_name: next((old for old in former.get(field.name, ()) if old in row.fields), "")
        for field in info.fields
        if field.encode_name not in row.fields
    }
    taken = set(before.values())  # A new field may have the name that another one had.
    for field in info.fields:
        own = field.encode_name
        yield field, before.get(own, "" if own in taken else own)


def named_by(
    value: Any, fields: tuple[str, ...], tag: tuple[str, str | int] | tuple[()], *, in_order: bool
) -> dict[str, Any] | None:
    """The values of fields by name; None of what is no value of that class."""
    if in_order:
        if not isinstance(value, list) or (tag and value[:1] != [tag[1]]):
            return None
        values = value[1:] if tag else value
        if len(values) > len(fields):
            return None
        return dict(zip(fields, values, strict=False))
    if not isinstance(value, dict) or (tag and value.get(tag[0]) != tag[1]):
        return None
    return {name: value[name] for name in fields if name in value}


def coded(named: dict[str, Any], info: Record) -> Any:
    """The values of the fields of a class in the form in which it is coded."""
    return _coded(named, tag_of(info), in_order=is_by_position(info))


def _coded(named: dict[str, Any], tag: tuple[str, str | int] | tuple[()], *, in_order: bool) -> Any:
    if in_order:
        return [tag[1], *named.values()] if tag else [*named.values()]
    return {tag[0]: tag[1], **named} if tag else named


def in_whole_numbers(body: bytes) -> bytes:
    """What is coded there, with each float that is whole as an int, as before ints became floats.

    >>> msgspec.msgpack.decode(in_whole_numbers(msgspec.msgpack.encode([7.0, {"a": 0.5}])))
    [7, {'a': 0.5}]
    """
    return msgspec.msgpack.encode(_whole(msgspec.msgpack.decode(body))) if body else body


def _whole(value: Any) -> Any:
    if isinstance(value, float):
        return int(value) if value.is_integer() else value
    if isinstance(value, list):
        return [_whole(one) for one in value]
    return {key: _whole(one) for key, one in value.items()} if isinstance(value, dict) else value
