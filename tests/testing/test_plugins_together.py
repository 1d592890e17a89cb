"""The fixtures and `@simulate` beside the plugins that suites use: small sessions of pytest, each a process of its own.

The suite is the same each time: tests in a loop of each scope, two systems at once, a simulated test, and two that must
fail: one shows that the guard still looks, the other one that a failing schedule is still told.
"""

import itertools
import random
from importlib.metadata import entry_points

import pytest

from tests.pairs import covering
from tests.testing.suites import CONFTEST, HEAD

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
    assert actor_system._node.loop is asyncio.get_running_loop()
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
OF_ANYIO = """
@pytest.fixture
def anyio_backend():
    return "asyncio"

@pytest.mark.anyio
async def test_of_anyio(anyio_backend_name):
    await asyncio.sleep(0)
    assert anyio_backend_name == "asyncio"
"""
OTHERS = ("randomly", "timeout", "xdist", "pytest_cov", "anyio")
SCOPES = ("function", "class", "module", "session")
MATRIX: dict[str, dict[str, str]] = {
    "xdist": {"one process": "-p no:xdist", "a worker": "-n 1"},
    "randomly": {"in order": "-p no:randomly", "shuffled": "--randomly-seed=3"},
    "timeout": {
        "no limit": "-p no:timeout",
        "signal": "--timeout=300 --timeout-method=signal",
        "thread": "--timeout=300 --timeout-method=thread",
    },
    "cov": {"not covered": "-p no:pytest_cov", "covered": "--cov=. --cov-report=term"},
    "anyio": {"no anyio": "-p no:anyio", "anyio": "", "anyio takes all": "-o anyio_mode=auto"},
    "loop of tests": {f"tests {scope}": f"-o asyncio_default_test_loop_scope={scope}" for scope in SCOPES},
    "loop of fixtures": {f"fixtures {scope}": f"-o asyncio_default_fixture_loop_scope={scope}" for scope in SCOPES},
    "mode": {"auto": "-o asyncio_mode=auto", "strict": "-o asyncio_mode=strict"},
    "loops": {"its loop": "", "chosen": "-o holdfast_loops=uvloop"},
}
"""What each plugin may be told, by what it is called in the name of a row."""
VALUES = [[(plugin, name) for name in values] for plugin, values in MATRIX.items()]
CROSSED = list(itertools.product(*VALUES))
SOME = random.Random(5).sample(CROSSED, 400)
"""Of the 4,608 rows: to find few that cover all pairs takes too long among all of them."""
ROWS = {
    ", ".join(name for _, name in SOME[number]): [MATRIX[plugin][name] for plugin, name in SOME[number]]
    for number in covering([tuple(VALUES[at].index(value) for at, value in enumerate(row)) for row in SOME])
}


def session(pytester: pytest.Pytester, tests: str, *args: str) -> pytest.RunResult:
    """Run a suite of a user's with pytest-asyncio and the other plugins."""
    pytester.makeconftest(CONFTEST)
    pytester.makeini("[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function\n")
    pytester.makepyfile(test_suite=tests)
    return pytester.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:hypothesispytest", *args)


def test_the_rows_have_every_pair() -> None:
    """Of what two plugins are told."""
    pairs = {pair for row in CROSSED for pair in itertools.combinations(row, 2)}
    named = [list(zip(MATRIX, row.split(", "), strict=True)) for row in ROWS]
    assert {pair for row in named for pair in itertools.combinations(row, 2)} == pairs


@pytest.mark.some(11)
@pytest.mark.parametrize("row", ROWS)
def test_the_fixtures_work_beside_other_plugins(
    pytester: pytest.Pytester, row: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    names = row.split(", ")
    result = session(pytester, TESTS + OF_ANYIO * ("no anyio" not in names), *" ".join(ROWS[row]).split())
    if "anyio takes all" in names:  # Not even pytest-asyncio's own fixtures are in the loop of the test then.
        result.assert_outcomes(passed=2, failed=1, errors=7, warnings=None)
        result.stdout.fnmatch_lines(["*anyio's plugin takes the async fixtures*: set anyio_mode = strict"])
    else:
        result.assert_outcomes(passed=8 + ("anyio" in names), failed=1, errors=1)
        result.stdout.fnmatch_lines_random(["*a timer was left: builtins.print*", "*repeat it with @simulate(seed=*"])
    if "shuffled" in names:
        result.stdout.fnmatch_lines(["*--randomly-seed=3*"])
    if "covered" in names:
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
    result = session(pytester, tests, "--timeout=2", "--timeout-method=signal")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*Timeout*"])


def test_the_plugin_of_anyio_is_refused_in_one_sentence(pytester: pytest.Pytester) -> None:
    tests = """
import pytest

@pytest.mark.anyio
async def test_adds(actor_system): ...
"""
    result = session(pytester, tests, "-o", "asyncio_mode=strict")
    assert result.parseoutcomes()["errors"] >= 1
    result.stdout.fnmatch_lines(["*mark it with @pytest.mark.asyncio instead of @pytest.mark.anyio*"])


def test_the_plugins_are_there() -> None:
    """Else the rows above would show nothing."""
    names = {one.name for one in entry_points(group="pytest11")}
    assert {*OTHERS, "asyncio"} <= names


HANGS = """
import itertools, time
from holdfast.testing import simulate

runs = itertools.count(1)

class Beat(hf.Actor):
    def on_start(self, restored):
        self.ctx.every(1.0, Add(1))

    @hf.on(Add)
    def beat(self, message):
        return 1

@simulate(seeds=5)
async def test_hangs(system):
    print("run", next(runs))
    system.spawn(hf.start(Beat))
    await asyncio.Event().wait()

@simulate(seeds=5)
async def test_is_slow_to_fail(system):
    if next(runs) > 1:
        time.sleep(10)
    assert False, "of its own"
"""


def test_a_time_limit_is_no_failure_to_repeat(pytester: pytest.Pytester) -> None:
    result = session(pytester, HEAD + HANGS, "--timeout=2", "--timeout-method=signal", "-k", "hangs")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*its time was over in the run of seed 0*", "run 1"])
    result.stdout.no_fnmatch_line("run 2")
    result.stdout.no_fnmatch_line("*cannot be repeated*")


def test_a_time_limit_while_a_failure_is_shrunk_leaves_that_failure(pytester: pytest.Pytester) -> None:
    result = session(pytester, HEAD + HANGS, "--timeout=2", "--timeout-method=signal", "-k", "slow")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*of its own*", "*the time of the test was over before this failure, of seed 0*"])
