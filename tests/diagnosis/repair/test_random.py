"""The closed loop under random faults, one to three at a time, from the observers to what they see after the repair.

A thousand runs, what became of them, and how long each kind of fault took:

    HOLDFAST_RUNS=1000 pytest -s -p no:xdist -o faulthandler_timeout=3600 tests/diagnosis/repair/test_random.py
"""

import os
import random
import statistics
from collections import defaultdict
from collections.abc import Iterator

import pytest

import holdfast as hf
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.repair import ActionEnded, GaveUp, Planned, Policy, Repaired
from tests.diagnosis.repair.simulated import Scene, World, now, scene

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

RUNS = int(os.environ.get("HOLDFAST_RUNS", "15"))
IS_LONG = "HOLDFAST_RUNS" in os.environ
VISIBLE = ("hm", "hn", "in", "jn", "jtn")
"""Nodes whose silence is seen."""
POLICY = Policy(attempts=3, verify=6.0, settle=1.0, cool_down=0.5, rounds=20, seconds=300.0)
BUDGET = POLICY.seconds + 30.0
"""Seconds for a case, with its last plan."""
NOISE = 0.3
"""Messages come early, late, and now and then not at all (T52)."""
BEYOND = ("dead", "broken")
"""Faults that nothing can be done about."""


def faults_of(world: World) -> list[tuple[str, str]]:
    """Every fault there is: its kind and whom it strikes."""
    found = [(kind, h) for h in world.hardware for kind in ("off", "dead")]
    found += [("hung", h) for h in ("ja", "hu")]  # nobody would see that of la
    found += [(kind, n) for n in world.nodes for kind in ("stopped", "flaky", "broken")]
    return found + [("hung", n) for n in VISIBLE]


def strike(world: World, kind: str, whom: str) -> None:
    """Let one fault happen."""
    match kind:
        case "hung":
            world.hung.add(whom)
        case "off" | "dead":
            world.switch(whom, False)
        case _:
            world.running.discard(whom)
    if kind in BEYOND:
        world.dead.add(whom)
    if kind == "flaky":
        world.flaky.add(whom)


def strike_all(world: World, faults: dict[str, str]) -> None:
    """Let them happen at once."""
    for whom, kind in faults.items():
        strike(world, kind, whom)


def drawn(world: World, draw: random.Random, count: int) -> dict[str, str]:
    """So many components, each with its fault."""
    faults: dict[str, str] = {}
    while len(faults) < count:
        kind, whom = draw.choice(faults_of(world))
        faults.setdefault(whom, kind)
    return faults


async def struck(here: Scene, faults: dict[str, str]) -> float:
    """Let them happen at once, and wait until repair has done what it can. Returns when they struck."""
    await here.rest(2.0)
    assert here.done() == []
    began = now()
    await here.change(lambda world: strike_all(world, faults))
    await here.rest(most=4 * BUDGET)  # fails when it does not come to an end
    return began


def check(here: Scene, faults: dict[str, str]) -> None:
    """Repaired, or given up aloud, within the budget; and nobody was touched without being blamed."""
    told = (faults, here.told)
    beyond = {whom for whom, kind in faults.items() if kind in BEYOND}
    given_up = {name for one in here.all(GaveUp) for name in one.components}
    took = [*(one.seconds for one in here.all(Repaired)), *(one.seconds for one in here.all(GaveUp))]
    assert max(took) <= BUDGET, told
    assert all(one.why for one in here.all(GaveUp)), told
    if beyond:
        assert beyond <= given_up, told
    else:
        assert here.all(Repaired), told
        assert given_up == set(), told
        assert here.world.is_healthy(), told
    check_touched(here)
    # What is lost for good takes nobody else with it, but for those that need it: nobody can tell how they are.
    for name, component in here.world.model.components.items():
        needs = {name, *component.on}
        fed = all(here.world.is_ok(topic) for inputs in component.out.values() for topic in inputs)
        is_seen = component.kind.value != "H" and (name not in here.world.channels or not hidden(here, name, given_up))
        if is_seen and fed and beyond.isdisjoint(needs) and name not in given_up:
            assert here.world.serves(name), (name, *told)


def hidden(here: Scene, device: str, given_up: set[str]) -> bool:
    """Whether a device that hangs cannot be told from one that works: nobody is left who would show it."""
    drivers = [node for node, needed in here.world.drives.items() if device in needed]
    return device in here.world.hung and given_up.issuperset(drivers)


def check_touched(here: Scene) -> None:
    """Each plan acts upon a diagnosis that there was, and touches nobody else, but for who drives what it blames."""
    candidates: set[tuple[str, ...]] = set()
    allowed: set[str] = set()
    for one in here.told:
        if isinstance(one, Diagnosis):
            candidates |= {candidate.bad for candidate in one.candidates}
        if isinstance(one, Planned):
            assert one.bad in candidates, (one, here.told)
            drivers = {node for node, needed in here.world.drives.items() if not {*one.bad}.isdisjoint(needed)}
            allowed |= {*one.bad, *drivers}
            assert {step.args[0] for stage in one.stages for step in stage} <= allowed, one
    assert here.touched() <= allowed, here.told


class Results:
    """What became of all runs, by the kind of fault."""

    def __init__(self) -> None:
        self.took: dict[str, list[float]] = defaultdict(list)
        self.ends: dict[str, list[bool]] = defaultdict(list)
        self.actions = self.innocent = 0

    def add(self, here: Scene, faults: dict[str, str], began: float) -> None:
        """One more."""
        kinds = next(iter(faults.values())) if len(faults) == 1 else f"{len(faults)} faults"
        self.ends[kinds].append(not here.all(GaveUp))
        if here.all(Repaired):
            self.took[kinds].append(here.time_of(here.all(Repaired)[-1]) - began)
        self.actions += len(here.all(ActionEnded))
        self.innocent += sum(one.step.args[0] not in faults for one in here.all(ActionEnded))

    def __str__(self) -> str:
        lines = [f"{'fault':<12}{'runs':>6}{'repaired':>10}{'mean':>9}{'worst':>9}"]
        for kinds, good in sorted(self.ends.items()):
            mean, worst = statistics.fmean(self.took[kinds] or [0.0]), max(self.took[kinds], default=0.0)
            lines.append(f"{kinds:<12}{len(good):>6}{sum(good):>10}{mean:>7.1f} s{worst:>7.1f} s")
        lines.append(f"{self.actions} actions, {self.innocent} of them on a component that was not struck: it drives a")
        lines.append("device that was, or was as likely by all that was seen. All others were given up aloud.")
        return "\n".join(lines)


@pytest.fixture(scope="module")
def results() -> Iterator[Results]:
    made = Results()
    yield made
    if IS_LONG:
        print(f"\n{made}")


@pytest.mark.parametrize("run", range(RUNS))
async def test_random_faults(run: int, results: Results) -> None:
    # T56, T62, T66
    draw, count = random.Random(run), run % 3 + 1
    async with hf.ActorSystem("t", log=False, seed=run) as system:
        here = await scene(system, POLICY, noise=NOISE)
        faults = drawn(here.world, draw, count)
        began = await struck(here, faults)
        check(here, faults)
        results.add(here, faults, began)


@pytest.mark.parametrize("seed", range(6))
async def test_if_all_is_seen_only_the_faulty_are_touched(seed: int) -> None:
    # No ambiguity: what stands still is seen to.
    draw = random.Random(seed)
    async with hf.ActorSystem("t", log=False, seed=seed) as system:
        here = await scene(system, POLICY)
        chosen = draw.sample([*here.world.hardware, *here.world.nodes], 3)
        await struck(here, {name: "off" if name in here.world.channels else "stopped" for name in chosen})
        dependents = {n for n, needed in here.world.drives.items() if not set(needed).isdisjoint(chosen)}
        assert here.touched() <= {*chosen, *dependents}
        assert {*chosen} <= here.touched()
        assert here.world.is_healthy()


async def test_no_false_alarm_in_a_healthy_hour() -> None:
    # T52
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        here = await scene(system, POLICY, pace=1.0 if IS_LONG else 20.0, noise=NOISE)
        began = now()
        await here.rest(3600.0, 3700.0)
        assert now() - began >= 3600.0
        assert [one.state for one in here.all(Diagnosis)] == [State.HEALTHY]
        assert here.told == here.all(Diagnosis)
