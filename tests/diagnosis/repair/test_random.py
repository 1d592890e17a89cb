"""Random faults, one to three at a time: each run ends in time, repaired or given up, and nobody else is touched."""

import random

import pytest

import holdfast as hf
from holdfast.diagnosis.repair import GaveUp, Policy, Repaired
from tests.diagnosis.repair.simulated import World, scene

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

RUNS = 12
"""Of each number of faults."""
VISIBLE = ("hm", "hn", "in", "jn", "jtn")
"""Nodes whose silence is seen."""
POLICY = Policy(attempts=3, verify=6.0, settle=1.0, cool_down=0.5, rounds=20, seconds=300.0)


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
            world.on.discard(whom)
        case _:
            world.running.discard(whom)
    if kind in ("dead", "broken"):
        world.dead.add(whom)
    if kind == "flaky":
        world.flaky.add(whom)


@pytest.mark.parametrize("seed", range(RUNS))
@pytest.mark.parametrize("count", [1, 2, 3])
async def test_random_faults(count: int, seed: int) -> None:
    draw = random.Random(1000 * count + seed)
    async with hf.ActorSystem("t", log=False, seed=seed) as system:
        here = await scene(system, POLICY)
        await here.rest(1.0)
        assert here.done() == []
        faults: dict[str, str] = {}
        while len(faults) < count:
            kind, whom = draw.choice(faults_of(here.world))
            faults.setdefault(whom, kind)
        for whom, kind in faults.items():
            here.change(lambda world, kind=kind, whom=whom: strike(world, kind, whom))
        await here.rest()  # fails when it does not come to an end
        beyond = {whom for whom, kind in faults.items() if kind in ("dead", "broken")}
        given_up = {name for one in here.all(GaveUp) for name in one.components}
        assert here.touched() <= here.suspected(), faults
        if beyond:
            assert beyond <= given_up, (faults, here.told)
            assert all(one.why for one in here.all(GaveUp))
        else:
            assert here.all(Repaired), (faults, here.told)
            assert given_up == set(), (faults, here.told)
            assert here.world.is_healthy(), faults
        # What is lost for good takes nobody else with it, but for those that need it: nobody can tell how they are.
        for name, component in here.world.model.components.items():
            needs = {name, *component.on}
            fed = all(here.world.is_ok(topic) for inputs in component.out.values() for topic in inputs)
            if component.kind.value != "H" and fed and beyond.isdisjoint(needs) and name not in given_up:
                assert here.world.serves(name), (name, faults)


@pytest.mark.parametrize("seed", range(6))
async def test_if_all_is_seen_only_the_faulty_are_touched(seed: int) -> None:
    # No ambiguity: what stands still is seen to.
    draw = random.Random(seed)
    async with hf.ActorSystem("t", log=False, seed=seed) as system:
        here = await scene(system, POLICY)
        chosen = draw.sample([*here.world.hardware, *here.world.nodes], 3)
        for name in chosen:
            here.change(lambda world, name=name: strike(world, "off" if name in world.hardware else "stopped", name))
        await here.rest()
        dependents = {n for n, needed in here.world.drives.items() if not set(needed).isdisjoint(chosen)}
        assert here.touched() <= {*chosen, *dependents}
        assert {*chosen} <= here.touched()
        assert here.world.is_healthy()
