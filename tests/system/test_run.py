"""`hf.run`: the value, the exception, and an end in good order on SIGTERM and SIGINT, in real processes."""

import asyncio
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import uvloop

import holdfast as hf

SECONDS = 30.0  # far more than any of it takes

PROGRAM = """
import asyncio
import holdfast as hf

class Kid(hf.Actor):
    async def on_stop(self, reason):
        await asyncio.sleep(0.01)
        print(self.ctx.path, reason, flush=True)

async def main():
    async with hf.ActorSystem("app", log=False) as system:
        children = [hf.child(name, hf.start(Kid)) for name in "ab"]
        await system.start(hf.supervisor("top", children=children))
        print("up", flush=True)
        await asyncio.Event().wait()

if __name__ == "__main__":
    try:
        hf.run(main())
    finally:
        print("over", flush=True)
"""


async def value() -> int:
    async with hf.ActorSystem("app", log=False):
        return 42


async def loop_kind() -> type[asyncio.AbstractEventLoop]:
    return type(asyncio.get_running_loop())


async def fail() -> None:
    async with hf.ActorSystem("app", log=False):
        raise OSError("the program's own")


async def cancel_itself() -> None:
    task = asyncio.current_task()
    assert task is not None
    task.cancel()
    await asyncio.sleep(0)


def test_it_returns_what_the_program_returns() -> None:
    assert hf.run(value()) == 42


async def test_where_an_event_loop_runs_already_it_says_what_to_do() -> None:
    with pytest.raises(hf.SpecError, match="await the coroutine there"):
        hf.run(value())


def test_in_another_thread_it_says_what_to_do() -> None:
    said = r"only the main thread hears of signals: in this one use asyncio\.run"
    with ThreadPoolExecutor(1) as threads, pytest.raises(hf.SpecError, match=said):
        threads.submit(hf.run, value()).result()


def test_it_runs_on_uvloop() -> None:
    assert issubclass(hf.run(loop_kind()), uvloop.Loop)


def test_an_exception_of_the_program_comes_out() -> None:
    with pytest.raises(OSError, match="the program's own"):
        hf.run(fail())


def test_a_program_that_cancels_itself_was_not_stopped_by_a_signal() -> None:
    with pytest.raises(asyncio.CancelledError):
        hf.run(cancel_itself())


def test_signal_handlers_are_as_before_afterwards() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    hf.run(value())
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)] == before


@pytest.mark.parametrize(
    ("number", "code", "traceback"),
    [(signal.SIGTERM, 143, ""), (signal.SIGINT, -signal.SIGINT, "KeyboardInterrupt")],
    ids=["SIGTERM", "SIGINT"],
)
def test_a_signal_stops_all_actors_in_good_order(
    number: signal.Signals, code: int, traceback: str, tmp_path: Path
) -> None:
    script = tmp_path / "program.py"
    script.write_text(PROGRAM, "utf-8")
    with subprocess.Popen(
        [sys.executable, "-W", "error", str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "up\n"
            program.send_signal(number)
            output, errors = program.communicate(timeout=SECONDS)
        finally:
            program.kill()
    assert output.splitlines() == ["/app/top/b shutdown", "/app/top/a shutdown", "over"]
    assert program.returncode == code
    assert errors.rstrip().rpartition("\n")[2] == traceback


STUBBORN = """
import asyncio, sys
import holdfast as hf
from holdfast.system import run

async def swallows():
    while True:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            pass

class Kid(hf.Actor):
    async def on_stop(self, reason):
        await swallows()

async def main(beside, waits):
    run.ENDS_WITHIN = 0.1
    task = asyncio.create_task(swallows(), name="beside") if beside else None
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("kid", hf.start(Kid), shutdown=0.1))
        print("up", flush=True)
        if waits:
            await asyncio.Event().wait()
    print("left", flush=True)

if __name__ == "__main__":
    how, beside = sys.argv[1:]
    (asyncio.run if how == "asyncio" else hf.run)(main(beside == "beside", how == "signal"))
"""


@pytest.mark.parametrize(
    ("how", "beside"), [("signal", ""), ("signal", "beside"), ("return", ""), ("return", "beside"), ("asyncio", "")]
)
@pytest.mark.some(3)
def test_what_swallows_its_cancellation_keeps_no_program_alive(how: str, beside: str, tmp_path: Path) -> None:
    script = tmp_path / "program.py"
    script.write_text(STUBBORN, "utf-8")
    with subprocess.Popen(
        [sys.executable, str(script), how, beside], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "up\n"
            if how == "signal":
                program.send_signal(signal.SIGTERM)
            _, errors = program.communicate(timeout=SECONDS)
        finally:
            program.kill()
    assert program.returncode == (143 if how == "signal" else 0), errors
    assert ("beside was cancelled, and does not end" in errors) == bool(beside)
