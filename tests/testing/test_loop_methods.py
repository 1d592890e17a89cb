"""What is made in a loop is told to each who notes, however the methods of loops are exchanged meanwhile."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from holdfast.testing.guard.loop_leaks import LoopLeaks
from holdfast.testing.guard.loop_methods import LoopMethods


class OwnLoop(asyncio.SelectorEventLoop):
    """Whose class no other test knows."""


class OwnFutures(OwnLoop):
    """Has one method of its own."""

    def create_future(self) -> asyncio.Future[Any]:
        return super().create_future()


def run(main: Any, kind: Any = OwnLoop) -> None:
    with asyncio.Runner(loop_factory=kind) as runner:
        runner.run(main())


def nothing() -> None:
    """It is never called."""


@pytest.mark.parametrize("kind", [OwnLoop, OwnFutures])
def test_two_who_note_in_one_loop_hear_of_everything_until_each_stops(kind: Any) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        first = LoopLeaks()
        second = LoopLeaks()
        lost = loop.create_future()
        lost.set_exception(ValueError("lost"))
        timer = loop.call_later(60.0, nothing)
        assert [len(one.timers()) for one in (first, second)] == [1, 1]
        assert len(first.unseen()) == 1
        first.close()
        other = loop.call_later(60.0, nothing)
        assert len(second.timers()) == 2
        lost.exception()
        late = loop.create_future()
        late.set_exception(ValueError("late"))
        assert [len(one.unseen()) for one in (first, second)] == [0, 1]
        second.close()
        timer.cancel()
        other.cancel()

    run(main, kind)


def test_a_loop_that_nobody_notes_in_is_let_alone_and_its_class_is_exchanged_once() -> None:
    async def noted() -> None:
        LoopLeaks().close()

    async def alone() -> None:
        leaks = LoopMethods.of(OwnLoop)
        before = asyncio.get_running_loop().create_future()
        before.set_exception(ValueError("nobody's"))
        assert before.exception() is not None
        assert LoopMethods.of(OwnLoop) is leaks

    run(noted)
    methods = vars(OwnLoop)["create_task"]
    run(alone)
    run(noted)
    assert vars(OwnLoop)["create_task"] is methods


def test_what_a_test_exchanges_in_the_class_of_all_loops_is_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exchanged methods of a class must not keep what its bases had before."""
    made: list[str] = []

    async def main() -> None:
        leaks = LoopLeaks()
        await asyncio.create_task(asyncio.sleep(0))
        leaks.close()

    run(main)
    create = asyncio.BaseEventLoop.create_task

    def noting(loop: Any, coro: Any, **options: Any) -> Any:
        made.append("task")
        return create(loop, coro, **options)

    monkeypatch.setattr(asyncio.BaseEventLoop, "create_task", noting)
    run(main)
    assert made.count("task") >= 2  # The runner's own is one.
