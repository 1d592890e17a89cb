"""Strict comparison: equal values of equal types, down to the sign of a zero."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from ...actors.errors import StoreError
from ...checkpoint.snapshot.shared_blocks import Segment


class PromiseBroken(AssertionError):
    """An engine does not keep a promise of the journal protocol: the text says which, and what was found instead."""


def same(found: object, wanted: object) -> bool:
    """Whether two values are equal and of the same types, all their items too; a NaN is like another.

    >>> same((1, 0.0), (1, 0.0)), same(1, True), same(0.0, -0.0), same([1], (1,))
    (True, False, False, False)
    """
    if type(found) is not type(wanted):
        return False
    if isinstance(found, tuple | list) and isinstance(wanted, tuple | list):
        return len(found) == len(wanted) and all(map(same, found, wanted))
    if isinstance(found, dict) and isinstance(wanted, dict):
        return same(list(found.items()), list(wanted.items()))  # Their order counts.
    if isinstance(found, float) and isinstance(wanted, float):
        return (found != found and wanted != wanted) or struct.pack("d", found) == struct.pack("d", wanted)
    return found == wanted


def expect(found: object, wanted: object, what: str) -> None:
    """Compare what an engine gave with what the model has.

    Raises:
        Broken: they differ.
    """
    if not same(found, wanted):
        raise PromiseBroken(f"{what}: found {short(found)} instead of {short(wanted)}")


def refused(call: Callable[[], object], what: str, kind: type[Exception] = StoreError) -> None:
    """See to it that a call is refused, with an error of this kind.

    Raises:
        Broken: it was not, or with another error.
    """
    try:
        result = call()
    except kind:
        return
    except Exception as error:
        raise PromiseBroken(f"{what}: raised {type(error).__name__} ({error}) instead of {kind.__name__}") from error
    if isinstance(result, Segment):
        result.close()
    raise PromiseBroken(f"{what}: was accepted, with {short(result)}, instead of being refused with {kind.__name__}")


def short(value: Any) -> str:
    """A value as a report shows it: its beginning and its end."""
    if isinstance(value, bytes | str) and len(value) > 200:
        return f"{value[:60]!r}...{value[-20:]!r} ({len(value)})"
    text = repr(value)
    return text if len(text) <= 600 else f"{text[:400]} ... {text[-150:]} ({type(value).__name__})"
