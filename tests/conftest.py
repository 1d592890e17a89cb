"""Every async test runs under both event loops, and no test leaves anything behind.

A test that must not run under one of the loops says so with `@pytest.mark.asyncio(loop_factories=["uvloop"])`; one
that is about time asks for `loop_factories=["virtual"]`, where nothing waits (`holdfast.testing.clock`).
"""

import asyncio
import gc
import os
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path

import hypothesis
import psutil
import pytest
import pytest_asyncio
import uvloop

from holdfast.testing.clock import virtual_loop_factory

# A whole actor system may start and stop within one example, on a machine that is busy with other things.
hypothesis.settings.register_profile("holdfast", deadline=None, print_blob=True)
hypothesis.settings.load_profile("holdfast")

# Inherited by every process that a test starts, so that orphans are found: they are nobody's children any more.
MARK = "HOLDFAST_TEST_RUN"
GRACE = 5.0  # seconds that processes told to end may take
TASK_GRACE = 10  # turns of the loop that a cancelled task may take to end
FD_SLACK = 4  # descriptors that a library may open at its first use and keep
OPEN_FILES = Path("/proc/self/fd")


def pytest_asyncio_loop_factories(
    config: pytest.Config, item: pytest.Item
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    factories: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {
        "uvloop": uvloop.new_event_loop,
        "asyncio": asyncio.new_event_loop,
    }
    marker = item.get_closest_marker("asyncio")
    if marker is not None and "virtual" in marker.kwargs.get("loop_factories", ()):
        factories["virtual"] = virtual_loop_factory  # by name only: other tests run under the two real loops
    return factories


@pytest.fixture(scope="session", autouse=True)
def no_orphan_left() -> Iterator[None]:
    """Fail the run if a process that a test started outlives it, even one that is no longer our descendant."""
    mark = f"{os.getpid()}-{time.time_ns()}"
    os.environ[MARK] = mark
    yield
    left = _end(lambda: [process for process in psutil.process_iter() if _is_marked(process, mark)])
    assert not left, f"processes outlived the tests: {left}"


@pytest.fixture(autouse=True)
def nothing_left(no_orphan_left: None) -> Iterator[None]:
    """Fail a test that leaves a child process or open files behind.

    This fixture is set up before the event loop of the test and torn down after it has been closed.
    """
    children, files = set(_children()), _open_files()
    yield
    left = _end(lambda: [child for child in _children() if child not in children])
    assert not left, f"the test left child processes: {left}"
    if _open_files().total() > files.total() + FD_SLACK:
        gc.collect()  # what only a reference cycle holds is not a leak
        grown = _open_files() - files
        assert _open_files().total() <= files.total() + FD_SLACK, f"the test left files open: {dict(grown)}"


@pytest.fixture(autouse=True)
def no_task_left_if_async(nothing_left: None, request: pytest.FixtureRequest) -> None:
    if pytest_asyncio.is_async_test(request.node):
        request.getfixturevalue("no_task_left")


@pytest.fixture
async def no_task_left() -> AsyncIterator[None]:
    """Fail an async test that leaves a task running; its own fixtures have been torn down by then."""
    before = asyncio.all_tasks()
    yield
    for _ in range(TASK_GRACE):
        if not _other_tasks(before):
            return
        await asyncio.sleep(0)
    left = _other_tasks(before)
    assert not left, f"the test left tasks running: {left}"


def _other_tasks(known: set[asyncio.Task[object]]) -> set[asyncio.Task[object]]:
    return asyncio.all_tasks() - known - {asyncio.current_task()}


def _open_files() -> Counter[str]:
    """What is open, by target; empty where there is no /proc."""
    try:
        return Counter(_target(link) for link in OPEN_FILES.iterdir())
    except FileNotFoundError:
        return Counter()


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except FileNotFoundError:  # the descriptor of the listing itself
        return "/proc"


def _children() -> list[psutil.Process]:
    """Our living descendants.

    The kernel's own list of children is looked at first: psutil reads every process of the machine, which is too slow
    to be done twice for each test.
    """
    try:
        own = [path.read_text() for path in Path("/proc/self/task").glob("*/children")]
    except OSError:  # a thread ended meanwhile
        own = []
    if own and not any(own):
        return []
    return [child for child in psutil.Process().children(recursive=True) if _is_ours(child)]


def _is_ours(child: psutil.Process) -> bool:
    """Tell a test's process from the resource tracker, which multiprocessing keeps until the interpreter ends."""
    try:
        return child.is_running() and "multiprocessing.resource_tracker" not in " ".join(child.cmdline())
    except psutil.Error:
        return False


def _is_marked(process: psutil.Process, mark: str) -> bool:
    try:
        return process.pid != os.getpid() and process.environ().get(MARK) == mark and _is_ours(process)
    except (psutil.Error, OSError):
        return False


def _end(find: Callable[[], list[psutil.Process]]) -> list[str]:
    """Give the processes that `find` finds time to end, kill the rest, and say which those were."""
    deadline = time.monotonic() + GRACE
    while (left := find()) and time.monotonic() < deadline:
        psutil.wait_procs(left, timeout=0.05)
    described = []
    for process in left:
        try:
            described.append(f"{process.pid} {process.status()} {' '.join(process.cmdline())}")
            process.kill()
        except psutil.Error:
            pass
    psutil.wait_procs(left, timeout=1.0)
    return described
