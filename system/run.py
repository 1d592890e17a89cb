"""`run`: start a program of actors, and end it in good order on SIGTERM and SIGINT."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from ..actors.errors import SpecError
from ..cluster.leadership import LeadershipLost
from .init_process import leave_init

T = TypeVar("T")


def run(
    main: Coroutine[Any, Any, T] | Callable[[], Coroutine[Any, Any, T]],
    *,
    again: bool = False,
    debug: bool | None = None,
) -> T:
    """Run a coroutine on uvloop, like `asyncio.run`; SIGTERM and SIGINT cancel it, so that systems stop in order.

    Args:
        main: the coroutine; or the function that makes it, called without arguments.
        again: call the function anew when it ends with LeadershipLost: the program stands by, and may lead once more.
        debug: as for `asyncio.run`.

    Where there is no uvloop it is run on asyncio's own loop. Where loops handle no signals, which is on Windows, SIGINT
    cancels it, too, and SIGTERM ends the process at once.

    As PID 1, the first process of a container, it goes on in a child process, and PID 1 passes signals on and reaps
    orphans; if other threads run already it does not, and gives a RuntimeWarning.

    Raises:
        SpecError: an event loop runs in this thread already, as in a notebook; or `again` was given a coroutine, which
            can run only once.
        KeyboardInterrupt: it was ended by SIGINT.
        SystemExit: it was ended by SIGTERM (with code 143, as a shell reports it).
    """
    if again and not callable(main):
        main.close()
        raise SpecError("hf.run", "again=True needs the function: hf.run(main, again=True), not main()")
    if asyncio._get_running_loop() is not None:
        if not callable(main):
            main.close()
        problem = "an event loop runs here already (a notebook, or another framework's): await the coroutine there"
        raise SpecError("hf.run", problem)
    leave_init()
    stopped_by: list[int] = []

    async def guarded() -> T:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None

        def stop(number: int) -> None:
            stopped_by.append(number)
            task.cancel()

        handled: list[signal.Signals] = []
        try:
            for number in (signal.SIGTERM, signal.SIGINT):
                loop.add_signal_handler(number, stop, number)
                handled.append(number)
        except NotImplementedError:
            pass  # On Windows `asyncio.Runner` cancels the coroutine on SIGINT.
        try:
            while True:
                try:
                    return await (main() if callable(main) else main)
                except LeadershipLost:
                    if not again:
                        raise
        finally:
            for number in handled:
                loop.remove_signal_handler(number)

    from ..actors.fast_loop import new_event_loop  # only now: importing holdfast does not import uvloop

    with asyncio.Runner(debug=debug, loop_factory=new_event_loop) as runner:
        try:
            return runner.run(guarded())
        except asyncio.CancelledError:
            if not stopped_by:
                raise
    if stopped_by[0] == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + stopped_by[0])
