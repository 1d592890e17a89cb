"""A mechanism in one file: what is asked of an actor stands in a file before it is computed, and what came of it after.

`change.protect(ref, "audit_trail.py")`, alone or outside of others: `(AuditTrail("bank.log"), hf.ftm.PBR())`.
"""

from __future__ import annotations

import dataclasses
import os
from typing import ClassVar

from holdfast.ftm.bricks.brick_messages import Done, Work
from holdfast.ftm.bricks.bricks import After, Before, Brick
from holdfast.ftm.model.mechanism import Mechanism, Role


def write(brick: Brick, lines: list[str]) -> None:
    """Append lines to the file of the mechanism whose brick this is; they are on disk when this returns."""
    assert isinstance(brick.mechanism, AuditTrail)
    with open(brick.mechanism.file, "a", encoding="utf-8") as file:
        file.writelines(f"{line}\n" for line in lines)
        file.flush()
        os.fsync(file.fileno())


class NoteRequests(Before):
    """Only the replica that leads has this one."""

    async def before(self, work: Work) -> Work:
        # After a failover a batch comes again: its numbers are the same.
        write(self, [f"{one.number} {one.feed.name.rpartition(':')[2]} from {one.client}" for one in work.requests])
        return work


class NoteOutcomes(After):
    """A reply leaves when this has returned what it was given."""

    async def after(self, done: Done) -> Done:
        write(self, [f"{end.id} is {end.status}" for end in done.ends])
        return done


@dataclasses.dataclass(frozen=True)
class AuditTrail(Mechanism):
    """Masks nothing, needs nothing.

    Args:
        file: to which lines are appended; by default beside the program.
    """

    name: ClassVar[str] = "audit_trail"
    layer: ClassVar[str] = "assertion"  # it stands outside of what runs a request more than once
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=NoteRequests, after=NoteOutcomes), "other": Role()}

    file: str = "audit.log"
