"""A plan meets a world that has changed since it was made; diagnoses play no part here."""

import asyncio

import pytest

from holdfast.diagnosis.literals import Literal, on
from holdfast.diagnosis.planning import Plan, Step, repair_domain, repair_problem
from holdfast.diagnosis.repair import DONE, SKIPPED, Act, RepairAction
from holdfast.diagnosis.repair.executor import Executor, Result
from holdfast.supervision.arbiter import Arbiter

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

PLAN = Plan(((Step("power_up", ("hu",)), Step("power_up", ("ja",))), (Step("start_node", ("hn",)),)))


class Seen:
    """What is observed: nothing, until it is put here."""

    def __init__(self) -> None:
        self.words: dict[Literal, tuple[bool, float]] = {}
        self.begun: list[tuple[float, str]] = []

    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def seen(self, atom: Literal) -> tuple[bool | None, float]:
        return self.words.get(atom, (None, float("-inf")))

    async def changed(self) -> None:
        await asyncio.sleep(0.1)

    def overtaken(self, step: Step) -> str:
        return ""

    async def approve(self, step: Step) -> str:
        return ""

    async def began(self, step: Step, epoch: int) -> None:
        self.begun.append((self.now(), str(step)))

    async def ended(self, result: Result) -> None:
        pass


async def carry_out(seen: Seen, *, takes: float = 1.0) -> list[Result]:
    async def run(act: Act, name: str) -> None:
        await asyncio.sleep(takes)
        if act.step.action == "power_up" and on(name) in seen.words:
            seen.words[on(name)] = True, seen.now()

    problem = repair_problem(
        repair_domain(),
        hardware=["hu", "ja"],
        nodes=["hn"],
        drives={"hn": ["hu"]},
        bad=["hu", "ja", "hn"],
    )
    executor = Executor(
        seen,
        Arbiter(seen.now),
        address=str,
        actions=lambda name: RepairAction(name, run),
        make=lambda step, epoch, reason, check: Act(step, epoch, reason, None, check),  # type: ignore[arg-type]
        reason="a test",
    )
    return await executor.execute(problem, PLAN)


async def test_steps_of_a_stage_are_done_at_the_same_time() -> None:
    seen = Seen()
    results = await carry_out(seen)
    assert [one.outcome for one in results] == [DONE] * 3
    times = {step: when for when, step in seen.begun}
    assert times["power_up(hu)"] == times["power_up(ja)"]
    assert times["start_node(hn)"] - times["power_up(hu)"] == pytest.approx(1.0)


async def test_a_precondition_is_checked_against_what_is_observed_now() -> None:
    # T60: somebody has switched ja on since the plan was made.
    seen = Seen()
    seen.words[on("ja")] = True, seen.now()
    results = await carry_out(seen)
    assert [(str(one.step), one.outcome, one.why) for one in results] == [
        ("power_up(hu)", DONE, ""),
        ("power_up(ja)", SKIPPED, "on(ja) is so"),
        ("start_node(hn)", DONE, ""),
    ]


async def test_an_old_word_does_not_undo_what_was_seen_since() -> None:
    # What the plan has made, and was observed, outweighs what was said before.
    seen = Seen()
    seen.words[on("hu")] = False, seen.now()
    results = await carry_out(seen)
    assert [one.outcome for one in results] == [DONE] * 3
