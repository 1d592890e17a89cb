"""Supervision trees from a mapping or a TOML file. Classes are named `package.module:Class`; nothing else is code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

from ..actors.backoff import Backoff
from ..actors.errors import HoldfastError, SpecError
from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.mailbox import bounded
from ..actors.process.resource_limits import Limits
from ..actors.process.wire.start_codec import imported
from .dynamic import dynamic
from .rules import rule
from .services.partition import partitions
from .spec import ChildSpec, child
from .tree import supervisor

T = TypeVar("T")

START = ("start", "args", "kwargs")
"""What makes a recipe in a table; all other keys of a child are options of `child`."""


def tree_from(mapping: Mapping[str, Any], where: str = "tree") -> ChildSpec:
    """Make a supervisor spec from plain data, such as parsed TOML, JSON or YAML.

    A table is a child (`id`, `start = "package.module:Class"`, `args`, `kwargs`, and the options of `child`), or a
    supervisor (`name`, `children` and the options of `supervisor`; with `kind = "dynamic"` or `"partitions"` those of
    `dynamic` and `partitions`, whose `template` and `copy` are tables too). `recovery` is a table with `use`, the name
    of a method such as `"holdfast:hybrid"`, and its options; `mechanism` is one with `use` = `"holdfast.ftm:PBR"`, or a
    list of such, outermost first.

    Args:
        mapping: the table of the top supervisor.
        where: how errors name it.

    Raises:
        SpecError: naming the place and what is wrong there.

    >>> tree_from({"name": "top", "strategy": "one_for_all", "children": []}).id
    'top'
    >>> tree_from({"name": "top", "children": [{"id": "a", "start": "no_such:Class"}]})
    Traceback (most recent call last):
    holdfast.actors.errors.SpecError: tree.children[0].start: 'no_such:Class': No module named 'no_such'
    """
    table = _table(mapping, where)
    if "start" in table:
        raise SpecError(where, "the top must be a supervisor, with name and children")
    if any(key.startswith("/") for key in table):
        problem = "its tables are named for addresses: that is a whole tree for `holdfast run`, `plan` and `apply`"
        raise SpecError(where, f"{problem}; here is one supervisor, with name and children")
    return _spec(table, where)


def load_tree(path: str | Path) -> ChildSpec:
    """Read a supervisor spec from a TOML file; see `tree_from`.

    Raises:
        SpecError: naming file and place, and what is wrong there. OSError: the file cannot be read.
    """
    import tomllib

    try:
        mapping = tomllib.loads(Path(path).read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SpecError(str(path), str(error)) from error
    return tree_from(mapping, f"{path}: tree")


def _spec(value: object, where: str) -> ChildSpec:
    """A child or a supervisor."""
    table = _table(value, where)
    if "start" in table:
        options = {key: table[key] for key in table if key not in START}
        options.setdefault("id", None)
        return _call(child, {**_options(options, where), "start": _recipe(table, where)}, where)
    kind = table.pop("kind", "supervisor")
    if "name" not in table:
        raise SpecError(where, "a child needs id and start, a supervisor name and children")
    if kind == "supervisor":
        table["children"] = _children(table.get("children", ()), f"{where}.children")
        return _call(supervisor, _options(table, where), where)
    if kind == "dynamic":
        if "template" in table:
            table["template"] = _spec(table["template"], f"{where}.template")
        return _call(dynamic, _options(table, where), where)
    if kind == "partitions":
        table["copy"] = _spec(table.get("copy", {}), f"{where}.copy")
        return _call(partitions, _options(table, where), where)
    raise SpecError(f"{where}.kind", f"must be one of supervisor, dynamic, partitions, not {kind!r}")


def _children(value: object, where: str) -> list[ChildSpec]:
    return [_spec(one, f"{where}[{index}]") for index, one in enumerate(_list(value, where))]


def _recipe(table: dict[str, Any], where: str) -> Start[Any]:
    kind = _named(table["start"], f"{where}.start")
    if not (isinstance(kind, type) and issubclass(kind, Actor)):
        raise SpecError(f"{where}.start", f"{table['start']!r} is no Actor class")
    args = tuple(_list(table.get("args", ()), f"{where}.args"))
    return Start(kind, args, _table(table.get("kwargs", {}), f"{where}.kwargs"))


def _options(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Options whose values are tables of their own, made into what they stand for."""
    made: dict[str, Callable[[Any, str], Any]] = {
        "backoff": lambda value, at: _call(Backoff, _table(value, at), at),
        "limits": lambda value, at: _call(Limits, _table(value, at), at),
        "mailbox": lambda value, at: _call(bounded, _table(value, at), at),
        "mechanism": _mechanism,
        "recovery": _used,
        "rules": _rules,
    }
    return {key: made[key](value, f"{where}.{key}") if key in made else value for key, value in table.items()}


def _used(value: object, where: str) -> Any:
    """What `use` names, made with the other options."""
    table = _table(value, where)
    return _call(_named(table.pop("use", None), f"{where}.use"), table, where)


def _mechanism(value: object, where: str) -> Any:
    if isinstance(value, Mapping):
        return _used(value, where)
    return tuple(_used(one, f"{where}[{index}]") for index, one in enumerate(_list(value, where)))


def _rules(value: object, where: str) -> list[Any]:
    return [
        _call(rule, _table(one, f"{where}[{index}]"), f"{where}[{index}]")
        for index, one in enumerate(_list(value, where))
    ]


def _call(make: Callable[..., T], options: dict[str, Any], where: str) -> T:
    """Make it, and say where it went wrong; unknown and missing options are found by the call itself."""
    try:
        return make(**options)
    except HoldfastError as error:
        raise SpecError(where, str(error)) from error
    except (TypeError, ValueError) as error:
        raise SpecError(where, str(error).replace(f"{make.__name__}()", "it")) from error


def _named(name: object, where: str) -> Any:
    """Import the class or function that `package.module:Name` stands for."""
    if not isinstance(name, str) or name.count(":") != 1:
        raise SpecError(where, f"must be a name such as 'package.module:Class', not {name!r}")
    try:
        return imported(name)
    except Exception as error:  # Importing a module runs it: it may raise anything.
        raise SpecError(where, f"{name!r}: {error}") from error


def _table(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise SpecError(where, f"must be a table, not {value!r}")
    table = dict(cast("Mapping[object, Any]", value))
    for key in table:
        if not isinstance(key, str):
            raise SpecError(where, f"keys must be text, not {key!r}")
    return cast("dict[str, Any]", table)


def _list(value: object, where: str) -> Sequence[Any]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise SpecError(where, f"must be a list, not {value!r}")
    return value  # type: ignore[no-any-return,unused-ignore]
