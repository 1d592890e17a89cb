"""The queue of callbacks from which a schedule chooses: what may be called next."""

from __future__ import annotations

import asyncio
import threading

from holdfast.actors.kernel.node import Node
from holdfast.testing import GuardedSystem
from holdfast.testing.schedules.choices import Walk
from holdfast.testing.schedules.control import ControlledLoop
from holdfast.testing.schedules.due import DueQueue, Option
from holdfast.testing.simulation import run_schedule


class Last:
    """Takes the last of those that may be called."""

    def choose_callback(self, due: DueQueue) -> Option:
        return due.next_options()[-1]

    def called(self, option: Option) -> None:
        """It does not matter."""

    def meet(self, node: Node) -> None:
        """There is none."""


def test_callbacks_keep_their_order_and_come_before_steps_behind_them() -> None:
    called: list[str] = []

    async def step(name: str) -> None:
        called.append(name)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, ControlledLoop)
        before = loop.create_task(step("a task before"))
        loop.call_soon(called.append, "one")
        loop.call_soon(called.append, "cancelled").cancel()
        loop.call_soon(called.append, "two")
        after = loop.create_task(step("a task behind"))
        loop.due.chooser = Last()
        await asyncio.gather(before, after)
        loop.due.chooser = None

    with asyncio.Runner(loop_factory=ControlledLoop) as runner:
        runner.run(main())
    assert called == ["one", "two", "a task behind", "a task before"]


def test_a_task_goes_on_before_what_is_called_of_it_later() -> None:
    async def ends() -> str:
        return "its result"

    async def main() -> str:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, ControlledLoop)
        task = loop.create_task(ends())
        loop.call_soon(task.cancel)
        loop.due.chooser = Last()
        result = await task
        loop.due.chooser = None
        return result

    with asyncio.Runner(loop_factory=ControlledLoop) as runner:
        assert runner.run(main()) == "its result"


class Counting(Last):
    """Notes how many there are to choose from, but for the steps of tasks."""

    def __init__(self) -> None:
        self.counts: list[int] = []

    def choose_callback(self, due: DueQueue) -> Option:
        options = [option for option in due.next_options() if not isinstance(option[0], asyncio.Task)]
        self.counts.append(len(options))
        return options[-1] if options else super().choose_callback(due)


def test_what_was_cancelled_while_it_was_due_is_no_option_any_more() -> None:
    counting = Counting()

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, ControlledLoop)
        called: list[str] = []
        over = loop.create_future()
        first = loop.call_at(1.0, called.append, "first")

        def second() -> None:
            called.append("second")
            over.set_result(None)

        def third() -> None:
            called.append("third")
            first.cancel()

        loop.call_at(1.0, second)
        loop.call_at(1.0, third)
        loop.due.chooser = counting
        await over
        loop.due.chooser = None
        assert called == ["third", "second"]

    with asyncio.Runner(loop_factory=ControlledLoop) as runner:
        runner.run(main())
    assert counting.counts[:2] == [3, 1]


def test_when_a_thread_wakes_the_loop_is_no_choice_of_the_schedule() -> None:
    def run(seconds: float) -> list[int]:
        steps: list[int] = []

        async def works(system: GuardedSystem) -> None:
            work = asyncio.get_running_loop().run_in_executor(None, threading.Event().wait, seconds)

            async def client(number: int) -> None:
                for _ in range(400):
                    steps.append(number)
                    await asyncio.sleep(0)

            await asyncio.gather(*map(client, range(4)))
            await work

        run_schedule(works, Walk(1), {"system"}, {})
        return steps

    assert run(0.0) == run(0.002) == run(0.004)
