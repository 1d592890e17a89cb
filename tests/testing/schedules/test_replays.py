"""A schedule that is to be repeated fits its test, or the test fails: what passed would be another run."""

import re

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
