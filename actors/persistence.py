"""The interface by which supervisors speak of state that outlives lives, without knowing any recovery method."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from typing import Protocol

from .errors import DIVERGED, RAISED_AGAIN, ControlFailed, ReplayDiverged, type_name
from .exit_reasons import Crash, ExitReason

UNFIT = "what is recorded of it does not fit the code"
"""How the reason of a failed start begins if only other code can help, and no older state."""


def is_in_vain(why: str) -> bool:
    """Whether a start that has failed for this reason fails again: the code does not fit what it has recorded.

    A handler that raises when it handles something again may have met trouble that passes.
    """
    return UNFIT in why or (DIVERGED in why and RAISED_AGAIN not in why)


def ends_in_vain(reason: ExitReason) -> bool:
    """Whether a life that has ended for this reason is followed by one that ends for it again: it went another way."""
    return isinstance(reason, Crash) and reason.type_name == type_name(ReplayDiverged) and is_in_vain(reason.text)


class Keeper(Protocol):
    """Keeps state and messages of addresses, and small facts; there is one for each node."""

    def has_recorded(self, path: str) -> bool:
        """Whether anything is recorded at this address or below it, or noted of a child of a supervisor there."""
        ...

    def erasing(self, path: str) -> asyncio.Future[None] | None:
        """The erasure that has to be over before a life may begin at this address, if there is one.

        Raises:
            HoldfastError: what the store had refused to erase before, it refuses again.
        """
        ...

    def erase(self, path: str, *, below: bool) -> asyncio.Future[None] | None:
        """Forget what was recorded at an address where nobody lives; with `below`, also at all addresses below it.

        Returns:
            None: it is done. A future: it goes on, a few addresses at a time, or is asked of the root.

        Raises:
            HoldfastError: the store refused. What is left is erased when it is opened again.
        """
        ...

    def roll_back(self, path: str, why: str) -> asyncio.Future[None] | None:
        """Have the next life at an address, where nobody lives now, begin with the snapshot before the newest.

        Returns:
            None: it is done. A future: it is asked of the root, and ends with what that answers.

        Raises:
            ControlFailed: nothing is recorded there, somebody lives there, or there is no older snapshot.
            HoldfastError: the store refused.
        """
        ...

    def blame(self, path: str) -> None:
        """The supervisor above this address ends because of the actor there."""
        ...

    def returned(self, path: str) -> None:
        """The supervisor at `path` is started again by its own.

        Whoever below was to blame for its end is brought back as its method says (`on_escalate`).
        """
        ...

    def dismissed(self, path: str, *, below: bool, for_good: bool) -> None:
        """The child at `path` is forgotten by its supervisor.

        `below`: others may live below it, and what comes for them waits for no next life. `for_good`: it does not come
        back with its supervisor, either; whoever is started there is another one.
        """
        ...

    def began(self, path: str, listed: Collection[str]) -> None:
        """The supervisor at `path` begins with these children: nobody else is brought back below it."""
        ...

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small fact; None forgets it. Raises HoldfastError if the store refused."""
        ...

    def notes(self, prefix: str) -> dict[str, bytes]:
        """The facts whose keys begin so, oldest first."""
        ...

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or None."""
        ...


class NothingKept:
    """The keeper of a node without recovery: only facts are kept, until the node ends."""

    def __init__(self) -> None:
        self._notes: dict[str, bytes] = {}

    def has_recorded(self, path: str) -> bool:
        """Whether a child is noted below this address: nothing is ever recorded."""
        return bool(self.notes(child_key(path, "")))

    def erasing(self, path: str) -> None:
        """Return None: what there is to forget is forgotten at once."""

    def erase(self, path: str, *, below: bool) -> None:
        """There is nothing but facts."""
        if below:
            for key in self.notes(child_key(path, "")):
                del self._notes[key]

    def roll_back(self, path: str, why: str) -> None:
        """There is nothing to go back to."""
        raise ControlFailed(path, "roll_back", "nothing was recorded of it in this run")

    def blame(self, path: str) -> None:
        """Do nothing: nobody is brought back from records."""

    def returned(self, path: str) -> None:
        """Do nothing: nobody is brought back from records."""

    def dismissed(self, path: str, *, below: bool, for_good: bool) -> None:
        """Do nothing: nothing waits for a next life."""

    def began(self, path: str, listed: Collection[str]) -> None:
        """Do nothing: nobody is tied to who has lived before this node."""

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a fact until the node ends."""
        self._notes.pop(key, None)
        if value is not None:
            self._notes[key] = value

    def notes(self, prefix: str) -> dict[str, bytes]:
        """The facts whose keys begin so, oldest first."""
        return {key: value for key, value in self._notes.items() if key.startswith(prefix)}

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or None."""
        return self._notes.get(key)


CHILDREN = "child "
"""How the keys of facts begin that a supervisor has a child; the child's address follows."""


def child_key(supervisor: str, name: str) -> str:
    """The key of the fact that a supervisor has a child of this name."""
    return f"{CHILDREN}{supervisor}/{name}"


def plan_key(supervisor: str) -> str:
    """The key of the fact what a supervisor has been given while it worked: that of a child without a name."""
    return child_key(supervisor, "")


ENTRIES = "entries "
"""How the keys of facts begin that say what a recorded actor holds in a registry; both addresses follow."""


def entries_key(holder: str, registry: str) -> str:
    """The key of the fact that says what a recorded actor holds in a registry. (No address has a line end.)"""
    return f"{ENTRIES}{holder}\n{registry}"
