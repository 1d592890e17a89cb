"""The players of random races (`race_player.py`) in two generations, which differ in what their turns come to."""

from __future__ import annotations

from typing import Any, ClassVar

import holdfast as hf
from tests.effects.race_player import Play, Player, Step


class Over(hf.Message):
    """A program is over, says a player of a generation."""

    n: int
    by: str


class Who(hf.Message[dict[str, Any]]): ...


class First(Player):
    generation: ClassVar[str] = "first"

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.marks: list[int] = []

    @hf.on(Play)
    async def play(self, message: Play) -> list[str]:
        if message.n in dict(self.done):
            return []
        said = await super().play(message)
        assert isinstance(said, list)
        self.ledger.tell(Step(message.n, len(said), f"by {self.generation}"))
        await self.ctx.publish("/over", Over(message.n, self.generation))
        return [*said, self.generation]

    @hf.on(Who)
    def who(self, message: Who) -> dict[str, Any]:
        return {
            "by": self.generation,
            "marks": list(self.marks),
            "done": [n for n, _ in self.done],
        }


class Second(First):
    generation: ClassVar[str] = "second"


GENERATIONS = {kind.generation: kind for kind in (First, Second)}


def marked(number: int, state: dict[str, Any]) -> dict[str, Any]:
    """Another state: with one mark more."""
    return {**state, "marks": [*state["marks"], number]}
