"""One step of a transaction: what every operation can do, whoever adds it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import SpecError

if TYPE_CHECKING:
    from ..system import ActorSystem
    from .draft import Draft, Place


@dataclasses.dataclass(frozen=True, slots=True)
class Step:
    """One step, as `change.steps` and a dry run show it."""

    number: int
    """From 1, in the order in which the steps are carried out."""
    verb: str
    """"add", "remove", "move", ..."""
    target: str
    """The address that it is about, as it is at that point."""
    text: str
    """The step in words."""


class Operation:
    """Base of all operations. A transaction calls, in this order:

    `check` of all, each against the tree as it will be at that point, before anything is done; `do` of all; `verify`
    of all; then there is no way back: `seal` of all, `finish` of all. If a `do` or `verify` fails, is cancelled or
    takes too long, `undo` of all that have begun, last one first, instead.
    """

    verb: ClassVar[str] = ""

    def __init__(self, target: str) -> None:
        self.target = target
        self.waiting = ""
        """What `do` waits for, told when the time is up."""
        self.between_turns_of: tuple[Place, ...] = ()
        """Whose turns have to be over for this; known after the check."""

    @property
    def text(self) -> str:
        """The step in words."""
        return f"{self.verb} {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        """See whether it can be done at this point, and change the draft as `do` will change the tree.

        Raises:
            HoldfastError: why not.
        """
        raise NotImplementedError

    async def do(self, system: ActorSystem) -> None:
        """Do it, noting what was done as it goes: it may be cancelled at any wait.

        Raises:
            HoldfastError: it cannot be done.
        """
        raise NotImplementedError

    async def undo(self, system: ActorSystem) -> None:
        """Put back what `do` has changed so far; nothing if that is nothing."""
        raise NotImplementedError

    def verify(self, system: ActorSystem) -> None:
        """All has been done: see whether it still holds. Raises HoldfastError if not."""

    def seal(self, system: ActorSystem) -> None:
        """The transaction is accepted: make the change one that outlives restarts."""

    async def finish(self, system: ActorSystem) -> None:
        """What cannot be undone, and so comes last; what fails here is told, and changes nothing for the others."""


def wrong(where: str, problem: str) -> SpecError:
    """The error of a check."""
    return SpecError(where, problem)
