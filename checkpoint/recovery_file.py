"""The recovery file: methods and key variables of a program's actors, without a change to the program (R17).

A TOML table for each class ("package.module:Class") or for addresses ("/app/bank/*"). What is wrong in it is refused
with file, line, table and setting; what only an actor can show (that it has such a variable, and that its value can be
saved) is refused when that is constructed.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import inspect
import re
import typing
from collections.abc import Callable
from os import PathLike, fspath
from pathlib import Path
from typing import Any, cast

import msgspec

from ..actors.errors import DamagedValue, HoldfastError, SpecError, type_name
from ..actors.kernel.actor import Actor
from ..actors.kernel.message import Message, message_name
from ..actors.values.classes import find_class
from . import method as methods
from .method import Method
from .recovery_settings import SafeState, held, safe_state

METHODS: dict[str, Callable[..., Method]] = {
    "fresh": methods.fresh,
    "checkpoint_only": methods.checkpoint_only,
    "replay_only": methods.replay_only,
    "hybrid": methods.hybrid,
}
IN_A_FILE: dict[str, Any] = {
    "safe_state": str | list[str] | dict[str, Any],
    "held": dict[str, Any],
}
"""Types of settings that look different in a file."""
NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")


@dataclasses.dataclass(frozen=True, slots=True)
class RecoveryTable:
    """One table: a method, key variables, or both."""

    method: Method | None
    key_variables: tuple[str, ...] | None
    origin: str


class RecoveryFile:
    """The recovery methods that a file gives to actors; made by `load_recovery`."""

    def __init__(self, text: str, path: str) -> None:
        """Raises SpecError: naming file, line, table and what is wrong there."""
        import tomllib  # only now: most programs have no such file

        self.text, self.path = text, path
        try:
            tables = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:  # Which says line and column.
            raise SpecError(path, str(error)) from error
        self._classes: dict[str, RecoveryTable] = {}
        self._addresses: list[tuple[str, RecoveryTable]] = []
        self._unmet: dict[str, str] = {}
        for name, table in tables.items():
            is_address = name.startswith("/")
            if not isinstance(table, dict) or not (is_address or ":" in name):
                raise self._error(name, "must be a table named for a class, 'package.module:Class', or for addresses")
            entry = self._entry(name, cast("dict[str, Any]", table))
            if is_address:
                self._addresses.append((name, entry))
            else:
                self._classes[name] = entry

    # -- what is asked of it ------------------------------------------------------------------------------------------

    def check(self, system: str) -> None:
        """Look at the classes that it names, and whether its addresses can be some of this system.

        Raises:
            SpecError: there is no such actor class, or the addresses are another system's.
        """
        entries = dict(self._addresses) | self._classes
        unmet = (name for name, one in entries.items() if one.method is None or one.method.records)
        self._unmet = {name: self._where(name) for name in unmet}
        for name, _ in self._addresses:
            fixed = re.split(r"[*?[]", name, maxsplit=1)[0]
            if not fixed.startswith(f"/{system}/") and (fixed == name or not f"/{system}/".startswith(fixed)):
                raise self._error(name, f"names no address of this system, which all begin with '/{system}/'")
        for name in self._classes:
            try:
                kind = find_class(name)
            except DamagedValue as error:
                raise self._error(name, error.args[0]) from error
            if not issubclass(kind, Actor):
                raise self._error(name, f"{type_name(kind)} is no actor class")

    def method_for(self, address: str, kind: type[Actor], given: Method | None = None) -> Method | None:
        """Choose how the actor at an address is recovered: as its child spec says (`given`), else as this file does.

        Of the tables for addresses the one that names it counts, else the first that fits; then that for the class,
        which may also add the key variables to what another place says of the method.
        """
        fitting = self.meet(address, message_name(kind))
        method = given or next((entry.method for entry in fitting if entry.method is not None), None)
        named = next((entry for entry in fitting if entry.key_variables is not None), None)
        if named is None:
            return method
        method = method or methods.hybrid()
        if not method.records:
            return method
        return dataclasses.replace(method, key_variables=named.key_variables, origin=named.origin)

    def meet(self, address: str, kind: str) -> list[RecoveryTable]:
        """Note that an actor is started; returns the tables that are for it, the most telling first."""
        names = [name for name, _ in self._addresses if name == address]
        names += [name for name, _ in self._addresses if fnmatch.fnmatchcase(address, name)]
        names += [kind] if kind in self._classes else []
        for name in names:
            self._unmet.pop(name, None)
        known = dict(self._addresses) | self._classes
        return [known[name] for name in names]

    def take_unmet(self) -> list[tuple[str, str]]:
        """Return the tables that nobody has been started for so far, and where they stand; each is given out once."""
        unmet, self._unmet = self._unmet, {}
        return list(unmet.items())

    def complete(self, spec: Any, address: str) -> Any:
        """Add the recovery that this file has for a child spec. Raises SpecError: it does not go with the class."""
        if spec.is_supervisor:
            return spec
        recovery = self.method_for(address, spec.start.kind, spec.recovery)
        return spec if recovery == spec.recovery else dataclasses.replace(spec, recovery=recovery)

    def data(self) -> dict[str, str]:
        """Return the file as plain data, for another process."""
        return {"text": self.text, "path": self.path}

    # -- reading it ---------------------------------------------------------------------------------------------------

    def _entry(self, name: str, table: dict[str, Any]) -> RecoveryTable:
        chosen = table.pop("method", None)
        if chosen is not None and chosen not in METHODS:
            known = ", ".join(map(repr, METHODS))
            raise self._error(name, f"method must be one of {known}, not {chosen!r}", "method")
        named = self._named(name, table.pop("key_variables", None))
        origin = self._where(name, "key_variables")
        if chosen is None and not table and named is not None:
            return RecoveryTable(None, named, origin)
        make = METHODS[chosen or "hybrid"]
        settings = self._typed(name, chosen or "hybrid", make, table)
        try:
            if "safe_state" in settings:
                settings["safe_state"] = _safe_state(settings["safe_state"])
            if "held" in settings:
                settings["held"] = _held(settings["held"])
            return RecoveryTable(make(**settings), named, origin)
        except (SpecError, TypeError) as error:
            wrong = next((one for one in settings if one in str(error)), None)
            raise self._error(name, str(error), wrong) from error

    def _typed(self, name: str, method: str, make: Callable[..., Method], table: dict[str, Any]) -> dict[str, Any]:
        """The settings, each of the type that the method's function has for it."""
        hints = typing.get_type_hints(make)
        for setting, value in table.items():
            if setting not in inspect.signature(make).parameters or setting == "hooks":
                raise self._error(name, f"{method} has no setting {setting!r} in a file", setting)
            try:
                table[setting] = msgspec.convert(value, IN_A_FILE.get(setting, _decodable(hints[setting])))
            except msgspec.ValidationError as error:
                raise self._error(name, f"{setting}: {error}", setting) from error
        return table

    def _named(self, name: str, given: Any) -> tuple[str, ...] | None:
        if given is None:
            return None
        try:
            names = msgspec.convert(given, list[str])
        except msgspec.ValidationError as error:
            raise self._error(name, f"key_variables: {error}", "key_variables") from error
        for number, one in enumerate(names):
            if not NAME.fullmatch(one):
                problem = f"{one!r} names no variable; write 'goal' or 'robot.pose.x', without 'self'"
            elif one in names[:number]:
                problem = f"{one!r} stands there twice"
            elif inside := [other for other in names if one.startswith(f"{other}.")]:
                problem = f"{one!r} is inside {inside[0]!r}, which is saved whole"
            else:
                continue
            raise self._error(name, f"key_variables: {problem}", "key_variables", one)
        return tuple(names)

    def _where(self, table: str, setting: str | None = None, value: str | None = None) -> str:
        line = find_line(self.text, table, setting, value)
        return f"{self.path}{f', line {line}' if line else ''}, [{table}]"

    def _error(self, table: str, problem: str, setting: str | None = None, value: str | None = None) -> SpecError:
        return SpecError(self._where(table, setting, value), problem)


def load_recovery(path: str | PathLike[str]) -> RecoveryFile:
    """Read a recovery file, for `ActorSystem(recovery=...)`, which also takes its path.

    Raises:
        SpecError: naming file, line, table and what is wrong there. OSError: it cannot be read.
    """
    name = fspath(path)
    try:
        text = Path(name).read_text("utf-8")
    except UnicodeDecodeError as error:
        raise SpecError(name, str(error)) from error
    return RecoveryFile(text, name)


def find_line(text: str, table: str, setting: str | None = None, value: str | None = None) -> int:
    """Where in a TOML text a table stands, or a setting or value in it; 0 if it is written in some other way.

    >>> find_line('["/a"]\\ninterval = 1\\n["/b"]\\ninterval = 2', "/b", "interval")
    4
    """
    found = 0
    inside = False
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped.startswith("["):
            inside = re.match(rf"""\[\s*(["']?){re.escape(table)}\1\s*[.\]]""", stripped) is not None
            if inside and not found:
                found = number
            if inside and setting is not None and re.search(rf"\.\s*{re.escape(setting)}\s*[.\]]", stripped):
                return number
        elif inside and setting is not None and re.match(rf"{re.escape(setting)}\s*[.=]", stripped):
            if value is None:
                return number
            found, setting = number, None
        if inside and setting is None and value is not None and re.search(rf"""["']{re.escape(value)}["']""", line):
            return number
    return found


def _decodable(hint: Any) -> Any:
    """A type as msgspec checks it; what it has no check for, or none that names the choices, the method's does."""
    if any(typing.get_origin(one) is typing.Literal for one in (hint, *typing.get_args(hint))):
        return Any
    try:
        msgspec.json.Decoder(hint)
    except TypeError:
        return Any
    return hint


def _held(table: dict[str, Any]) -> Any:
    """`{capacity = 10}`, or a table of those by topic."""
    if "capacity" in table:
        return held(**table)
    for topic, one in table.items():
        if not isinstance(one, dict):
            raise SpecError("held", f"{topic!r} must be a table with capacity and overflow, not {one!r}")
    return {topic: held(**one) for topic, one in table.items()}


def _safe_state(given: Any) -> Any:
    """An address, several, or a table with `to`, `enter` and `leave`."""
    if not isinstance(given, dict):
        return given
    table = cast("dict[str, Any]", given)
    unknown = sorted(set(table) - {"to", "enter", "leave"})
    if unknown or "to" not in table:
        raise SpecError(
            "safe_state", f"has to, enter and leave; {f'not {unknown[0]!r}' if unknown else 'to is missing'}"
        )
    to = [table["to"]] if isinstance(table["to"], str) else table["to"]
    made: SafeState = safe_state(*to, enter=_message(table.get("enter")), leave=_message(table.get("leave")))
    return made


def _message(table: Any) -> Message[Any] | None:
    """A message from a table: `message` is its class, the rest are its fields."""
    if table is None:
        return None
    if not isinstance(table, dict) or not isinstance(table.get("message"), str):
        raise SpecError("safe_state", f"a message is a table with message = 'package.module:Class', not {table!r}")
    fields = {key: value for key, value in cast("dict[str, Any]", table).items() if key != "message"}
    try:
        kind = find_class(table["message"])
        if not issubclass(kind, Message):
            raise SpecError("safe_state", f"{type_name(kind)} is no message class")
        made: Message[Any] = kind(**fields)
        return msgspec.convert(msgspec.to_builtins(made), kind)
    except (HoldfastError, TypeError, msgspec.ValidationError) as error:
        raise SpecError("safe_state", f"message {table['message']}: {error}") from error
