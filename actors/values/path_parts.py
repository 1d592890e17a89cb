"""What may stand in an address, and in a name beside it: one rule for all the ways in which a name comes in."""

from __future__ import annotations

import re
from typing import Final

from ..errors import SpecError

CONTROL: Final = (*range(32), *range(127, 160), 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A))
"""Code points that make a terminal do something, end a line, or make a line look like another one."""
_CONTROL: Final = re.compile(f"[{re.escape(''.join(map(chr, CONTROL)))}]")


def has_control(text: str) -> bool:
    """Whether a text has characters that a terminal or a log would obey instead of showing them.

    >>> has_control("alice"), has_control("żółw 7"), has_control("a\\x1b[31m"), has_control("a\\nb")
    (False, False, True, True)
    """
    return _CONTROL.search(text) is not None


def check_path_part(where: str, what: str, name: object) -> None:
    """Check the part of an address that one actor is named by.

    Args:
        where: whose name it is: a child, a call.
        what: which name, as the sentence begins: "the id".
        name: what was given.

    Raises:
        SpecError: it is no text, is empty, or has a '/' or control characters.
    """
    if not isinstance(name, str) or not name or "/" in name or has_control(name):
        raise SpecError(where, f"{what} must be text without '/' and control characters, not {name!r}")


def check_beside(where: str, name: str) -> None:
    """Check a name that an actor has beside its address. Raises SpecError: it is empty or has control characters."""
    if not name or has_control(name):
        raise SpecError(where, f"a name must be text without control characters, not {name!r}")
