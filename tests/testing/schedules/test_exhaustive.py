"""The exhaustive search finds whatever any order of steps comes to, in far fewer schedules, and says what it covers."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, simulate
from holdfast.testing.schedules.choices import Choices, Keys
from holdfast.testing.schedules.reduction.search import SEED
from holdfast.testing.schedules.strategies import Strategy, strategy
from holdfast.testing.simulation import NotExhausted, ScheduleSearch, SimulationSettings, run_schedule
from tests.testing.schedules.planted import PLANTED, Account, Adder, Get, Work, order_of
from tests.testing.schedules.small_programs import FEW, MANY, Program, two_locks, two_lost_updates

OWN = {"system"}
IS_CROSSED = "HOLDFAST_CROSSED" in os.environ
MOST = 10_000


class EachOrder(Choices):
    """A run that goes as the ones before up to a point, and takes another option there."""

    def __init__(self, path: list[list[int]]) -> None:
        super().__init__(SEED)
        self._path, self._is_over = path, False

    def choose(self, count: int, keys: Keys) -> int:
        if self._is_over:
            return 0
        if self.steps > len(self._path):
            self._path.append([0, count])
        return self._path[self.steps - 1][0]

    def end(self) -> None:
        self._is_over = True


class BruteForce:
    """Every order of steps, whatever they have to do with each other."""

    def __init__(self) -> None:
        self._path: list[list[int]] = []
        self._is_over = False

    def choices(self, seed: int) -> Choices | None:
        return None if self._is_over else EachOrder(self._path)

    def learn(self, choices: Choices, trace: object) -> None:
        path = self._path
        while path:
            path[-1][0] += 1
            if path[-1][0] < path[-1][1]:
                return
            path.pop()
        self._is_over = True

    def covered(self, runs: int) -> str:
        return ""


def outcomes(program: Program, tried: Strategy) -> tuple[set[object], int]:
    """What its runs come to, with what each actor has handled in which order, and how many runs there were."""
    found: set[object] = set()
    for number in range(MOST):
        choices = tried.choices(number)
        if choices is None:
            return found, number
        ends: list[object] = []

        async def test(system: GuardedSystem, ends: list[object] = ends) -> None:
            ends.append(await program(system))

        run = run_schedule(test, choices, OWN, {}, looks=False)
        tried.learn(choices, run.trace)
        found.add((str(ends), each_order(run)))
    raise AssertionError(f"more than {MOST} runs")


def each_order(run: Simulation) -> tuple[object, ...]:
    handled: dict[str, list[str]] = {}
    for path, what in run.trace:
        handled.setdefault(path, []).append(what)
    return tuple(sorted((path, tuple(what)) for path, what in handled.items()))


def search(test: Any, **settings: Any) -> ScheduleSearch:
    """An exhaustive search, at its end."""
    found = ScheduleSearch(test, OWN, SimulationSettings(strategy="exhaustive", **settings))
    found.run()
    return found


@pytest.mark.parametrize("program", FEW)
def test_it_finds_whatever_any_order_of_steps_comes_to(program: Program) -> None:
    every, runs = outcomes(program, BruteForce())
    found, fewer = outcomes(program, strategy("exhaustive"))
    assert found == every
    assert fewer <= runs


@pytest.mark.skipif(not IS_CROSSED, reason="a campaign of some thousand runs each: HOLDFAST_CROSSED=1")
@pytest.mark.parametrize("program", MANY)
def test_it_finds_in_few_runs_what_takes_thousands(program: Program) -> None:
    every, runs = outcomes(program, BruteForce())
    found, fewer = outcomes(program, strategy("exhaustive"))
    assert found == every
    assert 10 * fewer <= runs


def test_two_lost_updates_are_all_that_two_adders_can_do(capsys: pytest.CaptureFixture[str]) -> None:
    """Each reads before it writes: 4! / (2! 2!) = 6 orders at the account."""
    sums: set[object] = set()

    async def test(system: GuardedSystem) -> None:
        sums.add(await two_lost_updates(system))

    found = search(test, seeds=100)
    assert found.is_complete
    assert sums == {1, 2}
    assert found.runs == 6
    assert "all schedules: 6, complete" in capsys.readouterr().out


def three_adders(sums: set[int]) -> Any:
    async def test(system: GuardedSystem) -> None:
        account = system.spawn(hf.start(Account), "account")
        adders = [system.spawn(hf.start(Adder), f"adder{number}") for number in range(3)]
        await asyncio.gather(*(adder.ask(Work(account)) for adder in adders))
        sums.add(await account.ask(Get()))

    return test


@pytest.mark.skipif(not IS_CROSSED, reason="a campaign of 200 runs: HOLDFAST_CROSSED=1")
def test_three_adders_end_and_come_to_all_three_sums() -> None:
    """6! / 2^3 = 90 orders at the account."""
    sums: set[int] = set()
    found = search(three_adders(sums), seeds=1000)
    assert found.is_complete
    assert sums == {1, 2, 3}
    assert 90 <= found.runs < 250


@pytest.mark.parametrize("name", ["lost_update", "lost_update_of_tasks"])
def test_a_loop_that_only_waits_multiplies_nothing(name: str) -> None:
    """Of the rounds of `sleep(0)`, in which anything else may happen, only that counts which is done behind them."""

    async def passes(system: GuardedSystem) -> None:
        try:
            await PLANTED[name](system)
        except AssertionError:
            pass

    found = search(passes, seeds=100)
    assert found.is_complete
    assert found.runs < 40


def test_schedules_that_differ_only_in_what_has_nothing_to_do_with_each_other_sleep() -> None:
    """Sleep sets: without them two locks of two take more runs than there are kinds of schedule."""
    assert outcomes(two_locks, strategy("exhaustive"))[1] < 60


@pytest.mark.parametrize(("holds", "runs"), [(0, 1), (1, 4), (3, 20)])
def test_a_bound_is_what_it_covers(holds: int, runs: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Three who tell come in reverse only if three times somebody is held up."""
    reverse: list[bool] = []

    async def passes(system: GuardedSystem) -> None:
        try:
            await order_of(3)(system)
        except AssertionError:
            reverse.append(True)

    found = search(passes, seeds=100, holds=holds)
    assert found.is_complete
    assert found.runs == runs
    assert any(reverse) == (holds == 3)
    word = "hold" if holds == 1 else "holds"
    assert f"all schedules with at most {holds} {word}: {runs}, complete" in capsys.readouterr().out


BOUNDED = {"lost_update": 1, "deadlock_of_2": 1, "stale_ref": 1, "deadlock_of_3": 2}


@pytest.mark.parametrize("name", [name for name, holds in BOUNDED.items() if holds == 1 or IS_CROSSED])
def test_a_bound_finds_what_few_delays_show(name: str) -> None:
    with pytest.raises((AssertionError, hf.HoldfastError)) as caught:
        simulate(PLANTED[name], strategy="exhaustive", holds=BOUNDED[name])()
    assert "shrunk to" in "".join(caught.value.__notes__)


def test_a_bounded_search_that_is_cut_short_says_what_it_has_covered() -> None:
    told = (
        "20 schedules were tried, all with at most 1 hold, and there are more with 2 holds: raise seeds=, lower holds="
    )
    with pytest.warns(NotExhausted, match=told):
        simulate(PLANTED["order_of_5"], strategy="exhaustive", holds=4, seeds=20)()


@pytest.mark.parametrize("settings", [{"holds": -1}, {"holds": True}, {"holds": 1, "strategy": "mixed"}])
def test_a_bound_that_cannot_be_is_refused(settings: dict[str, Any]) -> None:
    given: dict[str, Any] = {"strategy": "exhaustive", **settings}
    with pytest.raises(hf.SpecError, match="holds must be 0 or more"):
        simulate(PLANTED["lost_update"], **given)
