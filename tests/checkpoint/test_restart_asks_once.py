"""An ask has one outcome, also if its receiver goes back to a moment at which it had not answered yet (T20, R78)."""

from __future__ import annotations

from typing import Any

import holdfast as hf
from tests.checkpoint.rejoin_player import FOREVER, Answers, Asked, Go, Open, Oracle, Question


class Cautious(hf.Actor):
    """Notes an ask that fails as -1."""

    def __init__(self) -> None:
        self.answers: list[int] = []

    @hf.on(Go)
    async def go(self, message: Go) -> int:
        try:
            self.answers.append(await message.to.ask(message.question, timeout=60.0))
        except hf.HoldfastError:
            self.answers.append(-1)
        return self.answers[-1]

    @hf.on(Answers, readonly=True)
    def read(self, message: Answers) -> list[int]:
        return self.answers


async def test_who_was_refused_is_not_answered_later() -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        recovery = hf.hybrid(interval=FOREVER)
        asker = await system.start(hf.child("asker", hf.start(Cautious), recovery=recovery))
        oracle: hf.ActorRef[Any] = await system.start(hf.child("oracle", hf.start(Oracle), recovery=recovery))
        asked = asker.ask(Go(Question(1, "later", oracle), oracle), timeout=60.0)
        while not await oracle.ask(Asked()):
            pass
        await system.checkpoint_group([oracle], name="before")
        await system.restore_group("before")
        assert await asked == -1
        oracle = system.ref("/app/oracle", Oracle)
        oracle.tell(Open())  # It has still the handle that it had then.
        await oracle.ask(Asked())
        await system._node.settled()
        asker.kill()
        assert await asker.ask(Answers()) == [-1]
