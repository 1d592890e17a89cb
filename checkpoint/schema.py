"""The schema of recorded data: the actor's class, and the tables of the fields of all that is recorded as messages.

Messages are coded by position. So the fields stand in the journal in front of what was written with them, and what was
written by an earlier version of the program is mapped by their names when a home is taken up (`upgrade/`). A home that
the present code cannot read is refused, before anything of it is changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..actors.errors import HoldfastError, StartFailed
from ..actors.kernel.actor import Actor
from ..actors.kernel.cell import Cell
from ..actors.kernel.message import message_name
from ..actors.persistence import UNFIT
from ..actors.values.renamed import former_names
from .protocol import START, shortened
from .upgrade.field_tables import Shape, as_data, as_shape, difference, shape_of
from .upgrade.mapping import BodyMapper, BodyUnmapper, NotMapped
from .upgrade.old_records import OldRecords, mapper_of
from .upgrade.present_classes import former_keys, present_class, shape_name

if TYPE_CHECKING:
    from .home.switch import Switch
    from .journal import Entry

    Timers = Mapping[str, tuple[str, bytes, float, float]]
    Tables = Mapping[str, Sequence[Any]]

__all__ = [
    "Shape",
    "Shapes",
    "as_shape",
    "class_of",
    "difference",
    "first_of",
    "kind_in",
    "shape_entry",
    "shape_name",
    "shape_of",
    "start_name",
]


def class_of(cell: Cell) -> type[Actor] | None:
    """The class that is to live at a cell, if it is loaded here."""
    start = None if cell.more is None else cell.more.start
    return None if start is None else start.kind


def other_class(recorded: str, kind: type[Actor] | None) -> str:
    """Why a class does not go on with what another one has recorded, in words; "" if it does.

    Args:
        recorded: the name of the class that has recorded it; "" if nobody has said.
        kind: the class that is to go on; None if it is not loaded here.
    """
    if kind is None or not recorded:
        return ""
    name = message_name(kind)
    if name == recorded or recorded in former_names(kind):
        return ""
    return (
        f"it was recorded by {recorded}, and is to be started as {name}; start it as {recorded}, "
        f"or with fresh=True, which forgets it; or, if {name} is to handle its messages and go on with its state, "
        f"say @hf.renamed({recorded!r}) above that class"
    )


class Shapes:
    """What one home knows of the code that has written its records.

    Attributes:
        kind: the class of the actor; "" if a holdfast of before has not said.
        fields: by type of message (or `shape_name`), the tables with which what is recorded was written, newest last.
        noted: the types of which this process has written the table, or need not.
        old: what was read, and is coded otherwise than now.
    """

    def __init__(self, home: Switch) -> None:
        self._home = home
        self.kind = ""
        self.fields: dict[str, list[Shape]] = {}
        self.old = OldRecords(home.node.codec, self._class)
        self._first: dict[str, Shape] = {}  # with which the entries behind the newest snapshot begin
        self._sinks: list[tuple[str, list[int]]] = []  # of which type a table stands in the journal, and where
        self.noted: set[str] = set()

    @property
    def _class(self) -> type[Actor] | None:
        return None if self._home.cell is None else class_of(self._home.cell)

    # ---- writing

    def entry(self, name: str) -> Entry | None:
        """What has to be written in front of the first message of this type; None if that stands there already."""
        if not name or name in self.noted:
            return None
        self.noted.add(name)
        shape = self.now(name)
        known = self.fields.setdefault(name, [])
        if shape is None or (known[-1] == shape if known else shape == ()):
            return None
        self._know(name, shape)
        return shape_entry(name, shape)

    def stands_at(self, name: str, position: list[int]) -> None:
        """The table of a type stands in the journal there, or will."""
        self._sinks.append((name, position))

    def now(self, name: str) -> Shape | None:
        """The table of what has this name, as it is written now; None if its class is not known here."""
        found = present_class(name, self._class)
        try:
            return None if found is None else shape_of(found[1])
        except HoldfastError:  # The codec says what is wrong with it.
            return None

    def saved(self, turn: int) -> dict[str, list[Shape]]:
        """What a snapshot of the state after `turn` keeps: the table that its entries begin with, and the newest one.

        Of types of which no entry is left it is only the newest, and where their tables stand in the journal is cut.
        What is written behind it is looked at anew, for code may have been loaded once more.
        """
        left, gone = self._left(turn), set[str]()
        self.noted.clear()
        for name, known in self.fields.items():
            if known and left is not None and self._name_now(name) not in left:
                gone.add(name)
                self._first[name] = known[-1]
                del known[:-1]
        self._home.ledger.drop(*(position for name, position in self._sinks if name in gone))
        self._sinks = [sink for sink in self._sinks if sink[0] not in gone]
        return {name: _from(self._first.get(name, known[0]), known) for name, known in self.fields.items() if known}

    def as_now(self) -> dict[str, list[Shape]]:
        """As `saved`, for a copy of what is known here: all of it is coded as the present classes have it."""
        return {name: _from(known[-1], known) for name, known in self.fields.items() if known}

    def _left(self, turn: int) -> set[str] | None:
        """The types of what is not contained in a snapshot of the state after a turn; None: it may be any."""
        ledger = self._home.ledger
        later = [past for number, past in ledger.turns.items() if number > turn]
        if ledger.released or any(past.digests or past.reply for past in later):
            return None  # Nobody has said what these are digests of.
        names = {source.name for source in (*ledger.open.values(), *(past.input for past in later))}
        return names | {shape_name(answer) for (number, _), answer in ledger.outcomes.items() if number > turn}

    def _name_now(self, name: str) -> str:
        found = present_class(name, self._class)
        return name if found is None else found[0]

    def _know(self, name: str, shape: Shape) -> None:
        known = self.fields.setdefault(name, [])
        if shape in known:
            known.remove(shape)
        known.append(shape)

    # ---- reading

    def loaded(self, kind: str, shapes: Tables) -> None:
        """What a snapshot has kept."""
        self.kind = kind
        for name, rows in shapes.items():
            tables = [as_shape(row) for row in rows]
            for shape in tables:
                self._know(name, shape)
            first = self._first[name] = first_of(tables)
            self.old.read(name, first)

    def read(self, name: str, shape: Shape, position: int) -> None:
        """Take the table of a type as the journal has it: what follows was written with it."""
        self._know(name, shape)
        self.stands_at(name, [position])
        self.old.read(name, shape)

    def timer_mappers(self, timers: Timers, shapes: Tables) -> dict[str, BodyMapper]:
        """What maps the timers of a snapshot, by key: they were written with the newest tables that it has."""
        tables = {name: as_shape(known[-1]) for name, known in shapes.items() if known}
        codec = self._home.node.codec
        found = {key: mapper_of(one[0], tables.get(one[0]), self._class, codec) for key, one in timers.items()}
        return {key: mapper for key, mapper in found.items() if mapper is not None}

    def timers_now(self, timers: Timers, shapes: Tables) -> dict[str, tuple[str, bytes, float, float]]:
        """The timers of a snapshot as they would be written now. Raises NotMapped: one of them cannot be read."""
        mappers = self.timer_mappers(timers, shapes)
        return {
            key: one if key not in mappers else (mappers[key].name, mappers[key].mapped(one[1]), *one[2:])
            for key, one in timers.items()
        }

    def check(self, cell: Cell) -> None:
        """Refuse another class.

        Raises:
            StartFailed: it says which one it was. Nothing was changed.
        """
        problem = other_class(self.kind, class_of(cell))
        if problem:
            raise StartFailed(cell.path, f"{UNFIT}: {problem}")

    def all_read(self) -> OldRecords:
        """All has been read; returns what was written otherwise than it would be now."""
        old, self.old = self.old, OldRecords(self._home.node.codec, self._class)
        return old

    # ---- comparing

    def former_names(self, name: str) -> tuple[str, ...]:
        """What a type of messages was called before."""
        return former_keys(name, self._class)

    def older_forms(self, name: str, body: bytes) -> Iterator[tuple[str, bytes]]:
        """What is coded now as it may have been coded before, each with the name that it had.

        Raises:
            NotMapped: behind the forms that are known, if there was one that cannot be known any more: a field is gone,
                or of another type.
        """
        kind = self._class
        found, names = present_class(name, kind), (name, *self.former_names(name))
        now = self.now(name)
        known = [(one, table) for one in names for table in self.fields.get(one, ()) if (one, table) != (name, now)]
        lost: NotMapped | None = None
        for one, table in known:
            try:
                yield (
                    one,
                    body if found is None else BodyUnmapper(table, self._home.node.codec).unmapped(found[1], body),
                )
            except NotMapped as error:
                lost = error
        if not known:  # Stores of before do not say what has been sent: more fields may have come at its end.
            yield from ((one, short) for one in names for short in (body, *shortened(body)))
        if lost is not None:
            raise lost


def first_of(tables: list[Shape]) -> Shape:
    """The table that is in force for the first entry behind a snapshot.

    A holdfast of before has added fields at the end only: its longest table is true of all that it has written.
    """
    older = [table for table in tables if not any(row.types for row in table)]
    if tables[0] not in older:
        return tables[0]
    return max(older, key=lambda table: sum(len(row.fields) for row in table))


def _from(first: Shape, known: list[Shape]) -> list[Shape]:
    """All tables of a type, beginning with the one that is in force for the first entry, and the newest last."""
    return known if first == known[0] else [first, *known]


def shape_entry(name: str, shape: Shape) -> Entry:
    """What the journal has in front of what was written with a table."""
    return "shape", name, as_data(shape)


def start_name(cell: Cell | None) -> str:
    """The name of the class that lives at a cell, as it is written with its start; "" if it is not known here."""
    kind = None if cell is None else class_of(cell)
    return "" if kind is None else message_name(kind)


def kind_in(home: Switch) -> str:
    """The class that was written with the start of an actor, of which there is no snapshot yet."""
    return next((source.body.decode() for source in home.ledger.handled_and_open() if source.kind == START), "")
