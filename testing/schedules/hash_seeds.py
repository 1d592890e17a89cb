"""Hash seeds: the order of a set of strings is that of its process, and part of a schedule.

Python draws a seed for the hashes of strings in each process, unless PYTHONHASHSEED says one. Which it has drawn cannot
be said to another process.
"""

from __future__ import annotations

import os
import sys
from typing import Final

from ...actors.errors import HoldfastError

VARIABLE: Final = "PYTHONHASHSEED"
HASH: Final = "hash"
"""What it is called in the text of a schedule."""
RANDOM: Final = "random"
"""In place of the number, where Python has drawn one."""


class PassesElsewhere(UserWarning):
    """A schedule that has failed in another process passes in this one, where sets of strings have another order."""


class OtherHashSeed(
    HoldfastError,
    AssertionError,
    text="the schedule {text!r} was found under PYTHONHASHSEED={found}, and sets of strings have another order in this "
    "process. Run PYTHONHASHSEED={found} {command}; or take hash={found} out of the schedule, if no such order matters",
):
    """A schedule was to be repeated in a process in which sets of strings have another order."""

    text: str
    found: str
    command: str


def _of_this_process() -> str:
    said = "" if sys.flags.ignore_environment else os.environ.get(VARIABLE, "")
    return str(int(said)) if said.isdecimal() else RANDOM


_HERE: Final = _of_this_process()  # at import: what a test sets later is not that of this process


def here() -> str:
    """The hash seed of this process: a number, or "random"."""
    return _HERE


def with_hash_seed(text: str) -> str:
    """A schedule with the hash seed under which it was found.

    >>> with_hash_seed("seed=7 turn=3:1").startswith("seed=7 turn=3:1 hash=")
    True
    """
    return f"{text} {HASH}={here()}"


def parted(text: str) -> tuple[str, str | None]:
    """A schedule, and the hash seed under which it was found, if that is known.

    >>> parted("seed=7 turn=3:1 hash=1")
    ('seed=7 turn=3:1', '1')
    >>> parted("seed=7")
    ('seed=7', None)
    """
    words = text.split()
    seeds = [word.partition("=")[2] for word in words if word.startswith(f"{HASH}=")]
    return " ".join(word for word in words if not word.startswith(f"{HASH}=")), seeds[-1] if seeds else None


def require_hash_seed(text: str, command: str) -> None:
    """Make sure that a schedule which was found under a chosen hash seed is repeated under that.

    Args:
        command: what repeats it.

    Raises:
        OtherHashSeed: this process has another one.
    """
    found = parted(text)[1]
    if found not in (None, RANDOM, here()):
        raise OtherHashSeed(text, found, command)


def passes_elsewhere(text: str, command: str = "") -> str:
    """What is told of a schedule that passes in this process and has failed in another."""
    found = parted(text)[1]
    told = f"the schedule {text!r}, which has failed in another process, passes in this one"
    if found == RANDOM:
        return (
            f"{told}, and is kept no more. If nothing was mended, an order of strings in a set decides: "
            f"search under {VARIABLE}=0, which repeats it"
        )
    return f"{told}, where sets of strings have another order, and stays kept: run {VARIABLE}={found} {command}"


def hash_seed_in_words() -> list[str]:
    """A line for the note of a failure, if a hash seed was chosen."""
    return [] if here() == RANDOM else [f"under {VARIABLE}={here()}"]


def before_command() -> str:
    """What stands before the command that repeats a failure."""
    return "" if here() == RANDOM else f"{VARIABLE}={here()} "
