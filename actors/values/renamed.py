"""What classes and their members were called before: `@renamed(...)`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import msgspec

K = TypeVar("K", bound=type)
NOTED = "_holdfast_renamed"
"""The attribute of a class that has what `@renamed` says of it."""


class Renames(NamedTuple):
    """What `@renamed` says: earlier names of the class, and of members, by what they are called now."""

    names: tuple[str, ...]
    members: dict[str, tuple[str, ...]]


def renamed(*formerly: str, **members: str | tuple[str, ...]) -> Callable[[K], K]:
    """Say what a class, or its members, were called before, so that what was recorded under those names is found.

    It goes above a message, a refusal, a struct or a dataclass inside of them (its members are fields), and above an
    actor (its members are key variables). Once nothing recorded has the old name any more, it can be taken away.

    Args:
        formerly: earlier names of the class, as "module:Class"; "Class" alone means its present module. For an actor,
            also classes whose records it takes over.
        members: earlier names of a field or variable, newest first; the keyword is its present name.

    Raises:
        TypeError: the class has no field of that name; or one old name is said of two, or is the present name of
            another one that was renamed: what a record has under it could be either.

    >>> from holdfast import Message
    >>> @renamed("Bought", amount="euros")
    ... class Sold(Message):
    ...     amount: int
    >>> former_members(Sold)
    {'amount': ('euros',)}
    """
    said = {now: (old,) if isinstance(old, str) else tuple(old) for now, old in members.items()}

    def note(kind: K) -> K:
        fields = fields_of(kind)
        unknown = [] if fields is None else [name for name in said if name not in fields]
        if unknown:
            raise TypeError(f"@renamed({unknown[0]}=...): {kind.__qualname__} has no field {unknown[0]!r}")
        module = "__main__" if kind.__module__ == "__mp_main__" else kind.__module__  # As `message_name` has it.
        own = tuple(name if ":" in name else f"{module}:{name}" for name in formerly)
        before = own_renames(kind)  # Several of them may stand above one class.
        refuse_shifts(kind, {**former_members(kind), **said})
        setattr(kind, NOTED, Renames((*own, *before.names), {**before.members, **said}))
        return kind

    return note


def refuse_shifts(kind: type, members: dict[str, tuple[str, ...]]) -> None:
    """Refuse names that were swapped, or handed on: of a record nobody can tell which of the two it means.

    Raises:
        TypeError: saying which name is meant twice.
    """
    meant: dict[str, str] = {}
    for now, olds in members.items():
        for old in olds:
            if old in members and old != now:
                why = f"{old!r} was renamed too: names cannot be swapped or handed on; give {old!r} a name that is new"
                raise TypeError(f"@renamed({now}={old!r}): {kind.__qualname__}.{why}")
            if meant.setdefault(old, now) != now:
                why = f"{old!r} is said to be what {meant[old]!r} was called, and {now!r} too; say it of one of them"
                raise TypeError(f"@renamed({now}={old!r}): {kind.__qualname__}: {why}")


def fields_of(kind: type) -> tuple[str, ...] | None:
    """The fields that a class declares; None of one whose members come with `__init__`."""
    if issubclass(kind, msgspec.Struct):
        return kind.__struct_fields__
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind))
    return None


def own_renames(kind: type) -> Renames:
    """What was said of this very class, and of none that it derives from."""
    found: Any = vars(kind).get(NOTED)
    return found if isinstance(found, Renames) else Renames((), {})


def former_names(kind: type) -> tuple[str, ...]:
    """The earlier names of a class, as "module:Class"."""
    return own_renames(kind).names


def former_members(kind: type) -> dict[str, tuple[str, ...]]:
    """The earlier names of a class's fields or variables, inherited ones too, by what they are called now."""
    found: dict[str, tuple[str, ...]] = {}
    for base in reversed(kind.__mro__):
        found |= own_renames(base).members
    return found
