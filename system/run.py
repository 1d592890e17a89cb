"""`run`: start a program of actors, and end it in good order on SIGTERM and SIGINT."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import os
import signal
import sys
import threading
from collections.abc import Callable, Coroutine
from time import monotonic
from typing import Any, TypeVar

from ..actors.errors import SpecError
from ..actors.kernel.lifecycle import let_go
from ..actors.process.fork.launch import check_is_program
from ..actors.seconds import check_seconds
from ..cluster.leadership import LeadershipLost
from .init_process import leave_init

T = TypeVar("T")
LOOKS = 4
"""How often it is looked whether the loop goes on, within the time that it may stand still."""
ENDS_WITHIN = 10.0
"""Seconds for what runs beside the program to end when it is cancelled; then the program ends without it."""


class StandstillWatch:
    """Ends this process when its event loop stands still after a signal to end: no timer of the loop can then.

    Nothing runs before the signal: its handler, which Python calls between any two steps of whatever blocks the loop,
    starts the thread that looks.

    Args:
        loop: the loop that has to go on.
        seconds: how long it may stand still.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, seconds: float) -> None:
        self._loop, self._seconds = loop, seconds
        self._goes_on, self._is_over = threading.Event(), threading.Event()
        self._is_watched = False

    def begin(self, number: int, _: object) -> None:
        """Begin to watch the loop: a signal has come."""
        if not self._is_watched:
            self._is_watched = True
            threading.Thread(target=self._look, args=(number,), name="holdfast end", daemon=True).start()

    def end(self) -> None:
        """All has ended in good order."""
        self._is_over.set()

    def _look(self, number: int) -> None:
        missed, look = 0, self._seconds / LOOKS
        while missed < LOOKS:
            self._goes_on.clear()
            begin = monotonic()
            with contextlib.suppress(RuntimeError):  # The loop is closed: all is over.
                self._loop.call_soon_threadsafe(self._goes_on.set)
            if self._is_over.wait(look):
                return
            if self._goes_on.is_set():
                missed = 0
            elif monotonic() - begin < 2 * look:  # Else we were late ourselves: the whole process stood still.
                missed += 1
        stood = (
            f"holdfast: {signal.Signals(number).name} came, and the event loop has stood still for {self._seconds:g} s"
        )
        os.write(2, f"{stood}: the process ends without an orderly stop; its threads are here:\n".encode())
        faulthandler.dump_traceback(2)
        os._exit(128 + number)


async def _end_tasks() -> None:
    """Cancel all that runs beside the program, and let go of what does not end of that."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    if others:
        for task in (await asyncio.wait(others, timeout=ENDS_WITHIN))[1]:
            print(f"{task.get_name()} was cancelled, and does not end: the program ends without it", file=sys.stderr)
            task.print_stack(file=sys.stderr)
            let_go(task)


def run(
    main: Coroutine[Any, Any, T] | Callable[[], Coroutine[Any, Any, T]],
    *,
    again: bool = False,
    debug: bool | None = None,
    standstill: float = 20.0,
) -> T:
    """Run a coroutine on uvloop, like `asyncio.run`; SIGTERM and SIGINT cancel it, so that systems stop in order.

    Args:
        main: the coroutine; or the function that makes it, called without arguments.
        again: call the function anew when it ends with LeadershipLost: the program stands by, and may lead once more.
        debug: as for `asyncio.run`.
        standstill: seconds, > 0 and finite, that the event loop may stand still after such a signal.

    A turn in this process that never yields keeps the loop from taking the signal, and from ending anything. If the
    loop stands still for `standstill` seconds from the signal on, all stacks are written to stderr, and the process
    ends at once, as by SIGKILL but with the code of the signal. Code in C that never returns is the exception: Python
    does not learn of the signal then.

    Tasks that are left when the program has returned are cancelled. Whichever has not ended ten seconds later is told
    on stderr with its stack, and the program ends without it.

    Where there is no uvloop it is run on asyncio's own loop. Where loops handle no signals, which is on Windows, SIGINT
    cancels it, too, and SIGTERM ends the process at once.

    As PID 1, the first process of a container, it goes on in a child process, and PID 1 passes signals on and reaps
    orphans; if other threads run already it does not, and gives a RuntimeWarning.

    Raises:
        SpecError: an event loop runs in this thread already, as in a notebook, or it is not the main thread; `again`
            was given a coroutine, which can run only once; `standstill` is no such number; or the program has no
            `if __name__ == "__main__":` and is being imported for the classes of its actors.
        KeyboardInterrupt: it was ended by SIGINT.
        SystemExit: it was ended by SIGTERM (with code 143, as a shell reports it).
    """
    try:
        check_is_program("hf.run")
        check_seconds("hf.run", "standstill", standstill)
    except SpecError:
        if not callable(main):
            main.close()
        raise
    if again and not callable(main):
        main.close()
        raise SpecError("hf.run", "again=True needs the function: hf.run(main, again=True), not main()")
    problem = ""
    if asyncio._get_running_loop() is not None:
        problem = "an event loop runs here already (a notebook, or another framework's): await the coroutine there"
    elif threading.current_thread() is not threading.main_thread():
        problem = "only the main thread hears of signals: in this one use asyncio.run"
    if problem:
        if not callable(main):
            main.close()
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
        watch = StandstillWatch(loop, standstill)
        try:
            for number in (signal.SIGTERM, signal.SIGINT):
                loop.add_signal_handler(number, stop, number)
                signal.signal(
                    number, watch.begin
                )  # In place of a handler that does nothing: the loop is told all the same.
                signal.siginterrupt(number, False)  # As the loop has set it.
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
            watch.end()
            for number in handled:
                loop.remove_signal_handler(number)
            await _end_tasks()

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
