"""Every folder of tests meets both event loops, and no test leaves anything behind.

The tests of the kernel (`tests/actors/*.py`), which is what touches the loop, run under both loops. Of any other async
test each set of parameters runs under one of the two, in turn; `HOLDFAST_LOOPS=both` has all of them run under both. A
test that must not run under one of the loops says so with `@pytest.mark.asyncio(loop_factories=["uvloop"])`, one that
shall always run under both with `loop_factories=["uvloop", "asyncio"]`, and one that is about time, where nothing
waits, with `loop_factories=["virtual"]` (`holdfast.testing.clock`). The loops are named in pyproject.toml
(`holdfast_loops`) and made by our own plugin.

Of a test that is marked with `pairs` some rows run, in which each pair of values of two parameters occurs; the loop
is one of these parameters where a test runs under both. Of one marked with `some(n)`, whose rows take long, n run,
spread evenly, or all where checks are removed. `HOLDFAST_CROSSED=1` runs all.

What Hypothesis draws depends on the test alone, so a run today finds what it found yesterday, on every machine;
`HOLDFAST_RANDOM=1` draws anew, and `HOLDFAST_RANDOM=N` repeats the run that printed this number.
"""

import asyncio
import contextlib
import os
import random
import signal
import sys
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import hypothesis
import psutil
import pytest
import pytest_asyncio
import structlog
import uvloop

from holdfast.actors.kernel.loop import RunLoop
from holdfast.actors.process.fork import fork_server, launch
from holdfast.testing.guard import process_leaks
from holdfast.testing.guard.leaks import Leaks
from holdfast.testing.guard.loop_leaks import LoopLeaks
from holdfast.testing.guard.process_leaks import GRACE, end_processes, is_of_test
from tests.pairs import covering, spread
from tests.supervision.programs import Ends
from tests.waits import Waits
from tests.warm import WARM, WarmServers, bury, warm_popen

# Installed, the plugin comes by its entry point; in a checkout whose metadata is older it is named here. Not both:
# pytest refuses to register it under two names.
IS_INSTALLED = bool(entry_points(group="pytest11", name="holdfast"))
pytest_plugins = ["pytester", "holdfast.testing.hanging", *([] if IS_INSTALLED else ["holdfast.testing.plugin"])]

# The tests start thousands of processes that import holdfast. Where the environment forbids byte code, each of them
# would compile all of it, which takes longer than most tests do.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A whole actor system may start and stop within one example, on a machine that is busy with other things.
REPEATABLE = hypothesis.settings(deadline=None, print_blob=True, derandomize=True, database=None)
hypothesis.settings.register_profile("repeatable", REPEATABLE)
hypothesis.settings.register_profile("random", REPEATABLE, derandomize=False)
RANDOM = os.environ.get("HOLDFAST_RANDOM", "")
hypothesis.settings.load_profile("random" if RANDOM else "repeatable")

LONGEST = (
    "testing/stores/test_judged.py",
    "test_docs.py",
    "migration/test_moved_supervisors.py",
    "diagnosis/repair/test_hung_turns.py",
    "console/test_operate.py",
    "migration/test_moved_kinds.py",
    "console/test_service.py",
    "checkpoint/test_chunks_kept.py",
    "console/test_command_line_page.py",
    "ftm/test_bad_changes.py",
    "ftm/test_probation.py",
    "migration/test_far_moves.py",
    "checkpoint/test_kills.py",
    "system/test_moved_replicas.py",
    "checkpoint/test_order.py",
    "testing/test_plugins_together.py",
    "test_examples.py",
    "cluster/machines/test_machine_faults.py",
    "history/test_why_live.py",
    "diagnosis/observers/test_kinds.py",
    "upgrades/test_what_a_change_does.py",
    "cluster/test_servers_gone.py",
    "checkpoint/test_evolving.py",
    "console/dashboard/test_browser.py",
    "ftm/test_put_back.py",
    "checkpoint/test_large_states.py",
    "testing/machines/test_machine.py",
    "migration/test_moves_at_odds.py",
    "checkpoint/test_engines.py",
    "cluster/test_engine_on_nats.py",
    "test_package.py",
    "test_soak.py",
)
"""Files that take long for the tests they have, longest first: if one were begun last, it alone would be waited for."""

LOOP = "_asyncio_loop_factory"  # the parameter that pytest-asyncio adds
UNDER_BOTH = Path(__file__).parent / "actors"  # but not the folders in it

# Inherited by every process that a test starts, so that orphans are found: they are nobody's children any more.
MARK = "HOLDFAST_TEST_RUN"

LISTENER: pytest.StashKey[Any] = pytest.StashKey()
"""What hears the frames of this run (`tests/actors/process/hostile/corpus.py`)."""


@pytest.hookimpl(tryfirst=True)  # Before Hypothesis looks at its option.
def pytest_configure(config: pytest.Config) -> None:
    """Have programs hear Ctrl+C, and choose the seed of a random run; the other processes of the run inherit both."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # A shell that started us with & has it ignored, and so would have each program that a test interrupts.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if "HOLDFAST_CORPUS" in os.environ:
        from tests.actors.process.hostile.corpus import Listener

        config.stash[LISTENER] = Listener()
    config.addinivalue_line("markers", "pairs: each pair of values of two parameters is enough (tests/pairs.py)")
    config.addinivalue_line("markers", "some(n): so many of its rows are enough, spread evenly (tests/pairs.py)")
    if RANDOM == "1":
        os.environ["HOLDFAST_RANDOM"] = str(random.SystemRandom().randrange(2, 2**32))
    if config.pluginmanager.hasplugin("xdist"):
        config.option.loadscopereorder = False  # The order is that of `_longest_first`.
    if RANDOM and config.getoption("hypothesis_seed") is None:
        config.option.hypothesis_seed = os.environ["HOLDFAST_RANDOM"]


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Keep the frames that were new, if that is wanted."""
    listener = session.config.stash.get(LISTENER, None)
    if listener is not None:
        listener.save()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how long each folder of tests and the slowest files took, and how to repeat what was drawn."""
    rooms: defaultdict[str, float] = defaultdict(float)
    files: defaultdict[str, float] = defaultdict(float)
    for reports in terminalreporter.stats.values():
        for report in reports:
            if isinstance(report, pytest.TestReport):
                file = report.nodeid.partition("::")[0].removeprefix("tests/")
                rooms[file.partition("/")[0]] += report.duration
                files[file] += report.duration
    if len(rooms) > 1:
        for title, seconds in (("seconds per room", rooms), ("seconds of the slowest files", files)):
            longest_first = sorted(seconds, key=seconds.__getitem__, reverse=True)
            terminalreporter.section(title)
            terminalreporter.line(", ".join(f"{name} {seconds[name]:.0f}" for name in longest_first[:30]))
    if RANDOM:
        terminalreporter.line(f"Hypothesis drew at random: HOLDFAST_RANDOM={os.environ['HOLDFAST_RANDOM']} repeats it")


@pytest.hookimpl(trylast=True)  # Behind -k and -m: what these have left of a test is run.
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave each test the parameters and the loops that it shall run under."""
    dropped: set[pytest.Item] = set()
    if "HOLDFAST_CROSSED" not in os.environ:
        dropped |= _beyond_rows(items)
    if os.environ.get("HOLDFAST_LOOPS") != "both":
        dropped |= _of_other_loops([item for item in items if item not in dropped])
    if dropped:
        config.hook.pytest_deselected(items=list(dropped))
        items[:] = [item for item in items if item not in dropped]
    if "PYTEST_XDIST_WORKER" in os.environ:
        _longest_first(items)


def _longest_first(items: list[pytest.Item]) -> None:
    """Put files in front that take long, and then those with many tests: no worker is left with much at the end."""
    files: defaultdict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        files[item.nodeid.partition("::")[0].removeprefix("tests/")].append(item)
    places = {name: place for place, name in enumerate(LONGEST)}
    order = sorted(files, key=lambda name: (places.get(name, len(places)), -len(files[name])))
    items[:] = [item for name in order for item in files[name]]


def _beyond_rows(items: list[pytest.Item]) -> set[pytest.Item]:
    """Rows of tests marked with `pairs` all of whose pairs other rows have (`tests/pairs.py`), or beyond `some`."""
    places = Places()
    rows: dict[str, dict[tuple[int, ...], list[pytest.Item]]] = {}
    counts: dict[str, int] = {}
    for item in items:
        callspec = getattr(item, "callspec", None)
        some = None if "HOLDFAST_REMOVED" in os.environ else item.get_closest_marker("some")
        if callspec is not None and (some or item.get_closest_marker("pairs")):
            params = dict(callspec.params)
            test = item.nodeid.partition("[")[0]
            if not _chooses_loops(item):
                params.pop(LOOP, None)  # One of them is chosen for each row.
            row = tuple(
                places.of(test, name, value) for name, value in sorted(params.items(), key=lambda pair: pair[0])
            )
            rows.setdefault(test, {}).setdefault(row, []).append(item)
            if some:
                counts[test] = some.args[0]
    dropped: set[pytest.Item] = set()
    for test, of_test in rows.items():
        kept = set(spread(len(of_test), counts[test]) if test in counts else covering(list(of_test)))
        dropped.update(item for number, some in enumerate(of_test.values()) if number not in kept for item in some)
    return dropped


def _of_other_loops(items: list[pytest.Item]) -> set[pytest.Item]:
    """Tests under a loop other than the one that is chosen for them."""
    places = Places()
    runs: dict[tuple[str, tuple[int, ...]], dict[int, list[pytest.Item]]] = {}
    for item in items:
        callspec = getattr(item, "callspec", None)
        if callspec is not None and LOOP in callspec.params and not _chooses_loops(item):
            params = dict(callspec.params)
            loop, test = id(params.pop(LOOP)), item.nodeid.partition("[")[0]
            others = tuple(places.of(test, name, value) for name, value in params.items())
            runs.setdefault((test, others), {}).setdefault(loop, []).append(item)
    dropped: set[pytest.Item] = set()
    for (test, others), under in runs.items():
        # In turn along each parameter. The name, or all tests without parameters would run under the same loop.
        chosen = (zlib.crc32(test.encode()) + sum(others)) % len(under)
        dropped.update(item for number, some in enumerate(under.values()) if number != chosen for item in some)
    return dropped


class Places:
    """The values of each parameter by number: the very objects, for they need not be comparable."""

    def __init__(self) -> None:
        self._places: defaultdict[tuple[str, str], dict[int, int]] = defaultdict(dict)

    def of(self, test: str, name: str, value: object) -> int:
        known = self._places[test, name]
        return known.setdefault(id(value), len(known))


def _chooses_loops(item: pytest.Item) -> bool:
    marker = item.get_closest_marker("asyncio")
    return item.path.parent == UNDER_BOTH or (marker is not None and "loop_factories" in marker.kwargs)


@pytest.fixture(scope="session", autouse=True)
def no_orphan_left() -> Iterator[None]:
    """Fail the run if a process that a test started outlives it, even one that is no longer our descendant."""
    mark = f"{os.getpid()}-{time.time_ns()}"
    os.environ[MARK] = mark
    yield
    left = end_processes(lambda: [one for one in psutil.process_iter() if _is_marked(one, mark)], GRACE)
    assert not left, f"processes outlived the tests: {left}"


@pytest.fixture(scope="session", autouse=True)
def temporary_folder(no_orphan_left: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Fail the run if it leaves something of ours where temporary files are; it has a folder of its own for these.

    What belongs to this very process goes when that ends.
    """
    folder = tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folder))
        patch.setenv("XDG_RUNTIME_DIR", str(folder))  # where systems are found by name
        patch.setattr(tempfile, "tempdir", None)
        yield
    left = [one.name for one in folder.glob("holdfast-*") if f"-{os.getpid()}-" not in one.name]
    assert not left, f"the tests left temporary files: {left}"


@pytest.fixture(scope="session", autouse=True)
def pipe_of_libuv() -> None:
    """Have the one pipe opened that libuv keeps for the whole process, before any test is asked what it has opened."""
    uvloop.new_event_loop().close()


@pytest.fixture(scope="session", autouse=True)
def warm_servers(temporary_folder: None) -> Iterator[WarmServers | None]:
    """Where fork servers come from, without the start of an interpreter for each (`tests/warm.py`)."""
    if "HOLDFAST_COLD" in os.environ or not sys.platform.startswith("linux"):
        yield None
        return
    warm = WarmServers()
    with pytest.MonkeyPatch.context() as patch:
        # What was forked from the warm process does not show that it is the library's own, which has longer to end.
        patch.setattr(process_leaks, "SHORT_GRACE", process_leaks.GRACE)
        yield warm
    warm.close()


@pytest.fixture(autouse=True)
def nothing_left(warm_servers: WarmServers | None) -> Iterator[None]:
    """Fail a test that leaves a child process or open files behind.

    This fixture is set up before the event loop of the test and torn down after it has been closed.
    """
    if WARM:
        bury()
    leaks = Leaks()
    leaks.close()  # What is made meanwhile is the guard's to tell, in the tests that have one.
    yield
    left = leaks.processes()
    assert not left, f"the test left child processes: {left}"
    grown = leaks.files()
    assert not grown, f"the test left files open: {grown}"


@pytest.fixture
def ends() -> Iterator[Ends]:
    """The ends of processes that a test does not start itself."""
    found = Ends()
    yield found
    for fd in found.fds:
        os.close(fd)


@pytest.fixture(autouse=True)
def structlog_as_it_was() -> Iterator[None]:
    """Have no test find structlog set up by another one: our records go to standard logging then, as a user's do."""
    yield
    if structlog.is_configured():
        structlog.reset_defaults()


@pytest.fixture(autouse=True)
def warm_fork_servers(nothing_left: None, warm_servers: WarmServers | None, monkeypatch: pytest.MonkeyPatch) -> None:
    if warm_servers is not None:
        monkeypatch.setattr(fork_server, "exec_server", warm_servers.exec_server)


@pytest.fixture
def warm_programs(warm_servers: WarmServers | None) -> Iterator[None]:
    """Fork programs that a test starts with our interpreter from the warm process, and their fork servers, too."""
    with contextlib.nullcontext() if warm_servers is None else warm_popen(warm_servers):
        yield


@pytest.fixture
def cold_fork_servers(warm_fork_servers: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Start fork servers as users' are: by exec. For tests that are about that."""
    monkeypatch.setattr(fork_server, "exec_server", launch.exec_server)


@pytest.fixture(autouse=True)
def no_supervisor_waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test in which a supervisor has waited in a turn of its own, say for a child that starts or stops."""
    waits = Waits()
    monkeypatch.setattr(RunLoop, "hold", lambda *args: waits.hold(*args))
    yield
    assert not waits.seen, "a supervisor has waited in its own turn:\n" + "\n".join(waits.seen)


@pytest.fixture(autouse=True)
def no_task_left_if_async(nothing_left: None, request: pytest.FixtureRequest) -> None:
    if pytest_asyncio.is_async_test(request.node):
        request.getfixturevalue("no_task_left")


@pytest.fixture
async def no_task_left(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    """Fail an async test that leaves a task running; its own fixtures have been torn down by then.

    The stock loop (and the virtual clock, which is one) is in debug mode, which sees calls from other threads. That it
    also keeps the origin of each callback takes a third of the time of such tests: that it does with
    `HOLDFAST_LOOPS=both` only. uvloop runs as it does for users.
    """
    loop = asyncio.get_running_loop()
    if os.environ.get("HOLDFAST_LOOPS") == "both":
        loop.set_debug(isinstance(loop, asyncio.BaseEventLoop))
    elif isinstance(loop, asyncio.BaseEventLoop):
        # What looks at calls goes by the attribute, what keeps origins (futures, tasks, handles) asks the method.
        monkeypatch.setattr(loop, "_debug", True)
        monkeypatch.setattr(loop, "get_debug", lambda: False)
    leaks = LoopLeaks()
    leaks.close()
    yield
    left = await leaks.tasks()
    assert not left, f"the test left tasks running: {left}"


def _is_marked(process: psutil.Process, mark: str) -> bool:
    try:
        return process.pid != os.getpid() and process.environ().get(MARK) == mark and is_of_test(process)
    except (psutil.Error, OSError):
        return False
