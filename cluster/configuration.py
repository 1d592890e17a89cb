"""`holdfast.toml` and the environment: where a program keeps what it must not lose, without a change to the program.

The environment goes before the file, and arguments of `ActorSystem` before both. The file names other files with
secrets, and holds none itself.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, get_args

import msgspec

from ..actors.errors import SpecError
from ..checkpoint.method import Durability
from ..checkpoint.recovery_file import find_line
from .leadership import Standby

FILE: Final = "holdfast.toml"
CONFIG: Final = "HOLDFAST_CONFIG"
"""The variable that names another file."""
_PREFIX: Final = "HOLDFAST_"
_NEAR: Final = 0.8
"""How alike two words are, from 0 to 1, of which one is taken for the other one misspelt: STOR and STORE have 0.89."""
_PATHS: Final = ("creds", "nkey", "ca", "certificate", "key")


class NatsSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a store on NATS is reached; `None` is not said. For what each means see `NatsAccess`.

    Attributes:
        creds, nkey, ca, certificate, key: absolute paths; in a file they may be relative to the folder of that file.
    """

    creds: str | None = None
    nkey: str | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    insecure: bool | None = None
    replicas: int | None = None

    def told(self) -> dict[str, str | bool | int]:
        """What is said, by name, as `access_of` takes it."""
        found: dict[str, str | bool | int | None] = msgspec.structs.asdict(self)
        return {name: value for name, value in found.items() if value is not None}


class Configuration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the file and the environment say; `None` is not said.

    Attributes:
        store: see `ActorSystem(store=...)`.
        standby: see `ActorSystem(standby=...)`.
        durability: see `ActorSystem(durability=...)`.
        nats: how a store on NATS is reached.
    """

    store: str | None = None
    standby: Standby | None = None
    durability: Durability | None = None
    nats: NatsSettings = NatsSettings()

    def under(self, *, store: str | None, standby: Standby | None, durability: Durability | None) -> Configuration:
        """This configuration, where an argument that is given goes before what is said here."""
        given = {"store": store, "standby": standby, "durability": durability}
        return msgspec.structs.replace(self, **{name: value for name, value in given.items() if value is not None})


CHOICES: Final[dict[str, tuple[str, ...]]] = {"standby": get_args(Standby), "durability": get_args(Durability)}
"""Keys with a few possible values."""
KINDS: Final = {"replicas": "the number 1 or 3", "insecure": "true or false"}
"""What the value of a key has to be, unless that is a text."""


def read_configuration(path: Path | None = None, environ: Mapping[str, str] = os.environ) -> Configuration:
    """Read the file and the environment.

    Args:
        path: the file; if it is left out, the one that HOLDFAST_CONFIG names, or `holdfast.toml` in the working
            directory, if there is one.
        environ: HOLDFAST_STORE, HOLDFAST_STANDBY, HOLDFAST_DURABILITY and HOLDFAST_NATS_CREDS, _NKEY, _CA,
            _CERTIFICATE, _KEY, _INSECURE and _REPLICAS; an empty one says nothing.

    Raises:
        SpecError: naming the file and the line, or the variable, and what is wrong there; or the named file is not
            there, is no regular one, or others may write to it.
    """
    named = path or (Path(environ[CONFIG]) if environ.get(CONFIG) else None)
    file = named or Path(FILE)
    if named is None and not file.exists():
        return _with_environment(Configuration(), environ)
    return _with_environment(_of_file(file), environ)


def _of_file(file: Path) -> Configuration:
    import tomllib  # only now: most programs have no such file

    text = _text(file)
    try:
        said = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:  # Which says line and column.
        raise SpecError(str(file), str(error)) from error
    table = said.pop("nats", {})
    if not isinstance(table, dict):
        raise SpecError(_place(file, text, "", "nats"), "nats must be a table: write [nats] in a line of its own")
    top: dict[str, Any] = {
        key: _value(Configuration, key, value, _place(file, text, "", key), strict=True) for key, value in said.items()
    }
    nats: dict[str, Any] = {
        key: _value(NatsSettings, key, value, _place(file, text, "nats", key), strict=True)
        for key, value in table.items()
    }
    for key in nats.keys() & {*_PATHS}:
        nats[key] = os.path.abspath(file.parent / Path(nats[key]).expanduser())
    return Configuration(**top, nats=NatsSettings(**nats))


def _with_environment(found: Configuration, environ: Mapping[str, str]) -> Configuration:
    _refuse_misspelt(environ)
    top: dict[str, Any] = {}
    for key in _keys(Configuration):
        if value := environ.get(f"{_PREFIX}{key.upper()}"):
            top[key] = _value(Configuration, key, value, f"{_PREFIX}{key.upper()}", strict=False)
    nats: dict[str, Any] = {}
    prefix = f"{_PREFIX}NATS_"
    for name, value in environ.items():
        if name.startswith(prefix) and value:
            key = name.removeprefix(prefix).lower()
            nats[key] = _value(NatsSettings, key, value, name, strict=False)
    for key in nats.keys() & {*_PATHS}:
        nats[key] = os.path.abspath(Path(nats[key]).expanduser())
    return msgspec.structs.replace(found, **top, nats=msgspec.structs.replace(found.nats, **nats))


def _refuse_misspelt(environ: Mapping[str, str]) -> None:
    """Refuse a variable that is nearly one of ours, and would be passed over; other programs have theirs.

    Raises:
        SpecError: naming it, and the one that it resembles.
    """
    from difflib import get_close_matches  # only where there are such variables

    known = [CONFIG.removeprefix(_PREFIX), *(key.upper() for key in _keys(Configuration))]
    known += [f"NATS_{key.upper()}" for key in _keys(NatsSettings)]
    for name, value in environ.items():
        word = name.removeprefix(_PREFIX)
        if value and word != name and word not in known and not word.startswith("NATS_"):
            near = get_close_matches(word, known, n=1, cutoff=_NEAR)
            if near:
                raise SpecError(name, f"there is no such variable, did you mean {_PREFIX}{near[0]}?")


def _text(file: Path) -> str:
    """The text of the file.

    Raises:
        SpecError: it cannot be read, or somebody else can write to it, and so say where this program keeps things.
    """
    try:
        # Without waiting for somebody who may never write, as behind the name of a pipe.
        with open(file, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as opened:
            info = os.fstat(opened.fileno())
            if not stat.S_ISREG(info.st_mode):
                raise SpecError(str(file), "is no regular file: put the configuration into one")
            if info.st_uid not in (0, os.geteuid()) or info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                raise SpecError(str(file), f"somebody else may write to it: make it your own, and chmod go-w {file}")
            return opened.read().decode("utf-8-sig")  # Some editors begin a file with a mark that TOML does not know.
    except OSError as error:
        raise SpecError(str(file), f"cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SpecError(str(file), f"is no UTF-8: {error.reason} at byte {error.start}") from error


def _place(file: Path, text: str, table: str, key: str) -> str:
    """The file and the line of a key; `table` is empty for those before the first table."""
    # What stands before the first table is looked up as if a table without a name stood above it.
    line = find_line(text, table, key) if table else find_line(f"[]\n{text}", "", key) - 1
    return f"{file}, line {line}" if line > 0 else str(file)


def _keys(kind: type[msgspec.Struct]) -> list[str]:
    return [name for name in kind.__struct_fields__ if name != "nats"]


def _value(kind: type[msgspec.Struct], key: str, value: object, place: str, *, strict: bool) -> Any:
    """A value, checked.

    Raises:
        SpecError: there is no such key, or the value is not one that it may have.
    """
    known = _keys(kind)
    if key not in known:
        there = ", ".join(known) + (" and the table [nats]" if kind is Configuration else "")
        raise SpecError(place, f"there is no key {key!r}{_near(key, known)}; there are {there}")
    if key in CHOICES and value not in CHOICES[key]:
        raise SpecError(place, f"{key} must be one of {', '.join(map(repr, CHOICES[key]))}, not {value!r}")
    if value is None or value == "":
        raise SpecError(place, f"{key} must not be empty: leave it out")
    hint = next(field.type for field in msgspec.structs.fields(kind) if field.name == key)
    try:
        return msgspec.convert(value, hint, strict=strict)
    except msgspec.ValidationError as error:
        raise SpecError(place, f"{key} must be {KINDS.get(key, 'a text')}, not {value!r}") from error


def _near(word: str, known: Iterable[str]) -> str:
    from difflib import get_close_matches  # only for a refusal

    near = get_close_matches(word, [*known], n=1)
    return f", did you mean {near[0]!r}?" if near else ""
