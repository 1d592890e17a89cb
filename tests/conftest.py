"""Every async test runs under both event loops, and no test leaves anything behind.

A test that must not run under one of the loops says so with `@pytest.mark.asyncio(loop_factories=["uvloop"])`; one
that is about time asks for `loop_factories=["virtual"]`, where nothing waits (`holdfast.testing.clock`). The loops are
named in pyproject.toml (`holdfast_loops`) and made by our own plugin.
"""

import os
import time
from collections.abc import AsyncIterator, Iterator
from importlib.metadata import entry_points

import hypothesis
import psutil
import pytest
import pytest_asyncio

from holdfast.testing.leaks import Leaks, end_processes, is_of_test

# Installed, the plugin comes by its entry point; in a checkout whose metadata is older it is named here. Not both:
# pytest refuses to register it under two names.
IS_INSTALLED = bool(entry_points(group="pytest11", name="holdfast"))
pytest_plugins = ["pytester", *([] if IS_INSTALLED else ["holdfast.testing.plugin"])]

# A whole actor system may start and stop within one example, on a machine that is busy with other things.
hypothesis.settings.register_profile("holdfast", deadline=None, print_blob=True)
hypothesis.settings.load_profile("holdfast")

# Inherited by every process that a test starts, so that orphans are found: they are nobody's children any more.
MARK = "HOLDFAST_TEST_RUN"


@pytest.fixture(scope="session", autouse=True)
def no_orphan_left() -> Iterator[None]:
    """Fail the run if a process that a test started outlives it, even one that is no longer our descendant."""
    mark = f"{os.getpid()}-{time.time_ns()}"
    os.environ[MARK] = mark
    yield
    left = end_processes(lambda: [process for process in psutil.process_iter() if _is_marked(process, mark)])
    assert not left, f"processes outlived the tests: {left}"


@pytest.fixture(autouse=True)
def nothing_left(no_orphan_left: None) -> Iterator[None]:
    """Fail a test that leaves a child process or open files behind.

    This fixture is set up before the event loop of the test and torn down after it has been closed.
    """
    leaks = Leaks()
    yield
    left = leaks.processes()
    assert not left, f"the test left child processes: {left}"
    grown = leaks.files()
    assert not grown, f"the test left files open: {grown}"


@pytest.fixture(autouse=True)
def no_task_left_if_async(nothing_left: None, request: pytest.FixtureRequest) -> None:
    if pytest_asyncio.is_async_test(request.node):
        request.getfixturevalue("no_task_left")


@pytest.fixture
async def no_task_left() -> AsyncIterator[None]:
    """Fail an async test that leaves a task running; its own fixtures have been torn down by then."""
    leaks = Leaks()
    yield
    left = await leaks.tasks()
    assert not left, f"the test left tasks running: {left}"


def _is_marked(process: psutil.Process, mark: str) -> bool:
    try:
        return process.pid != os.getpid() and process.environ().get(MARK) == mark and is_of_test(process)
    except (psutil.Error, OSError):
        return False
