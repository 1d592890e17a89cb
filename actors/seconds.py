"""Numbers of seconds that users give: one rule for all of them, and one sentence that refuses the others."""

from __future__ import annotations

import sys
from typing import TypeGuard

from .errors import SpecError


def is_seconds(value: object, *, or_zero: bool = False) -> TypeGuard[float]:
    """Whether this is a finite number > 0, or 0 where that is allowed; True and False are no numbers.

    >>> is_seconds(5), is_seconds(0), is_seconds(0, or_zero=True), is_seconds(True), is_seconds(float("inf"))
    (True, False, True, False, False)
    """
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return 0 < value <= sys.float_info.max or (or_zero and value == 0)


def check_seconds(where: str, name: str, value: object, *, or_zero: bool = False) -> float:
    """Return `value` as a float, if it is a number of seconds: 5 and 5.0 are the same wherever they are written down.

    Args:
        where: whose number it is: an address, a child, a call.
        name: the parameter's.
        value: what was given.
        or_zero: 0 is one too.

    Raises:
        SpecError: it is none.
    """
    if not is_seconds(value, or_zero=or_zero):
        raise SpecError(where, f"{name} must be a finite number of seconds {'>=' if or_zero else '>'} 0, not {value!r}")
    return float(value)
