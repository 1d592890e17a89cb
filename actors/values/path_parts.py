"""What may stand in an address, and in a name beside it: one rule for all the ways in which a name comes in."""

from __future__ import annotations

import re
from typing import Final

from ..errors import SpecError, shown

CONTROL: Final = (*range(32), *range(127, 160), 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A))
"""Code points that make a terminal do something, end a line, or make a line look like another one."""
_CONTROL: Final = re.compile(f"[{re.escape(''.join(map(chr, CONTROL)))}\ud800-\udfff]")
LONGEST: Final = 1024
"""Characters of a name."""


def has_control(text: str) -> bool:
    """Whether a text has characters that a terminal or a log would obey instead of showing them, or cannot write.

    What cannot be written is half of a surrogate pair, which a text from JSON may have.

    >>> has_control("alice"), has_control("żółw 7"), has_control("a\\x1b[31m"), has_control("a\\nb")
    (False, False, True, True)
    >>> has_control("a\\ud800b"), has_control("\\U0001f600")
    (True, False)
    """
    return _CONTROL.search(text) is not None


def check_path_part(where: str, what: str, name: object) -> None:
    """Check the part of an address that one actor is named by.

    Args:
        where: whose name it is: a child, a call.
        what: which name, as the sentence begins: "the id".
        name: what was given.

    Raises:
        SpecError: it is no text, is empty or longer than `LONGEST`, or has a '/' or control characters.
    """
    if not isinstance(name, str) or not 0 < len(name) <= LONGEST or "/" in name or has_control(name):
        raise SpecError(where, f"{what} must be text without '/' and control characters, not {shown(name)}")


def check_beside(where: str, name: object) -> None:
    """Check a name that an actor has beside its address.

    Raises:
        SpecError: it is no text, is empty or longer than `LONGEST`, or has control characters.
    """
    if not isinstance(name, str) or not 0 < len(name) <= LONGEST or has_control(name):
        raise SpecError(where, f"a name must be text without control characters, not {shown(name)}")


def check_topic(where: str, topic: object) -> None:
    """Check the name of a topic. Raises SpecError: it is no text that begins with a slash and can be written."""
    if not isinstance(topic, str) or not topic.startswith("/") or has_control(topic):
        hint = f": write {'/' + topic!r}" if isinstance(topic, str) and topic and not has_control(topic) else ""
        raise SpecError(
            where, f"topic {shown(topic)} must start with '/', and be text without control characters{hint}"
        )
