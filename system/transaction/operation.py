"""The base of operations, the steps of a transaction."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import SpecError

if TYPE_CHECKING:
    from ...actors.kernel.ref import Target
    from ..system import ActorSystem
    from .draft import Draft, DraftPlace


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
    note: str = ""
    """What follows from it besides, in a sentence: to whom an actor may give orders in the process it comes to."""


class StagedWork:
    """What a transaction has done step by step: `prepare`, `ready`, `commit`, `finish`; or `prepare`, `release`."""

    async def prepare(self, system: ActorSystem) -> None:
        """Make what the commit needs beside what runs; called again when what was made is not good any more.

        It may be cancelled at any wait, and notes what it has made as it goes, so that `release` finds it.

        Raises:
            HoldfastError: it cannot be done.
        """

    @property
    def waits_for(self) -> str:
        """What its preparation waits for, in words, told when the time is up; "" if nothing is known."""
        return ""

    def ready(self, system: ActorSystem) -> str:
        """What is in the way of a commit at this very instant, in words; "" if nothing is.

        Raises:
            HoldfastError: it cannot be done any more.
        """
        return ""

    def commit(self, system: ActorSystem) -> None:
        """Put it in force, at once. Called in the same step of the loop as `ready`, so it has no reason to fail."""

    async def finish(self, system: ActorSystem) -> None:
        """Have what runs follow what is in force. What fails here is told, and changes nothing for the others."""

    async def let_go(self, system: ActorSystem) -> bool:
        """Have whoever was brought to rest go on meanwhile; if somebody does, `prepare` is called again."""
        return False

    async def release(self, system: ActorSystem) -> None:
        """Let go of what was prepared; nothing if that is nothing."""


class Operation(StagedWork):
    """Base of all operations. A transaction calls, in this order:

    1. `check` of all, each against the draft: the tree as it will be at that point.
    2. `prepare` of all: what the commit needs is made beside what runs. Nothing that exists changes.
    3. `ready` of all, until nobody names anything that is in the way.
    4. `commit` of all, in the same step of the event loop as the last look: from here on the change is in force.
    5. `finish` of all: what runs follows what is in force.

    If something fails, is cancelled or takes too long before the commit: `release` of all whose `prepare` was begun,
    last one first, instead of the rest. While the actor of one that is prepared is between two lives, the others have
    `let_go`, and are prepared again behind it.
    """

    verb: ClassVar[str] = ""

    def __init__(self, at: Target, child: str = "") -> None:
        self._at = at
        self.target = f"{text_of(at)}/{child}" if child else text_of(at)
        self.between_turns_of: tuple[DraftPlace, ...] = ()
        """Whose turns have to be over for this; known after the check."""

    note: str = ""
    """What follows from it besides, in a sentence; known after the checks."""
    _found: DraftPlace | None = None

    @property
    def _place(self) -> DraftPlace:
        """The place that it is about; known after the check."""
        assert self._found is not None
        return self._found

    @property
    def text(self) -> str:
        """The step in words."""
        return f"{self.verb} {self.target}"

    @property
    def work(self) -> StagedWork:
        """The work that does it, which may do others of the same actor too."""
        return self

    def is_away(self, system: ActorSystem) -> bool:
        """Say whether its actor is between two lives, so that the next one is waited for."""
        place = self._found
        cell = None if place is None or place.is_planned else place.now(system._node)
        return cell is not None and not cell.host.is_up(cell)

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        """See whether it can be done at this point, and change the draft as the commit will change the tree.

        Raises:
            HoldfastError: why not.
        """
        raise NotImplementedError


def described_steps(steps: Iterable[Step]) -> list[str]:
    """Steps as lines of text, each with what follows from it besides."""
    lines: list[str] = []
    for step in steps:
        lines.append(f"{step.number}. {step.text}")
        lines += [f"   {step.note}"] if step.note else []
    return lines or ["nothing to do"]


def text_of(target: Target) -> str:
    """A target as text."""
    return target if isinstance(target, str) else target.path


PROTECTED = (
    "it is protected by a mechanism: `protect` it by None, and again after that, each in a transaction of its own; "
    "meanwhile it is unprotected"
)
"""Why what would change one replica alone is refused."""


def wrong(where: str, problem: str) -> SpecError:
    """The error of a check."""
    return SpecError(where, problem)
