"""The schema of recorded data: the actor's class and the fields of its messages, replies and refusals.

Messages are coded by position. What the journal holds of a type can be read by a class that has the same fields in the
same order, and perhaps more behind them, with defaults; any other class would take one field for another. So the fields
are kept with what they describe, and compared before anything of it is handled again.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from msgspec import inspect

from ..actors.errors import HoldfastError, StartFailed, type_name
from ..actors.kernel.actor import Actor
from ..actors.kernel.message import Message, find_refusal, message_name, reply_type
from ..actors.persistence import UNFIT
from ..actors.process.wire.start_codec import loaded
from .protocol import MESSAGE, PIPE, REPLY, START, TICK, TIMED, Answer

if TYPE_CHECKING:
    from ..actors.kernel.cell import Cell
    from .home.switch import Switch
    from .journal import Entry

Shape: TypeAlias = "tuple[tuple[str, bool, tuple[str, ...]], ...]"
"""Where in a message a struct stands ("": the message itself), whether it is coded by position, and its fields."""

REPLY_TO, REFUSAL = "the reply to ", "the refusal "
"""How the names begin under which the fields of outcomes are kept."""


@functools.cache
def shape_of(kind: type) -> Shape:
    """The fields of a message class, and of the structs in them.

    >>> from holdfast import Message
    >>> class Move(Message):
    ...     x: int
    ...     y: int = 0
    >>> shape_of(Move)
    (('', True, ('x', 'y')),)
    """
    found: dict[str, tuple[bool, tuple[str, ...]]] = {}
    try:
        _walk(inspect.type_info(kind), "", found, ())
    except Exception as error:  # Annotations can be of any kind; the codec says what is wrong with them.
        raise HoldfastError(f"the fields of {type_name(kind)} cannot be found out: {error}") from error
    return tuple((place, *what) for place, what in found.items())


def _walk(info: Any, place: str, found: dict[str, tuple[bool, tuple[str, ...]]], above: tuple[type, ...]) -> None:
    if isinstance(info, inspect.StructType):
        if info.cls in above:
            return  # It contains itself: its fields stand there already.
        found[place] = info.array_like, tuple(field.encode_name for field in info.fields)
        for field in info.fields:
            _walk(field.type, f"{place}.{field.encode_name}" if place else field.encode_name, found, (*above, info.cls))
    elif isinstance(info, inspect.UnionType):
        structs = sum(isinstance(one, inspect.StructType) for one in info.types)
        for one in info.types:
            many = structs > 1 and isinstance(one, inspect.StructType)
            _walk(one, f"{place}|{cast('Any', one).cls.__name__}" if many else place, found, above)
    else:
        for part in ("item_type", "key_type", "value_type"):
            inner = getattr(info, part, None)
            if inner is not None:
                _walk(inner, f"{place}[]", found, above)
        for number, inner in enumerate(getattr(info, "item_types", ())):
            _walk(inner, f"{place}[{number}]", found, above)


def difference(old: Shape, new: Shape) -> str:
    """Why what was written with the old fields would be misread with the new ones; "" if it would not be.

    >>> difference((("", True, ("a", "b")),), (("", True, ("a", "b", "c")),))
    ''
    >>> difference((("", True, ("a", "b")),), (("", True, ("b", "a")),))
    'its fields were (a, b), now they are (b, a)'
    """
    known = {place: (by_position, fields) for place, by_position, fields in new}
    for place, by_position, fields in old:
        now = known.get(place)
        if now is None:
            continue  # It is another type altogether, which the codec refuses, or a class of another name.
        same = now[1][: len(fields)] == fields if by_position else set(fields) <= set(now[1])
        if by_position != now[0] or not same:
            where = f"{place}: its" if place else "its"
            return f"{where} fields were ({', '.join(fields)}), now they are ({', '.join(now[1])})"
    return ""


def class_of(cell: Cell) -> type[Actor] | None:
    """The class that is to live at a cell, if it is loaded here."""
    start = None if cell.more is None else cell.more.start
    return None if start is None else start.kind


class Shapes:
    """What one home knows of the code that has written its records.

    Attributes:
        kind: the class of the actor; "" if a holdfast of before has not said.
        fields: by type of message (or `shape_name`), how what is recorded of it was written, newest last.
    """

    def __init__(self, home: Switch) -> None:
        self._home = home
        self.kind = ""
        self.fields: dict[str, list[Shape]] = {}
        self._noted: set[str] = set()  # what this process has said, or need not say

    # ---- writing

    def entry(self, name: str) -> Entry | None:
        """What has to be written in front of the first message of this type; None if that stands there already."""
        if not name or name in self._noted:
            return None
        self._noted.add(name)
        shape = self._now(name)
        known = self.fields.setdefault(name, [])
        if shape is None or (known[-1] == shape if known else shape == ()):
            return None
        known.append(shape)
        return ("shape", name, shape)

    def knows(self, name: str) -> bool:
        """Whether `entry` has nothing to say of this type."""
        return name in self._noted

    def saved(self) -> dict[str, list[Shape]]:
        """What a snapshot keeps: of types of which nothing waits only the newest."""
        waiting = self._waiting()
        return {name: all_ if name in waiting else all_[-1:] for name, all_ in self.fields.items() if all_}

    # ---- reading

    def loaded(self, kind: str, fields: Mapping[str, Iterable[Shape]]) -> None:
        """What a snapshot has kept."""
        self.kind = kind
        self.fields = {name: [*all_] for name, all_ in fields.items()}

    def read(self, name: str, shape: Shape) -> None:
        """Take the fields of a type as the journal has them."""
        known = self.fields.setdefault(name, [])
        if shape in known:
            known.remove(shape)
        known.append(shape)

    def check(self, cell: Cell) -> None:
        """Refuse a class, or classes of messages, that would misread what is recorded.

        Raises:
            StartFailed: with the difference in words. Nothing was changed.
        """
        problem = self._other_class(class_of(cell)) or self._other_fields()
        if problem:
            raise StartFailed(cell.path, f"{UNFIT}: {problem}")

    def _other_class(self, kind: type[Actor] | None) -> str:
        if kind is None or not self.kind:
            return ""
        name = message_name(kind)
        if name == self.kind or self.kind in kind.formerly:
            return ""
        return (
            f"it was recorded by {self.kind}, and is to be started as {name}; start it as {self.kind}, "
            f"or with fresh=True, which forgets it; or, if {name} is to handle its messages and go on with its state, "
            f"say formerly = ({self.kind!r},) in that class"
        )

    def _other_fields(self) -> str:
        for name in sorted(self._waiting() & self.fields.keys()):
            now = self._now(name)
            for shape in self.fields[name] if now is not None else ():
                problem = difference(shape, now or ())
                if problem:
                    return (
                        f"{name} is in its journal: {problem}; add new fields at the end and with a default, and give "
                        "what has changed a new name beside the old one"
                    )
        return ""

    def _waiting(self) -> set[str]:
        """The types of messages that are still to be handled, or handled again."""
        home, ledger = self._home, self._home.ledger
        waiting = {source.name for source in ledger.handled_and_open() if source.kind in (MESSAGE, TICK, PIPE)}
        waiting |= {shape_name(answer) for answer in ledger.outcomes.values()}
        return waiting | {name for name, *_ in home.timers.saved().values()}

    def _now(self, name: str) -> Shape | None:
        """The fields of the class that has this name now; None if it is not known here."""
        cell = self._home.cell
        kind = None if cell is None else class_of(cell)
        if kind is None:
            return None
        try:
            if name.startswith(REPLY_TO):
                asked = loaded(name.removeprefix(REPLY_TO), Message)
                return None if asked is None else shape_of(reply_type(asked))
            if name.startswith(REFUSAL):
                refusal = find_refusal(name.removeprefix(REFUSAL))
                return None if refusal is None else shape_of(refusal.schema())
            return shape_of(kind._table.kind_named(name))
        except (HoldfastError, TypeError, NameError):  # Annotations that say nothing: the codec tells.
            return None


def shape_name(answer: Answer) -> str:
    """Under which name the fields of an ask's outcome are kept; "" if they are not."""
    kind = answer.kind.removeprefix(TIMED)
    if kind == "refusal":
        return REFUSAL + answer.name
    if kind == MESSAGE:
        return answer.name
    return REPLY_TO + answer.name if kind == REPLY and answer.name else ""


def as_shape(data: Any) -> Shape:
    """A shape as the journal has it."""
    return tuple((str(place), bool(by_position), tuple(map(str, fields))) for place, by_position, fields in data)


def start_name(cell: Cell | None) -> str:
    """The name of the class that lives at a cell, as it is written with its start; "" if it is not known here."""
    kind = None if cell is None else class_of(cell)
    return "" if kind is None else message_name(kind)


def kind_in(home: Switch) -> str:
    """The class that was written with the start of an actor, of which there is no snapshot yet."""
    return next((source.body.decode() for source in home.ledger.handled_and_open() if source.kind == START), "")
