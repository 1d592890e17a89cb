"""Patterns of addresses with conditions, such as `/app/**[restarts>3, state=running]`."""

from __future__ import annotations

import dataclasses
import fnmatch
import operator
import re
from collections.abc import Callable, Collection, Iterable
from typing import Any, Final

from ...actors.errors import HoldfastError, NoSuchActor
from ...system.history.paths import literal, matcher, one_meant
from ..overview import ActorRow

COMPARE: Final[dict[str, Callable[[Any, Any], bool]]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
    "=": operator.eq,
}
FORM: Final = re.compile(r"(?P<glob>(?:\\[*?\[\]\\]|[^\[\]])+?)(?:\[(?P<conditions>[^\[\]]*)\])?")
CONDITION: Final = re.compile(r"\s*(?P<field>\w+)\s*(?P<verb>>=|<=|!=|=|>|<)\s*(?P<value>.*?)\s*")
FIELDS: Final = tuple(name for name in ActorRow.__struct_fields__ if name not in ("path", "is_supervisor"))
NUMBERS: Final = ("pid", "restarts", "queued", "turn_seconds", "allowed_bytes")


class BadPattern(HoldfastError, text="pattern {pattern!r}: {problem}"):
    """What was given is no address, no name and no pattern."""

    pattern: str
    problem: str


@dataclasses.dataclass(frozen=True, slots=True)
class Condition:
    """One comparison of a field of an actor."""

    field: str
    verb: str
    value: str

    def holds(self, row: ActorRow) -> bool:
        """Whether it is true of an actor. Texts may have `*`; a class may be given by its last part."""
        told = dict(zip(row.__struct_fields__, _values(row), strict=True))[self.field]
        if self.field in NUMBERS:
            return COMPARE[self.verb](float(told), float(self.value))
        texts = told if isinstance(told, tuple) else (told, told.rpartition(".")[2])
        is_like = any(fnmatch.fnmatchcase(text, self.value) for text in texts or ("",))
        return is_like == (self.verb == "=")


@dataclasses.dataclass(frozen=True, slots=True)
class Pattern:
    """An address, a name, or a pattern with conditions.

    `*` stands for a part of an address, or a piece of one, and `**` for any number of whole parts. A sign with a
    backslash before it stands for itself.
    """

    text: str
    is_like: Callable[[str], bool]
    conditions: tuple[Condition, ...]
    one: str | None
    """The one address or name that it is, which has to be there."""

    def matches(self, row: ActorRow) -> bool:
        """Whether an actor is meant."""
        named = self.one is not None and self.one in row.names
        return (named or self.is_like(row.path)) and all(one.holds(row) for one in self.conditions)


def read_pattern(text: str) -> Pattern:
    """Make a pattern of what a user has typed. Raises BadPattern."""
    form = FORM.fullmatch(text)
    if form is None:
        raise BadPattern(text, "write an address, with conditions behind it in brackets: '/app/**[restarts>3]'")
    glob, given = form["glob"].strip(), form["conditions"]
    conditions = () if given is None else tuple(_condition(text, one) for one in given.split(","))
    one = one_meant(glob) if given is None else None
    if not glob.startswith("/") and one is None:
        raise BadPattern(text, "an address begins with '/', as /app/bank does")
    return Pattern(text, _below(glob.rstrip("/") or "/"), conditions, one)


def _condition(pattern: str, text: str) -> Condition:
    found = CONDITION.fullmatch(text)
    if found is None:
        raise BadPattern(pattern, f"{text.strip()!r} is no condition such as restarts>3 or state=suspended")
    one = Condition(found["field"], found["verb"], found["value"])
    if one.field not in FIELDS:
        raise BadPattern(pattern, f"there is no field {one.field!r}; there are {', '.join(FIELDS)}")
    if one.field in NUMBERS:
        try:
            float(one.value)
        except ValueError:
            raise BadPattern(pattern, f"{one.field} is compared with a number, not {one.value!r}") from None
    elif one.verb not in ("=", "!="):
        raise BadPattern(pattern, f"{one.field} is text: compare it by = or !=")
    return one


def _below(glob: str) -> Callable[[str], bool]:
    """A test for addresses. At its end `**` is whoever is below, and not the one above them: a change is for those.

    >>> [_below("/app/**")(path) for path in ("/app", "/app/a", "/app/a/b")]
    [False, True, True]
    >>> [_below("/app/**/x*")(path) for path in ("/app/x", "/app/a/x1", "/app/a")]
    [True, True, False]
    """
    return matcher(f"{glob}/*" if glob.split("/")[-1] == "**" else glob)


def _values(row: ActorRow) -> tuple[Any, ...]:
    return tuple(getattr(row, name) for name in row.__struct_fields__)


def refuse_address(pattern: Pattern, addresses: Collection[str]) -> None:
    """Have a pattern mean no others while somebody has that very address. Raises BadPattern."""
    if pattern.one is None and pattern.text in addresses:
        problem = f"an actor has this very address; to mean it alone write '{literal(pattern.text)}'"
        raise BadPattern(pattern.text, problem)


def select(rows: Iterable[ActorRow], texts: Iterable[str]) -> list[ActorRow]:
    """Those that are meant, each once, in the order of the rows.

    Raises:
        BadPattern: a text is no pattern, or an actor has that very address.
        NoSuchActor: an address or name is nobody's, or a pattern fits nobody.
    """
    known, wanted = list(rows), [read_pattern(text) for text in texts]
    addresses = {row.path for row in known}
    for pattern in wanted:
        refuse_address(pattern, addresses)
        if not any(pattern.matches(row) for row in known):
            raise NoSuchActor(pattern.text)
    return [row for row in known if any(pattern.matches(row) for pattern in wanted)]
