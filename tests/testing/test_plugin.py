"""The pytest plugin, seen from outside: each test runs a small test suite of a user's in a directory of its own."""

import os
import sys

import pytest

from tests.testing.suites import CONFTEST, HEAD, run_suite


@pytest.fixture
def suite(pytester: pytest.Pytester):
    """Runs test functions of a user; `options` go into the pytest configuration."""

    def run(tests: str, *args: str, **options: str) -> pytest.RunResult:
        return run_suite(pytester, HEAD + tests, *args, **options)

    return run


def test_a_good_test_passes(suite) -> None:
    result = suite("""
async def test_adds(actor_system, probe):
    counter = actor_system.spawn(hf.start(Counter))
    assert await counter.ask(Add(2)) == 2
    probe.ref.tell(Add(1))
    await probe.expect(Add(1))
""")
    result.assert_outcomes(passed=1)


def test_the_fixtures_work_in_strict_mode_too(suite) -> None:
    result = suite(
        """
@pytest.mark.asyncio
async def test_adds(actor_system):
    assert await actor_system.spawn(hf.start(Counter)).ask(Add(2)) == 2
""",
        asyncio_mode="strict",
    )
    result.assert_outcomes(passed=1)


def test_a_dead_letter_that_nobody_expected_fails_the_test(suite) -> None:
    result = suite("""
async def test_forgets(actor_system):
    counter = actor_system.spawn(hf.start(Counter), "counter")
    await actor_system.stop(counter)
    counter.tell(Add(7))
""")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(
        ["*1 dead letters (none expected; if they are meant to be: actor_system.expect_dead_letters())*"]
    )
    result.stdout.fnmatch_lines(["*/app/counter: Add(n=7): the actor has stopped*"])


def test_a_crash_that_nobody_expected_fails_the_test(suite) -> None:
    result = suite("""
async def test_crashes(actor_system):
    counter = actor_system.spawn(hf.start(Counter), "counter")
    counter.tell(Add(-1))
    await actor_system._node.settled()
""")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*/app/counter (life 1) crashed in Add(n=-1): ValueError: negative*"])


def test_what_is_expected_passes_and_is_counted(suite) -> None:
    result = suite("""
async def crash(system):
    counter = system.spawn(hf.start(Counter), "counter")
    counter.tell(Add(-1))
    await system._node.settled()
    counter.tell(Add(1))

async def test_any(actor_system):
    actor_system.expect_crashes()
    actor_system.expect_dead_letters()
    await crash(actor_system)

@pytest.mark.holdfast(crashes=1, dead_letters=True)
async def test_marked(actor_system):
    await crash(actor_system)

@pytest.mark.holdfast(crashes=2, dead_letters=1)
async def test_too_few(actor_system):
    await crash(actor_system)
""")
    result.assert_outcomes(passed=3, errors=1)
    result.stdout.fnmatch_lines(["*1 crashes (2 expected*"])


def test_the_configuration_can_expect_for_all_tests(suite) -> None:
    result = suite(
        """
async def test_crashes(actor_system):
    actor_system.spawn(hf.start(Counter)).tell(Add(-1))
    await actor_system._node.settled()
""",
        holdfast_expect="crashes",
    )
    result.assert_outcomes(passed=1)


def test_what_is_queued_when_the_test_ends_is_no_dead_letter(suite) -> None:
    suite("""
class Slow(hf.Actor):
    @hf.on(Add)
    async def add(self, message):
        await asyncio.sleep(0.05)

async def test_does_not_wait(actor_system):
    slow = actor_system.spawn(hf.start(Slow))
    for _ in range(3):
        slow.tell(Add(1))
""").assert_outcomes(passed=1)


@pytest.mark.parametrize(
    ("leak", "text"),
    [
        ("kept.append(asyncio.ensure_future(asyncio.sleep(3600)))", "a task was left running: *sleep*"),
        ("kept.extend(open('/dev/null') for _ in range(9))", "a descriptor was left open: /dev/null*"),
        (
            "import subprocess; kept.append(subprocess.Popen(['sleep', '3600']))",
            "a process was left running: * sleep 3600*",
        ),
        (  # It would end within the time that the library's own processes have.
            "import subprocess; kept.append(subprocess.Popen(['sleep', '3']))",
            "a process was left running: * sleep 3*",
        ),
    ],
)
def test_a_leak_fails_the_test(suite, leak: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.testing.guard.process_leaks.SHORT_GRACE", 0.1)
    result = suite(f"""
kept = []

async def test_leaks(actor_system):
    {leak}

def test_cleans_up():
    for one in kept:
        if hasattr(one, "close"): one.close()
        if hasattr(one, "wait"): one.wait()
""")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines([f"*{text}*"])


def test_what_is_exchanged_stays_between_two_tests_and_goes_with_the_session(pytester: pytest.Pytester) -> None:
    """Meanwhile nobody is checked who does not ask for it."""
    pytester.makeconftest(
        CONFTEST
        + """
from holdfast.actors.kernel import loop
from holdfast.actors.kernel.ref import ActorRef

def exchanged():
    return ActorRef.tell, loop.run_turns

REAL = exchanged()

def pytest_configure(config):
    config.add_cleanup(lambda: print("all is back:", exchanged() == REAL))
"""
    )
    pytester.makeini("[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function\n")
    tests = """
from conftest import REAL, exchanged

async def test_guarded(actor_system):
    with pytest.raises(hf.errors.BadMessage):
        actor_system.spawn(hf.start(Counter)).tell(Add("one"))

async def test_plain():
    assert all(now != real for now, real in zip(exchanged(), REAL, strict=True))
    async with hf.ActorSystem(log=False) as system:
        system.spawn(hf.start(Counter)).tell(Add("one"))
"""
    pytester.makepyfile(HEAD + tests)
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:randomly")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*all is back: True*"])


def test_processes_that_are_about_to_end_are_no_leak(suite) -> None:
    """One that the test has told to end, and the library's own, which have longer."""
    suite("""
import subprocess, sys
from holdfast.actors.process.fork import boot

@pytest.fixture(scope="module")
def kept():
    kept = []
    yield kept
    for process in kept:
        process.wait()

async def test_told_to_end(actor_system, kept):
    kept.append(subprocess.Popen(["sleep", "3600"]))
    kept[-1].terminate()

async def test_own(actor_system, kept, monkeypatch):
    monkeypatch.setattr("holdfast.testing.guard.process_leaks.SHORT_GRACE", 0.0)
    program = "import sys; sys.stdin.read()"
    kept.append(subprocess.Popen([sys.executable, "-c", program, boot.__file__], stdin=subprocess.PIPE))
    asyncio.get_running_loop().call_later(0.0, kept[-1].stdin.close)
    await asyncio.sleep(0.01)
""").assert_outcomes(passed=2)


def test_leaks_can_be_expected(suite) -> None:
    suite("""
@pytest.mark.holdfast(leaks=True)
async def test_leaks(actor_system):
    asyncio.ensure_future(asyncio.sleep(0.0))
    kept.append(asyncio.ensure_future(asyncio.sleep(3600)))

kept = []
""").assert_outcomes(passed=1)


def test_each_system_of_the_factory_is_isolated_and_ended(suite) -> None:
    result = suite("""
@pytest.mark.holdfast(intensity=7)
async def test_two(actor_systems):
    one, other = await actor_systems("one"), await actor_systems("other", intensity=9)
    counter = one.spawn(hf.start(Counter), "counter")
    assert await counter.ask(Add(1)) == 1
    assert (one.tree(), other.tree()) == (["/one", "/one/counter"], ["/other"])
    assert (one._options.flags.intensity, other._options.flags.intensity) == (7, 9)
    running.extend([one, other])

def test_ended():
    assert [system.tree() for system in running] == [["/one"], ["/other"]]
    assert all(system._node.root.is_dead for system in running)

running = []
""")
    result.assert_outcomes(passed=2)


def test_a_message_that_is_mutated_by_its_receiver_is_found(suite) -> None:
    result = suite("""
async def test_mutates(actor_system):
    counter = actor_system.spawn(hf.start(Counter), "counter")
    await counter.ask(Many([1]))
""")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(
        ["*from the test to /app/counter: sent Many(items=[[]1]), after its turn it was Many(items=[[]1, 1])*"]
    )


def test_a_message_that_several_get_is_compared_after_each_turn(suite) -> None:
    result = suite("""
class Reader(hf.Actor):
    @hf.on(Many)
    def read(self, message):
        pass

async def test_mutates(actor_system):
    message = Many([1])
    for kind in (Reader, Counter):
        actor_system.spawn(hf.start(kind), kind.__name__).tell(message)
    await actor_system._node.settled()
""")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*from the test to /app/Counter: sent Many(items=[[]1])*"])


def test_a_message_that_is_mutated_by_its_sender_is_found(suite) -> None:
    result = suite("""
class Reader(hf.Actor):
    @hf.on(Many)
    def read(self, message):
        pass

async def test_mutates(actor_system):
    reader = actor_system.spawn(hf.start(Reader), "reader")
    items = [1]
    reader.tell(Many(items))
    items.clear()
    await actor_system._node.settled()

@pytest.mark.holdfast(sends=True)
async def test_may(actor_system):
    reader = actor_system.spawn(hf.start(Reader), "reader")
    items = [1]
    reader.tell(Many(items))
    items.clear()
    await actor_system._node.settled()
""")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*sent Many(items=[[]1]), after its turn it was Many(items=[[]])*"])


def test_a_message_of_the_wrong_types_is_refused_where_it_is_sent(suite) -> None:
    result = suite("""
import msgspec
@pytest.mark.parametrize("way", ["tell", "ask", "send", "publish"])
async def test_sends(actor_system, way):
    counter = actor_system.spawn(hf.start(Counter), "counter")
    actor_system._node.topics.subscribe("/adds", counter._cell)
    with pytest.raises(hf.errors.BadMessage, match="Expected `int`, got `str`"):
        if way == "publish":
            await actor_system.publish("/adds", Add("5"))
        elif way == "send":
            await counter.send(Add("5"))
        else:
            getattr(counter, way)(Add("5"))

class Shape(msgspec.Struct):
    name: str

class Circle(Shape):
    radius: float

class Draw(hf.Message):
    shapes: list[Shape]

class Board(hf.Actor):
    @hf.on(Draw)
    async def draw(self, message: Draw) -> None: ...

async def test_what_would_be_less_elsewhere(actor_system):
    board = actor_system.spawn(hf.start(Board), "board")
    board.tell(Draw([Shape("a")]))
    with pytest.raises(hf.errors.BadMessage, match="shapes.0..: a .*Circle is given where .*Shape is declared"):
        board.tell(Draw([Circle("b", 2.5)]))

async def test_without_the_plugin_nothing_is_checked():
    async with hf.ActorSystem(log=False) as system:
        counter = system.spawn(hf.start(Counter), "counter")
        with pytest.raises(hf.RemoteCrash):
            await counter.ask(Add("5"))
""")
    result.assert_outcomes(passed=6)


def test_tests_run_under_the_loops_that_are_configured(suite) -> None:
    tests = """
async def test_loop(actor_system):
    print("loop", type(asyncio.get_running_loop()).__module__)

@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_virtual(actor_system):
    print("loop", type(asyncio.get_running_loop()).__module__)
    await asyncio.sleep(3600)
"""
    result = suite(tests, "-s", holdfast_loops="uvloop asyncio")
    result.assert_outcomes(passed=3)
    result.stdout.fnmatch_lines(["*loop uvloop*", "*loop asyncio.*", "*loop holdfast.testing.clock*"])


def test_an_unknown_option_is_refused(suite) -> None:
    result = suite("", holdfast_loops="trio")
    result.stderr.fnmatch_lines(["*holdfast_loops: 'trio' is none of uvloop, asyncio*"])
    assert result.ret == pytest.ExitCode.USAGE_ERROR


def test_a_process_is_refused_under_the_virtual_clock(suite) -> None:
    result = suite(
        """
@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_process(actor_system):
    actor_system.expect_crashes()
    with pytest.raises(hf.HoldfastError, match="'c' with isolation='process' cannot run under the virtual clock"):
        await actor_system.start(hf.child("c", hf.start(Counter), isolation="process"))
""",
        holdfast_loops="asyncio",
    )
    result.assert_outcomes(passed=1)


def test_the_entry_point_and_a_conftest_that_names_the_plugin_go_together(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is once the package is installed; where it is already, this changes nothing."""
    installed = pytester.mkdir("installed")
    metadata = installed / "holdfast_plugin-1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: holdfast-plugin\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text("[pytest11]\nholdfast = holdfast.testing.plugin\n")
    monkeypatch.setenv("PYTHONPATH", f"{installed}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile("import pytest\n@pytest.mark.asyncio\nasync def test_it(probe): assert probe.waiting == ()")
    done = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--trace-config")
    done.assert_outcomes(passed=1)
    registered = [line for line in done.outlines if "PLUGIN registered" in line and "holdfast.testing.plugin" in line]
    assert len(registered) == 1


def test_without_pytest_asyncio_the_plugin_loads_and_its_fixtures_say_what_they_need(
    pytester: pytest.Pytester,
) -> None:
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(test_them="def test_a(actor_system): pass\ndef test_b(): pass")
    pytester.makepyfile(pytest_asyncio="raise ImportError('as if it were not installed')")
    script = pytester.makepyfile(
        run_it="import pytest, sys\n"
        "sys.exit(pytest.main(['-p', 'no:asyncio', '-p', 'no:cacheprovider', 'test_them.py']))"
    )
    done = pytester.runpython(script)
    done.assert_outcomes(passed=1, errors=1)
    done.stdout.fnmatch_lines(["*need pytest-asyncio: pip install 'holdfast[[]testing]'*"])


def test_loading_the_plugin_imports_no_other_module_of_testing(pytester: pytest.Pytester) -> None:
    done = pytester.run(
        sys.executable,
        "-c",
        "import sys, holdfast.testing.plugin\n"
        "print(sorted(name for name in sys.modules if name.startswith('holdfast.testing')))",
    )
    assert done.outlines == ["['holdfast.testing', 'holdfast.testing.plugin']"]


@pytest.mark.parametrize("loops", ["", "uvloop asyncio"], ids=["own loop", "chosen loops"])
@pytest.mark.parametrize("scope", ["class", "module", "package", "session"])
def test_a_system_runs_in_the_loop_of_its_test_whatever_its_scope(suite, scope: str, loops: str) -> None:
    result = suite(
        f"""
async def reached(system, probe):
    assert await asyncio.wait_for(system.spawn(hf.start(Counter)).ask(Add(1)), 30) == 1
    probe.ref.tell(Add(1))
    await probe.expect(Add(1))

@pytest.mark.asyncio(loop_scope="{scope}")
async def test_first(actor_system, probe):
    await reached(actor_system, probe)

@pytest.mark.asyncio(loop_scope="{scope}")
async def test_in_the_same_loop(actor_system, probe, actor_systems):
    await reached(actor_system, probe)
    assert (await actor_systems("other"))._node.loop is asyncio.get_running_loop()

async def test_in_a_loop_of_its_own(actor_system, probe):
    await reached(actor_system, probe)
""",
        holdfast_loops=loops,
    )
    result.assert_outcomes(passed=6 if loops else 3)


def test_the_default_scope_of_tests_counts(suite) -> None:
    result = suite(
        """
async def test_adds(actor_system):
    assert await asyncio.wait_for(actor_system.spawn(hf.start(Counter)).ask(Add(1)), 30) == 1
""",
        asyncio_default_test_loop_scope="session",
    )
    result.assert_outcomes(passed=1)


@pytest.mark.parametrize("mode", ["auto", "strict"])
def test_a_test_of_the_plugin_of_anyio_is_refused_in_one_sentence(suite, mode: str) -> None:
    result = suite(
        """
@pytest.mark.anyio
async def test_adds(actor_system):
    assert await actor_system.spawn(hf.start(Counter)).ask(Add(1)) == 1
""",
        asyncio_mode=mode,
    )
    assert result.parseoutcomes()["errors"] >= 1
    result.stdout.fnmatch_lines(["*mark it with @pytest.mark.asyncio instead of @pytest.mark.anyio*"])
    result.stdout.no_fnmatch_line("*was left running*")


@pytest.mark.parametrize("fixture", ["actor_system", "actor_systems", "sim_fleet", "probe"])
def test_a_test_that_is_refused_spoils_no_other(pytester: pytest.Pytester, fixture: str) -> None:
    tests = f"""
@pytest.mark.anyio
async def test_refused({fixture}):
    pass

@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_later({fixture}):
    pass

@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_much_later({fixture}):
    pass
"""
    run_suite(pytester, HEAD + tests, asyncio_mode="strict", holdfast_loops="asyncio").assert_outcomes(
        passed=2, errors=1
    )


# -- simulate --------------------------------------------------------------------------------------------------------


def test_simulate_honours_markers_and_the_configuration(suite) -> None:
    result = suite("""
from holdfast.testing import simulate

async def crash(system):
    system.spawn(hf.start(Counter), "counter").tell(Add(-1))
    await system._node.settled()

@simulate(seeds=2)
@pytest.mark.holdfast(crashes=1)
async def test_marked_below(system):
    await crash(system)

@pytest.mark.holdfast(crashes=True)
@simulate(seeds=2)
async def test_marked_above(system):
    await crash(system)

@pytest.mark.holdfast(crashes=True)
class TestMarked:
    @simulate(seeds=2)
    async def test_class(self, system, tmp_path):
        await crash(system)

@pytest.mark.holdfast(crashes=2)
@simulate(seeds=2)
async def test_too_few(system):
    await crash(system)

@simulate(seeds=2)
async def test_not_expected(system):
    await crash(system)
""")
    result.assert_outcomes(passed=3, failed=2)
    result.stdout.fnmatch_lines(["*1 crashes (2 expected*"])


def test_simulate_fails_for_what_is_left_behind(suite) -> None:
    result = suite("""
import os
from holdfast.testing import simulate

KEPT = []

@simulate(seeds=2)
async def test_leaves_a_task(system):
    system.left = asyncio.create_task(asyncio.sleep(1e9))

@simulate(seeds=2)
async def test_leaves_files(system):
    KEPT.extend(os.open(__file__, os.O_RDONLY) for _ in range(20))

def test_tidies_up():
    for file in KEPT:
        os.close(file)

@pytest.mark.holdfast(leaks=True)
@simulate(seeds=2)
async def test_may_leave_a_task(system):
    system.left = asyncio.create_task(asyncio.sleep(1e9))
""")
    result.assert_outcomes(passed=2, failed=2)
    result.stdout.fnmatch_lines(["*a task was left running*", "*seed=0: repeat it*", "*a descriptor was left open*"])


def test_given_stands_above_simulate(suite) -> None:
    result = suite("""
from hypothesis import given, settings, strategies as st
from holdfast.testing import simulate

@settings(max_examples=5, database=None, derandomize=True)
@given(st.integers(0, 9), st.booleans())
@simulate(seeds=2)
async def test_adds(system, n, again):
    counter = system.spawn(hf.start(Counter))
    assert await counter.ask(Add(n)) == n
    assert again in (True, False)

@settings(max_examples=20, database=None, derandomize=True)
@given(n=st.integers(0, 9))
@simulate(seeds=2)
async def test_finds(system, n):
    assert await system.spawn(hf.start(Counter)).ask(Add(n)) < 3
""")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*seed=0: repeat it*"])


FAILING = """
from holdfast.testing import simulate

def check(total):
    assert total == 4, "not four"

@simulate(seeds=2)
async def test_fails(system):
    check(await system.spawn(hf.start(Counter)).ask(Add(3)))

@simulate(seeds=2)
async def test_crashes(system):
    system.spawn(hf.start(Counter)).tell(Add(-1))
"""


@pytest.mark.parametrize("option", ["--tb=auto", "--tb=short", "--tb=native", "--holdfast-real"])
def test_a_failure_of_a_simulated_test_shows_the_lines_of_the_test(suite, option: str) -> None:
    result = suite(FAILING, option)
    result.assert_outcomes(failed=2)
    shown = result.stdout.str()
    assert "check(await system.spawn" in shown
    assert "not four" in shown
    assert "negative" in shown
    for hidden in ("_run_all", "run_schedule", "base_events.py", "runners.py"):
        assert hidden not in shown


REAL = """
import os
from holdfast.testing import simulate

@simulate(seeds=200, store="simulated", latency=(0.0, 1.0))
async def test_nothing_is_lost(system, simulation, faults):
    system.expect_crashes()
    child = hf.child("counter", hf.start(Counter), isolation="process", recovery=hf.hybrid())
    counter = await system.start(child)
    assert simulation.is_real == (system.pid_of(counter) < 2**22)
    asks = [counter.ask(Add(1)) for _ in range(5)]
    await simulation.moment(20)
    simulation.kill_process(counter)
    assert sorted(await asyncio.gather(*asks)) == [1, 2, 3, 4, 5]
    with open("seeds", "a") as seeds:
        print(simulation.seed, simulation.is_real, faults.seed, bool(simulation.trace), file=seeds)

@simulate(seeds=2, store="simulated")
async def test_kills_the_root(system, simulation):
    await simulation.crash_root()

@simulate(seeds=2)
async def test_fails(system, simulation):
    assert simulation.seed < 1
"""


def test_simulated_tests_run_on_real_processes_too(suite) -> None:
    result = suite(REAL, "--holdfast-real")
    result.assert_outcomes(passed=1, skipped=1, failed=1)
    result.stdout.fnmatch_lines(["*seed=1, on a real loop (--holdfast-real): its faults are the seed's*"])
    with open("seeds", encoding="ascii") as seeds:
        assert seeds.read().split("\n") == ["0 True 0 True", "1 True 1 True", "2 True 2 True", ""]
    result = suite(REAL, "--holdfast-real", "--holdfast-seed", "7", "-k", "nothing")
    result.assert_outcomes(passed=1, deselected=2)
    with open("seeds", encoding="ascii") as seeds:
        assert seeds.read().split("\n")[3:] == ["7 True 7 True", ""]
    result = suite(REAL, "--holdfast-seeds", "2")
    result.assert_outcomes(passed=2, failed=1)


@pytest.mark.parametrize("seeds", ["0", "-3", "many"])
def test_no_number_of_seeds_lets_tests_pass_unrun(suite, seeds: str) -> None:
    result = suite(REAL, "--holdfast-seeds", seeds)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"*'{seeds}' is no number: it takes one or more"])
