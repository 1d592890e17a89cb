"""A mechanism of a user's own, in one file that the library has never seen: it counts, and signs each batch off."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from holdfast.ftm.bricks.brick_messages import Done, Work
from holdfast.ftm.bricks.bricks import After, Before
from holdfast.ftm.model.mechanism import Mechanism, Role

SEEN: list[str] = []


class Note(Before):
    async def before(self, work: Work) -> Work:
        assert isinstance(self.mechanism, Noting)
        SEEN.append(f"{self.mechanism.word} {self.role} {len(work.requests)} in")
        return work


class Sign(After):
    async def after(self, done: Done) -> Done:
        SEEN.append(f"{len(done.ends)} out")
        return done


@dataclasses.dataclass(frozen=True)
class Noting(Mechanism):
    """Notes what passes."""

    name: ClassVar[str] = "noting"
    layer: ClassVar[str] = "link"
    roles: ClassVar[dict[str, Role]] = {"single": Role(before=Note, after=Sign)}

    word: str = "seen"
