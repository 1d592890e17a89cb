"""The fixtures and `@simulate` beside the plugins that suites use: small sessions of pytest, each a process of its own.

The suite is the same each time: tests in a loop of each scope, two systems at once, a simulated test, and two that must
fail: one shows that the guard still looks, the other one that a failing schedule is still told.
"""

from importlib.metadata import entry_points

import pytest

from tests.testing.suites import CONFTEST

TESTS = """
import asyncio
import pytest
import holdfast as hf
from holdfast.testing import idle, probe, simulate

class Add(hf.Message[int]):
    n: int

class Counter(hf.Actor):
    def __init__(self):
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total

async def works(actor_system, probe):
    assert actor_system.node.loop is asyncio.get_running_loop()
    counter = actor_system.spawn(hf.start(Counter), "counter")
    assert await asyncio.wait_for(counter.ask(Add(2)), 30) == 2
    probe.tell(counter, Add(1))
    await idle(actor_system)
    probe.ref.tell(Add(1))
    await probe.expect(Add(1))

@pytest.mark.asyncio(loop_scope="function")
async def test_in_the_loop_of_its_own(actor_system, probe):
    await works(actor_system, probe)

@pytest.mark.asyncio(loop_scope="class")
class TestThem:
    async def test_in_the_loop_of_its_class(self, actor_system, probe):
        await works(actor_system, probe)

    async def test_in_the_same_loop(self, actor_system, probe):
        await works(actor_system, probe)

@pytest.mark.asyncio(loop_scope="module")
async def test_in_the_loop_of_its_module(actor_system, probe):
    await works(actor_system, probe)

@pytest.mark.asyncio(loop_scope="package")
async def test_in_the_loop_of_its_package(actor_system, probe):
    await works(actor_system, probe)

@pytest.mark.asyncio(loop_scope="session")
async def test_in_the_loop_of_the_session(actor_system, actor_systems, probe):
    await works(actor_system, probe)
    other = await actor_systems("other")
    await works(other, actor_probe(other))

actor_probe = probe

@simulate(seeds=3)
async def test_simulated(system):
    assert await system.spawn(hf.start(Counter)).ask(Add(3)) == 3

@pytest.mark.asyncio
async def test_leaks(actor_system):
    asyncio.get_running_loop().call_later(1000, print)

@simulate(seeds=3)
async def test_fails(system):
    assert await system.spawn(hf.start(Counter)).ask(Add(3)) == 4
"""
OTHERS = ("randomly", "timeout", "xdist", "pytest_cov")
ROWS = {
    "none of them": ((), ()),
    "strict": ((), ("-o", "asyncio_mode=strict")),
    "chosen loops": ((), ("-o", "holdfast_loops=uvloop")),
    "session loops": ((), ("-o", "asyncio_default_test_loop_scope=session")),
    "xdist": (("xdist",), ("-n", "1")),
    "randomly": (("randomly",), ("-p", "randomly", "--randomly-seed=3")),
    "timeout by signal": (("timeout",), ("--timeout=300", "--timeout-method=signal")),
    "timeout by thread": (("timeout",), ("--timeout=300", "--timeout-method=thread")),
    "cov": (("pytest_cov",), ("--cov=.", "--cov-report=term")),
    "all of them": (OTHERS, ("-n", "1", "--randomly-seed=5", "--timeout=300", "--cov=.")),
}


def session(pytester: pytest.Pytester, tests: str, loaded: tuple[str, ...], *args: str) -> pytest.RunResult:
    """Run a suite of a user's with these plugins and pytest-asyncio."""
    pytester.makeconftest(CONFTEST)
    pytester.makeini("[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function\n")
    pytester.makepyfile(test_suite=tests)
    left_out = [option for name in OTHERS if name not in loaded for option in ("-p", f"no:{name}")]
    return pytester.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:hypothesispytest", *left_out, *args)


@pytest.mark.parametrize("row", ROWS)
def test_the_fixtures_work_beside_other_plugins(
    pytester: pytest.Pytester, row: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    loaded, args = ROWS[row]
    result = session(pytester, TESTS, loaded, *args)
    result.assert_outcomes(passed=8, failed=1, errors=1)
    result.stdout.fnmatch_lines_random(["*a timer was left: builtins.print*", "*repeat it with @simulate(seed=*"])
    if "randomly" in loaded:
        result.stdout.fnmatch_lines(["*--randomly-seed=[35]*"])
    if "pytest_cov" in loaded:
        result.stdout.fnmatch_lines(["*test_suite.py *%*"])


def test_a_time_limit_of_pytest_timeout_ends_a_test_and_its_system(pytester: pytest.Pytester) -> None:
    tests = """
import asyncio
import time

async def test_hangs(actor_system):
    time.sleep(600)

async def test_goes_on(actor_system):
    assert actor_system.tree() == ["/app"]
"""
    result = session(pytester, tests, ("timeout",), "--timeout=2", "--timeout-method=signal")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*Timeout*"])


def test_the_plugin_of_anyio_is_refused_in_one_sentence(pytester: pytest.Pytester) -> None:
    tests = """
import pytest

@pytest.mark.anyio
async def test_adds(actor_system): ...
"""
    result = session(pytester, tests, (), "-o", "asyncio_mode=strict")
    assert result.parseoutcomes()["errors"] >= 1
    result.stdout.fnmatch_lines(["*mark it with @pytest.mark.asyncio instead of @pytest.mark.anyio*"])


def test_the_plugins_are_there() -> None:
    """Else the rows above would show nothing."""
    names = {one.name for one in entry_points(group="pytest11")}
    assert {*OTHERS, "asyncio", "anyio"} <= names
