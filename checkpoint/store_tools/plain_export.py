"""Everything that a store has, as plain data for people and for other programs; nothing of users is imported.

Messages are coded by position. The names of their fields are those that the store has kept with them, so that the
classes need not be there.
"""

from __future__ import annotations

import base64
import datetime
import math
import os
import sys
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import msgpack

from ...actors.errors import DamagedValue, HoldfastError, type_name
from ...actors.kernel.codec import ARRAY, PACKED, REF
from ...actors.values import ValueDescription, describe_value
from ..addresses import KEY, is_of_actor
from ..encoding.compression import LibraryMissing
from ..inputs import spread
from ..journal import DamagedStore, Entry, StoreFailed
from ..protocol import REPLY, START, Answer, untimed
from ..schema import Shape, as_shape, first_of, shape_name
from ..snapshot.snapshot_record import Meta, decode_meta
from ..snapshot.state_image import read_saved
from ..sqlite.entry_chains import Chain, StoreScan
from ..sqlite.read_back import checked_entry
from ..store_key import StoreKey, read_store_key
from .store_view import StoreView, open_view, stamp

Record = dict[str, Any]
HISTORY: Final = "history "
"""How the names of the notes begin that have past events."""
_NAMES: Final[dict[str, tuple[str, ...]]] = {
    "out": ("turn", "input", "outputs", "since"),
    "end": ("turn", "input", "status", "outputs", "state", "reply"),
    "ends": ("turn", "inputs"),
    "got": ("turn", "output", "outcome", "type", "value", "order", "after"),
    "due": ("turn", "output", "time"),
    "unasked": ("turn", "output", "is_so"),
    "kept": ("origin", "type", "value", "sender"),
    "drop": ("input",),
    "tried": ("input", "deliveries"),
    "late": ("input",),
    "stop": ("turn", "reason", "is_cut_off"),
    "tie": ("turn", "verb", "other"),
    "later": ("turn", "input"),
    "replied": ("turn", "input"),
    "op": ("turn", "verb", "key", "type", "value", "seconds", "interval", "time"),
    "shape": ("type", "fields"),
}
"""What the values of a journal entry are, by its kind."""


def export_store(path: str | os.PathLike[str], *, key: StoreKey | None = None) -> Generator[Record, None, None]:
    """Give all that a store has at one instant, record by record; nothing is changed, and a system may have it open.

    Each record has `record`, which says what it is: first one "store", then "note", "address" and "snapshot", and then
    what is in the journal, oldest first: "input" and the others. "damage" stands for what cannot be read. All values
    are such as JSON has; bytes are `{"base64": text}`.

    What is encrypted in the store is in plain text in these records.

    In memory are one snapshot, or one entry, at a time, and 8 bytes for each entry.

    Args:
        path: the database of the store.
        key: of the store, if it is encrypted.

    Raises:
        StoreFailed: there is no store, it cannot be read, or it was opened while it was read as a closed one.
        DamagedStore, ForeignStore: it is so damaged that nothing of it can be read. WrongStoreKey: the key is not its
            own.
    """
    where = os.path.realpath(path)
    before = stamp(where)
    with open_view(where, read_store_key(key)) as view:
        yield from _Export(view).records()
        if not view.has_wal and stamp(where) != before:
            raise StoreFailed(where, "it was opened while it was exported; export it again")


class _Export:
    def __init__(self, view: StoreView) -> None:
        self._view = view
        self._damages: list[DamagedStore] = []
        self._reader = view.reader
        self._shapes: dict[int, dict[str, Shape]] = {}  # by address, and type of message

    def records(self) -> Iterator[Record]:
        view = self._view
        identity = "" if view.identity is None else view.identity.id
        yield {"record": "store", "path": view.path, "identity": identity, "epoch": view.row.epoch, "last": view.last}
        contents = StoreScan(view.db, view.path, view.parts.cipher, self._damages.append).contents()
        try:
            contents.take_in(view.rows, view.path)
        except DamagedStore as error:
            self._damages.append(error)
        for name, value in contents.notes.items():
            yield {"record": "note", "name": name, "value": _note(name, value)}
        at = {key.decode(): name.removeprefix(KEY) for name, key in contents.notes.items() if name.startswith(KEY)}
        chains = {chain.id: chain for chain in contents.chains.values()}
        addresses = {chain.id: at.get(key, key) for key, chain in contents.chains.items()}
        for chain in chains.values():
            yield {"record": "address", "address": addresses[chain.id], "key": chain.path}
            if chain.damage is not None:
                self._damages.append(chain.damage)
            for number in chain.kept:
                yield from self._snapshot(chain, number, addresses[chain.id])
        yield from self._entries(chains, addresses)
        for damage in self._damages:
            yield _damage(damage)

    def _snapshot(self, chain: Chain, number: int, address: str) -> Iterator[Record]:
        try:
            snapshot, turn = self._reader.read_snapshot(chain, number)
            if not is_of_actor(address):
                yield {"record": "snapshot", "address": address, "turn": turn, "state": plain_message(snapshot, ())}
                return
            meta = decode_meta(snapshot)
            data = self._view.packs.state(chain.path or "", meta.blocks) if meta.blocks else meta.state
        except StoreFailed:
            raise
        except HoldfastError as error:
            if isinstance(error.__cause__, LibraryMissing):
                raise StoreFailed(self._view.path, str(error.__cause__)) from error
            if self._view.is_kept(number):  # Else the running system has a newer one now.
                yield _damage(error, address)
            return
        tables = {name: [*map(as_shape, known)] for name, known in meta.made.shapes.items() if known}
        self._shapes.setdefault(chain.id, {name: first_of(known) for name, known in tables.items()})
        newest = {name: known[-1] for name, known in tables.items()}
        yield {
            "record": "snapshot",
            "address": address,
            "turn": meta.turn,
            "time": meta.time,
            "class": meta.made.kind,
            "next_input": meta.next_id,
            "stashed": meta.stash,
            "topics": meta.topics,
            "timers": self._timers(meta, newest),
            **plain_state(data),
        }

    def _timers(self, meta: Meta, tables: Mapping[str, Shape]) -> Record:
        return {
            key: {
                "type": name,
                "message": plain_message(body, tables.get(name, ())),
                "left": left,
                "interval": interval,
            }
            for key, (name, body, left, interval) in meta.timers.items()
        }

    def _entries(self, chains: Mapping[int, Chain], addresses: Mapping[int, str]) -> Iterator[Record]:
        view = self._view
        for position, key, *rest in view.entries():
            if key not in chains:
                continue  # It is of an address that is being erased, or was told as damaged.
            try:
                entry = checked_entry(view.path, view.parts.cipher, chains[key], position, key, *rest)
            except DamagedStore as error:
                yield _damage(error, addresses[key])
                continue
            for one in spread(entry):
                yield {**self._entry(key, one), "address": addresses[key], "position": position}

    def _entry(self, key: int, entry: Entry) -> Record:
        match entry:
            case ("in", number, str() as kind, str() as name, bytes() as body, when, sender, origin, *end):
                is_start = kind == START
                content = _text(body) if is_start else self._message(key, name, body)
                return {
                    "record": "input",
                    "input": number,
                    "kind": kind,
                    "type": name,
                    "message": content,
                    "time": as_plain(when),
                    "sender": sender,
                    "origin": origin,
                    **(
                        {"end": dict(zip(("turn", "status", "state", "reply"), map(as_plain, end), strict=False))}
                        if end
                        else {}
                    ),
                }
            case ("shape", str() as name, shape):
                self._shapes.setdefault(key, {})[name] = as_shape(shape)
                return _named_values("shape", entry[1:])
            case ("got", _, _, str() as kind, str() as name, bytes() as body, *_):
                answer, when = untimed(Answer(kind, name, body))
                value = self._message(key, shape_name(answer), answer.body) if answer.body else None
                if when and answer.kind == REPLY:
                    value = plain_result(answer.body)
                came = {"time": when} if when else {}
                return {**_named_values("got", entry[1:]), "outcome": answer.kind, "value": value, **came}
            case ("op", _, _, _, str() as name, bytes() as body, *_):
                return {**_named_values("op", entry[1:]), "value": self._message(key, name, body)}
            case (kind, *values):
                return _named_values(str(kind), values)
            case _:
                return {"record": "unknown", "values": as_plain(entry)}

    def _message(self, key: int, name: str, body: bytes) -> Any:
        return plain_message(body, self._shapes.get(key, {}).get(name, ()))


def plain_message(body: bytes, shape: Shape) -> Any:
    """The content of a message as plain data: its fields by name, if their names are known."""
    try:
        value = msgpack.unpackb(body, ext_hook=_special, strict_map_key=False, timestamp=3)
    except (ValueError, TypeError, msgpack.UnpackException):
        return as_plain(body)
    return _named(value, "", {row.place: row.fields for row in shape if row.by_position})


def _named_values(kind: str, values: Sequence[Any]) -> Record:
    names = _NAMES.get(kind, ())
    record = {"record": kind, **dict(zip(names, map(as_plain, values), strict=False))}
    if len(values) > len(names):
        record["values"] = [as_plain(value) for value in values[len(names) :]]
    return record


def _special(code: int, data: bytes) -> Any:
    if code == REF:
        return ValueDescription("holdfast:ActorRef", (("path", data.decode(errors="replace")),))
    return ValueDescription(
        {ARRAY: "numpy:ndarray", PACKED: "holdfast:Packed"}.get(code, f"extension {code}"), (("", data),)
    )


def _named(value: Any, place: str, fields: Mapping[str, tuple[str, ...]]) -> Any:
    """Give the fields of structs their names; `fields` has them by the place of the struct."""
    names = fields.get(place)
    if isinstance(value, list) and names is not None and len(value) <= len(names):
        inner = [f"{place}.{name}" if place else name for name in names]
        return {name: _named(one, at, fields) for name, one, at in zip(names, value, inner, strict=False)}
    if isinstance(value, list):
        return [_named(one, f"{place}[]", fields) for one in value]
    if isinstance(value, dict):
        return as_plain({key: _named(one, f"{place}[]", fields) for key, one in value.items()})
    return as_plain(value)


def plain_state(data: bytes) -> Record:
    """The state of a snapshot: the variables of an actor, or what its `get_state` has returned."""
    if not data:
        return {"schema_version": None, "variables": {}}
    try:
        read = read_saved(data, describe_value)
    except DamagedValue as error:
        return {"encoded": as_plain(data), "problem": str(error)}
    if not isinstance(read, tuple) or len(read) != 3:
        return {"encoded": as_plain(data), "problem": "it is no state of an actor"}
    version, form, state = read
    return {"schema_version": version, "variables" if form == "keys" else "state": as_plain(state)}


def plain_result(data: bytes) -> Any:
    """What an effect has returned."""
    try:
        return as_plain(describe_value(data))
    except DamagedValue as error:
        return {"encoded": as_plain(data), "problem": str(error)}


def _damage(error: HoldfastError, address: str | None = None) -> Record:
    if isinstance(error, DamagedStore):
        where = address if address is not None else error.address
        return {"record": "damage", "problem": error.reason, "address": where, "position": error.position}
    return {"record": "damage", "problem": str(error), "address": address, "position": None}


def _note(name: str, data: bytes) -> Any:
    """What a note says; past events are packed together."""
    if name.startswith(HISTORY):
        try:
            return as_plain(msgpack.unpackb(data, strict_map_key=False))
        except (ValueError, msgpack.UnpackException):
            pass  # It is printed as it is.
    return _text(data)


def _text(data: bytes) -> Any:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return as_plain(data)


def as_plain(value: Any) -> Any:
    """The same value, of what JSON has.

    >>> as_plain((1, b"x", {1: None}, {"a"}))
    [1, {'base64': 'eA=='}, {'pairs': [[1, None]]}, {'set': ['a']}]
    """
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return value if math.isfinite(value) else {"float": repr(value)}
        case bytes() | bytearray() | memoryview():
            return {"base64": base64.b64encode(value).decode()}
        case ValueDescription("holdfast:ActorRef", ((_, path),)):
            return {"ref": path}
        case ValueDescription(kind, (("", content),)):
            return {"type": kind, "value": as_plain(content)}
        case ValueDescription(kind, fields):
            return {"type": kind, "fields": {name: as_plain(one) for name, one in fields}}
        case list() | tuple():
            return [as_plain(one) for one in value]
        case dict() if all(type(key) is str for key in value):
            return {key: as_plain(one) for key, one in value.items()}
        case dict():
            return {"pairs": [[as_plain(key), as_plain(one)] for key, one in value.items()]}
        case set() | frozenset():
            return {"set": [as_plain(one) for one in value]}
        case datetime.date() | datetime.time():
            return {"type": type_name(type(value)), "value": value.isoformat()}
        case _:
            return _of_library(value)


def _of_library(value: Any) -> Any:
    """A value of numpy, or of another type that a state may have: its numbers, or its text."""
    kind, numpy = type_name(type(value)), sys.modules.get("numpy")
    if numpy is not None and isinstance(value, numpy.ndarray | numpy.generic):
        array = {"dtype": str(value.dtype), "shape": list(value.shape)}
        return {"type": kind, **array, "base64": base64.b64encode(value.tobytes()).decode()}
    if isinstance(value, Iterable):  # such as a deque
        return {"type": kind, "value": [as_plain(one) for one in value]}
    return {"type": kind, "value": str(value)}
