"""Events of transactions; `address` is the root's."""

from __future__ import annotations

from ...actors.events import Event


class TransactionBegan(Event, frozen=True, eq=False):
    """All checks have passed: the steps are carried out from here on."""

    steps: tuple[str, ...]


class TransactionCommitted(Event, frozen=True, eq=False):
    """The tree has changed; `problems` are what could not be tidied up behind it."""

    steps: tuple[str, ...]
    problems: tuple[str, ...]


class TransactionRolledBack(Event, frozen=True, eq=False):
    """A step failed; the others were undone, but for those `kept`."""

    steps: tuple[str, ...]
    step: str
    reason: str
    kept: tuple[str, ...]


class ScriptLoaded(Event, frozen=True, eq=False):
    """A script was run or sent here, or a module was loaded for one; its sha256 in hex digits says what it was."""

    path: str
    sha256: str
