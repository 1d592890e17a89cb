"""What becomes of a recorded actor's links when it ends in good order, and goes on with its state."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf


class LinkWith(hf.Message[None]):
    path: str


class Fail(hf.Message[None]):
    pass


class EndBehind(hf.Message[None]):
    """End in good order, as soon as the actor at `path` has ended: its EXIT waits behind this turn."""

    path: str


class Count(hf.Message[int]):
    pass


class Counts(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    def get_state(self) -> int:
        return self.count

    def set_state(self, state: int) -> None:
        self.count = state

    @hf.on(Count)
    def up(self, message: Count) -> int:
        self.count += 1
        return self.count

    @hf.on(LinkWith)
    def link(self, message: LinkWith) -> None:
        self.ctx.link(self.ctx.find(message.path, Counts))

    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        raise ValueError("boom")

    @hf.on(EndBehind)
    async def end(self, message: EndBehind) -> None:
        other: hf.ActorRef[Any] = self.ctx.find(message.path, Counts)
        try:
            await other.ask(Fail())
        except hf.RemoteCrash:
            pass  # What it is for: the other one has crashed.
        self.ctx.stop()


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_the_next_life_hears_of_no_exit_that_was_sent_to_one_that_ended_in_good_order(
    system: hf.ActorSystem, isolation: Any
) -> None:
    recorded = hf.child("recorded", hf.start(Counts), isolation=isolation, recovery=hf.hybrid(interval=1000.0))
    one, other = await system.start(recorded), await system.start(hf.child("other", hf.start(Counts)))
    assert await one.ask(Count()) == 1
    await one.ask(LinkWith(other.path))
    await system.checkpoint(one)  # This snapshot has the link, and the next life begins with it.
    with system.events() as events:
        one.tell(EndBehind(other.path))
        while (await events.until(hf.events.ChildRestarted)).address != one.path:
            pass
        assert await one.ask(Count()) == 2  # It has its state, and is not ended by the EXIT.
        with pytest.raises(hf.RemoteCrash):
            await other.ask(Fail())
        assert await other.ask(Count()) == 1
        assert await one.ask(Count()) == 3  # Nor is it linked any more, whatever the snapshot says.
        ends = [event for event in events.take() if isinstance(event, hf.events.ChildTerminated)]
        assert [event.address for event in ends] == [other.path]
