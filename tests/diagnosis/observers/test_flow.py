"""Whether topics flow as they did: more is no fault, less input is no fault, but silence may be one."""

import asyncio
import random
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.diagnosis import GRACE, OBSERVATIONS, Grace, observer
from holdfast.diagnosis.literals import Literal, ok
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Baselines, FlowObserver
from holdfast.diagnosis.observers.flow import ENOUGH, FlowSource

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

MADE = {"/in": FlowSource(()), "/out": FlowSource(("/t/filter",), ("/in",))}


class Item(hf.Message):
    number: int


class Filter(hf.Actor):
    """Publishes each `each`-th."""

    def __init__(self) -> None:
        self.each, self.count = 2, 0

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        self.count += 1
        if self.each and self.count % self.each == 0:
            await self.ctx.publish("/out", message)


class Notes(hf.Actor):
    def __init__(self, said: dict[Literal, bool]) -> None:
        self._said = said

    @hf.subscribe(OBSERVATIONS)
    @hf.on(Observation)
    def note(self, message: Observation) -> None:
        atom = message.literal.atom
        if message.time_to_live:
            self._said[atom] = message.literal.positive
        else:
            self._said.pop(atom, None)


class World:
    """A filter, who looks at its topics, and what was said last."""

    def __init__(self, system: hf.ActorSystem, said: dict[Literal, bool]) -> None:
        self.system, self.said = system, said
        self.filter = system.spawn(hf.start(Filter), "filter")
        self.bad = 0

    async def send(self, count: int, pause: float, burst: int = 1, rng: random.Random | None = None) -> None:
        """Publish what comes in, and note whether anything bad is said."""
        for number in range(count):
            for _ in range(burst):
                await self.system.publish("/in", Item(number))
                self.filter.tell(Item(number))
            await asyncio.sleep(pause * (rng.uniform(0.2, 1.8) if rng is not None else 1.0))
            self.bad += not all(self.said.values())

    async def set_each(self, each: int) -> None:
        """From now on, so many go in for one that goes out; 0: none goes out."""
        self.filter._cell.actor.each = each  # type: ignore[union-attr]


@pytest.fixture
async def world() -> AsyncIterator[World]:
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        await system.start(observer("topics", hf.start(FlowObserver, MADE, leave_out=(OBSERVATIONS,))))
        await asyncio.sleep(0.5)
        yield World(system, said)


async def test_double_less_and_bursts_are_no_faults_and_silence_without_input_is_unknown(world: World) -> None:
    rng = random.Random(1)
    await world.send(600, 0.1)
    await world.send(600, 0.05)
    await world.send(200, 0.25, rng=rng)
    await world.send(40, 1.0, burst=50, rng=rng)
    await world.send(30, 2.0)
    await asyncio.sleep(60.0)
    assert world.bad == 0
    assert ok("/out") not in world.said


async def test_when_its_input_stops_a_regular_topic_is_unknown_and_one_that_went_by_a_clock_is_not(
    world: World,
) -> None:
    await world.send(100, 0.1)
    assert world.said[ok("/out")]
    await asyncio.sleep(30.0)
    assert world.said == {ok("/in"): False}


async def test_a_topic_that_is_dead_while_its_input_comes_is_not_ok_until_it_flows_again(world: World) -> None:
    await world.send(100, 0.1)
    await world.set_each(0)
    await world.send(60, 0.1)
    assert (world.said[ok("/in")], world.said[ok("/out")]) == (True, False)
    await world.set_each(2)
    await world.send(30, 0.1)
    assert world.said[ok("/out")]


@pytest.mark.parametrize("names", [("/elsewhere",), ("/in",)])
async def test_a_clock_that_has_stopped_is_seen_though_somebody_is_started_meanwhile(
    world: World, names: tuple[str, ...]
) -> None:
    """Each start gives grace, and those who crash again and again would hide what others do, or never did again."""
    await world.send(100, 0.1)
    await world.system.publish(GRACE, Grace(names, 1.0))
    await asyncio.sleep(15.0)
    assert world.said[ok("/in")] is False


async def test_of_a_topic_of_which_half_is_lost_too_little_goes_out(world: World) -> None:
    await world.send(1400, 0.05)
    assert world.said[ok("/out")]
    await world.set_each(5)
    await world.send(600, 0.05)
    assert world.said[ok("/out")] is False


async def test_what_was_learned_is_kept_by_the_hour_and_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "usual.json"
    kept = Baselines(path, by_hour=True)
    kept.of("/in", 0.0).take(0.5, 3)
    await kept.save()
    again = Baselines(path, by_hour=True)
    assert (again.of("/in", 0.0).longest_gap, again.of("/in", 0.0).most_in) == (0.5, 3)
    assert again.of("/in", 3600.0).count == 0
    path.write_bytes(b"{")
    with pytest.raises(ValueError, match=r"usual.json has no baselines .* remove it"):
        Baselines(path)


def heard(until: float) -> list[tuple[str, float]]:
    """What was heard before: one message in each tenth of a second, until a loop time."""
    return [("/in", until - number / 10) for number in range(2 * ENOUGH, 0, -1)]


async def test_what_was_heard_before_counts_as_learned_and_the_time_until_now_as_no_silence() -> None:
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        await asyncio.sleep(100.0)
        arrivals = heard(asyncio.get_running_loop().time() - 60.0)
        baselines = Baselines()
        start = hf.start(FlowObserver, MADE, leave_out=(OBSERVATIONS,), arrivals=arrivals, baselines=baselines)
        await system.start(observer("topics", start))
        await asyncio.sleep(1.0)
        assert not said
        assert not arrivals
        assert baselines.of("/in", 0.0).longest_gap == pytest.approx(0.1)
        await asyncio.sleep(3.0)
        assert said == {ok("/in"): False}


async def test_turns_that_nobody_saw_before_count_as_many_as_there_may_have_been() -> None:
    """A topic without inputs was silent for 12 seconds before; now its publisher has turns in such a silence."""
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        now = asyncio.get_running_loop().time()
        arrivals = [("/out", now - 60.0 + second) for second in (*range(ENOUGH), ENOUGH + 11)]
        made = {"/out": FlowSource(("/t/filter",))}
        start = hf.start(FlowObserver, made, leave_out=(OBSERVATIONS,), arrivals=arrivals)
        await system.start(observer("topics", start))
        world = World(system, said)
        await world.set_each(0)
        await world.send(120, 0.1)
        assert world.bad == 0
