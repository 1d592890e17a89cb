"""Patterns of paths: which addresses a question is about."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Callable

from ...actors.errors import SpecError
from ...actors.kernel.ref import ActorRef, Target

LONGEST = 1_000
"""Characters of a pattern."""
PARTS = "ftm"
"""The name of what has the parts of a protected actor."""
_QUOTED = re.compile(r"\\([*?\[\]\\])")
"""A sign that stands for itself."""


def matcher(pattern: str) -> Callable[[str], bool]:
    r"""A test for the addresses that a pattern means.

    In a name, `*` stands for any characters and `?` for one. `**` as a name stands for any number of names, none
    included: `/app/shop/**` is the shop with all below it. A sign with a backslash before it stands for itself.

    Raises:
        SpecError: it is no text, or too long.

    >>> shop = matcher("/app/shop/**")
    >>> shop("/app/shop"), shop("/app/shop/till/1"), shop("/app/shopping")
    (True, True, False)
    >>> matcher("/app/*/worker-?")("/app/north/worker-1"), matcher("/app/*")("/app/north/worker-1")
    (True, False)
    >>> matcher(r"/app/\*")("/app/*"), matcher(r"/app/\*")("/app/a"), matcher(r"/app/\[1\]*")("/app/[1]st")
    (True, False, True)
    """
    if not isinstance(pattern, str) or len(pattern) > LONGEST:
        raise SpecError("history", f"a path is text of at most {LONGEST} characters, not {str(pattern)[:50]!r}")
    meant = one_meant(pattern)
    if meant is not None:
        return meant.__eq__
    parts = _QUOTED.sub(r"[\1]", pattern).split("/")
    names = [re.compile(fnmatch.translate(part)) if part != "**" else None for part in parts]

    def matches(path: str) -> bool:
        reached = _past_any({0}, names)
        for name in path.split("/"):
            stepped = {at if names[at] is None else at + 1 for at in reached if _takes(names, at, name)}
            reached = _past_any(stepped, names)
        return len(names) in reached

    return matches


def one_meant(pattern: str) -> str | None:
    r"""The one address, or name, that a pattern means; None if it may mean several.

    >>> one_meant("/app/till"), one_meant(r"/app/\*"), one_meant("/app/*")
    ('/app/till', '/app/*', None)
    """
    is_one = not any(sign in _QUOTED.sub("", pattern) for sign in "*?[")
    return _QUOTED.sub(r"\1", pattern) if is_one else None


def literal(address: str) -> str:
    r"""A pattern that means just this address, whatever signs are in it.

    >>> print(literal("/app/[1]*"))
    /app/\[1\]\*
    """
    return "".join(f"\\{sign}" if sign in "*?[]\\" else sign for sign in address)


def is_part(path: str, address: str = "") -> bool:
    """Whether a path below an address is a part of a protected actor, which tells of its parts itself.

    >>> is_part("/app/till/ftm/r1"), is_part("/app/till")
    (True, False)
    """
    return PARTS in path[len(address) :].split("/")


def pattern_of(target: Target) -> str:
    """The pattern of addresses that a caller means by an actor, or by a text."""
    return literal(target.path) if isinstance(target, ActorRef) else target


def _takes(names: list[re.Pattern[str] | None], at: int, name: str) -> bool:
    if at == len(names):
        return False
    pattern = names[at]
    return pattern is None or pattern.match(name) is not None


def _past_any(reached: set[int], names: list[re.Pattern[str] | None]) -> set[int]:
    """Where one may be as well: behind a `**` that stands for nothing more."""
    found = set(reached)
    for at in sorted(reached):
        while at < len(names) and names[at] is None:
            at += 1
            found.add(at)
    return found
