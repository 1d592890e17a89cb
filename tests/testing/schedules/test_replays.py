"""A schedule that is to be repeated fits its test, or the test fails: what passed would be another run."""

import os
import re
import subprocess
import sys

import pytest

import holdfast as hf
from holdfast.testing import Faults, GuardedSystem, simulate
from holdfast.testing.schedules.choices import UnfitSchedule
from tests.testing.schedules.planted import Go, Note, Step, Teller
from tests.testing.suites import HEAD, run_suite


async def right(system: GuardedSystem) -> None:
    """It passes whatever comes first, with a few choices on the way."""
    note = system.spawn(hf.start(Note))
    for number in range(3):
        system.spawn(hf.start(Teller, note, number)).tell(Go())
    await note.ask(Step(3))


async def with_faults(system: GuardedSystem, faults: Faults) -> None:
    note = system.spawn(hf.start(Note))
    async with faults.on(note, at="admit", drop=0.0):
        await note.ask(Step(0))


@pytest.mark.parametrize("schedule", ["seed=3", "seed=3 turn=1:1", "seed=3 hold=2:1", "seed=3 turn=1:1,3:1"])
def test_a_schedule_that_the_test_has_may_pass(schedule) -> None:
    simulate(right, replay=schedule)()


@pytest.mark.parametrize(
    ("test", "schedule", "why"),
    [
        (right, "turn=1:1,5000:1", r"turn=5000:1 was not come to, for the run has \d+ such choices$"),
        (right, "hold=5000:1", r"hold=5000:1 was not come to, for the run has \d+ such choices$"),
        (right, "turn=1:90", r"turn=1:90 is not among the options there, and \d was taken$"),
        (right, "hold=1:90", r"hold=1:90 is not among the options there, and \d was taken$"),
        (right, "turn=1:1 hold=2:1", r"hold=2:1 is not among the options there, and 0 was taken$"),
        (right, "fault=1:1", r"fault=1:1 was not come to, for the run has 0 such choices$"),
        (right, "delay=1:1", r"delay=1:1 was not come to, for the run has 0 such choices$"),
        (with_faults, "fault=7:1", r"fault=7:1 was not come to, for the run has \d such choices$"),
    ],
)
def test_a_schedule_of_another_run_is_an_error_that_says_what_differs(test, schedule, why) -> None:
    with pytest.raises(UnfitSchedule, match=why) as raised:
        simulate(test, replay=f"seed=3 {schedule}")()
    assert f"'seed=3 {schedule}' is of another run than this one, which has passed" in str(raised.value)


def test_a_file_that_is_of_another_test_fails_it(pytester: pytest.Pytester) -> None:
    tests = """
from holdfast.testing import simulate

@simulate(seeds=20)
async def test_other(system):
    assert await system.spawn(hf.start(Counter)).ask(Add(1)) == 1
"""
    (pytester.path / "schedule.txt").write_text("seed=5 hold=1:1,5:1,800:1\n", encoding="utf-8")
    result = run_suite(pytester, HEAD + tests, "--holdfast-replay", "schedule.txt")
    result.assert_outcomes(failed=1)
    result.stdout.re_match_lines([r".*UnfitSchedule: .*hold=800:1 was not come to, for the run has \d+ such choices.*"])


def test_a_run_that_fails_tells_its_own_failure_and_schedule() -> None:
    async def wrong(system: GuardedSystem) -> None:
        await right(system)
        raise LookupError("of its own")

    with pytest.raises(LookupError, match="of its own") as raised:
        simulate(wrong, replay="seed=3 hold=5000:1")()
    [note] = raised.value.__notes__
    assert re.search(r'@simulate\(replay="seed=3"\)', note)


FAILS = """
from holdfast.testing import simulate

@simulate(seeds=3)
async def test_it(system):
    assert await system.spawn(hf.start(Counter)).ask(Add(1)) == 2
"""


FAILS_IN_A_FLEET = """
from holdfast.testing import simulate

async def main(program):
    async with program.open() as system:
        await system.start(hf.child("counter", hf.start(Counter)))
        await asyncio.Event().wait()

@simulate(seeds=3)
async def test_it(fleet):
    fleet.start(main)
    async with hf.connect(fleet.servers(), timeout=60.0) as connection:
        assert await connection.ref("/app/counter", Counter).ask(Add(1)) == 2
"""


@pytest.mark.parametrize(("tests", "address"), [(FAILS, r"/app/\$\w+-1"), (FAILS_IN_A_FLEET, "program 1:/app/counter")])
def test_what_is_known_of_a_failure_is_kept_where_it_is_asked_for(
    pytester: pytest.Pytester, tests: str, address: str
) -> None:
    result = run_suite(pytester, HEAD + tests, "--holdfast-record", "artefacts")
    assert result.ret == 1
    (folder,) = (pytester.path / "artefacts").iterdir()
    assert sorted(file.name for file in folder.iterdir()) == ["chart.html", "failure.txt", "schedule.txt"]
    schedule = (folder / "schedule.txt").read_text("utf-8").partition(" hash=")[0]
    told = (folder / "failure.txt").read_text("utf-8").splitlines()
    assert told[0].endswith("::test_it")
    assert "AssertionError" in told[1]
    assert any(line.startswith("seed=0: repeat it with") for line in told)
    assert re.fullmatch(rf".*\t{address}\tAdd\(n=1\)\ttotal: 0 -> 1", told[-1])
    again = run_suite(pytester, HEAD + tests, "--holdfast-replay", str(folder / "schedule.txt"))
    assert again.ret == 1
    assert f'replay="{schedule}"' in str(again.stdout)


def test_where_nothing_fails_nothing_is_kept(pytester: pytest.Pytester) -> None:
    assert run_suite(pytester, HEAD + FAILS.replace("== 2", "== 1"), "--holdfast-record", "artefacts").ret == 0
    assert not (pytester.path / "artefacts").exists()


KNOWS_ITS_PROCESS = """
import os
from holdfast.testing import simulate

@simulate(seeds=20)
async def test_order(system):
    assert os.environ["MENDED"] or min({"anna", "bert", "carl", "dora"}, key=hash) != "FIRST"
"""


def under(pytester: pytest.Pytester, seed: str, *args: str, mended: str = "") -> pytest.RunResult:
    """The same suite in a process whose strings have other hashes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONHASHSEED", seed)
        patch.setenv("MENDED", mended)
        return pytester.runpytest_subprocess("-p", "no:randomly", *args)


def suite_that_fails_under_seed_1(pytester: pytest.Pytester) -> None:
    program = 'print(min({"anna", "bert", "carl", "dora"}, key=hash))'
    first = {
        seed: subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "PYTHONHASHSEED": seed}, check=True, capture_output=True
        ).stdout.decode()
        for seed in ("1", "2")
    }
    assert first["1"] != first["2"]
    run_suite(pytester, HEAD + KNOWS_ITS_PROCESS.replace("FIRST", first["1"].strip()), "--collect-only")


def test_a_schedule_is_repeated_under_its_hash_seed_only(pytester: pytest.Pytester) -> None:
    suite_that_fails_under_seed_1(pytester)
    failed = under(pytester, "1", "--holdfast-record", "artefacts", "-p", "no:cacheprovider")
    failed.assert_outcomes(failed=1)
    failed.stdout.fnmatch_lines(["*under PYTHONHASHSEED=1", "*repeat it: PYTHONHASHSEED=1 pytest --holdfast-replay *"])
    (folder,) = (pytester.path / "artefacts").iterdir()
    assert (folder / "schedule.txt").read_text("utf-8") == "seed=0 hash=1\n"
    replay = "--holdfast-replay", str(folder / "schedule.txt")
    under(pytester, "1", *replay).assert_outcomes(failed=1)
    refused = under(pytester, "2", *replay)
    refused.assert_outcomes(failed=1)
    refused.stdout.re_match_lines([r".*OtherHashSeed: .*Run PYTHONHASHSEED=1 pytest --holdfast-replay .*::test_order'"])
    (folder / "schedule.txt").write_text("seed=0 hash=random\n", "utf-8")
    told = under(pytester, "2", *replay)
    told.assert_outcomes(passed=1, warnings=1)
    told.stdout.fnmatch_lines(["*PassesElsewhere: the schedule 'seed=0 hash=random', which has failed*"])


def test_a_kept_failure_that_passes_under_another_hash_seed_stays(pytester: pytest.Pytester) -> None:
    suite_that_fails_under_seed_1(pytester)
    under(pytester, "1").assert_outcomes(failed=1)
    under(pytester, "2").assert_outcomes(passed=1, warnings=1)
    other = under(pytester, "2")
    other.assert_outcomes(passed=1, warnings=1)
    other.stdout.fnmatch_lines(["*PassesElsewhere: *stays kept: run PYTHONHASHSEED=1 pytest '*::test_order'"])
    under(pytester, "1").assert_outcomes(failed=1)
    under(pytester, "1", mended="yes").assert_outcomes(passed=1)
    under(pytester, "2").assert_outcomes(passed=1)


TELLS_ITS_SEEDS = """
from pathlib import Path
from holdfast.testing import simulate

@simulate(seeds=5)
async def test_seeds(system, simulation):
    with Path("seeds.txt").open("a") as file:
        print(simulation.seed, file=file)
    assert simulation.seed != 3
"""


def seeds_run(pytester: pytest.Pytester, *args: str) -> list[int]:
    """The seeds of a run of the suite, in their order."""
    pytester.runpytest_inprocess("-p", "no:randomly", "-W", "ignore:the schedule", *args)
    file = pytester.path / "seeds.txt"
    seeds = [int(line) for line in file.read_text("utf-8").splitlines()]
    file.unlink()
    return seeds


def test_what_has_failed_is_tried_first_until_it_passes(pytester: pytest.Pytester) -> None:
    run_suite(pytester, HEAD + TELLS_ITS_SEEDS, "--collect-only")
    assert seeds_run(pytester)[:3] == [0, 0, 1]
    assert {*seeds_run(pytester)} == {3}
    pytester.makepyfile(HEAD + TELLS_ITS_SEEDS.replace("!= 3", ">= 0"))
    assert seeds_run(pytester)[:4] == [3, 0, 0, 1]
    assert seeds_run(pytester)[:3] == [0, 0, 1]


@pytest.mark.parametrize(
    ("args", "count", "twice"),
    [
        ((), 5, 10),
        (("--holdfast-profile", "ci"), 5, 10),
        (("--holdfast-profile", "nightly"), 125, 1),
        (("--holdfast-twice", "2"), 5, 2),
        (("--holdfast-profile", "nightly", "--holdfast-seeds", "5", "--holdfast-twice", "3"), 5, 3),
    ],
    ids=["none", "ci", "nightly", "twice", "all"],
)
def test_a_profile_has_its_number_of_seeds_and_of_runs_made_twice(
    pytester: pytest.Pytester, args: tuple[str, ...], count: int, twice: int
) -> None:
    run_suite(pytester, HEAD + TELLS_ITS_SEEDS.replace("!= 3", ">= 0"), "--collect-only")
    expected = [seed for seed in range(count) for _ in range(1 + (seed % twice == 0))]
    assert seeds_run(pytester, *args) == expected
