"""Whether topics flow as they did: more is no fault, less input is no fault, but silence may be one."""

import asyncio
import random
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis import GRACE, OBSERVATIONS, Grace, observer
from holdfast.diagnosis.literals import Literal, ok
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Baselines, FlowObserver, Manner
from holdfast.diagnosis.observers.flow import ENOUGH, FlowSource, Usual, _Flow

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

MADE = {"/in": FlowSource(()), "/out": FlowSource(("/t/filter",), ("/in",))}


class Item(hf.Message):
    number: int


class Each(hf.Message):
    each: int


class Tick(hf.Message):
    pass


class Sensor(hf.Actor):
    """Publishes in the turns of a timer of its own, with a hiccup now and then."""

    def __init__(self) -> None:
        self.each, self.count = 1, 0

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.01, Tick())

    @hf.on(Each)
    def set(self, message: Each) -> None:
        self.each = message.each

    @hf.on(Tick)
    async def tick(self, message: Tick) -> None:
        if self.each:
            self.count += 1
            if self.count % 40 == 0:
                await asyncio.sleep(0.3)
            await self.ctx.publish("/out", Item(self.count))


class Question(hf.Message[int]):
    pass


class Oracle(hf.Actor):
    """Thinks long."""

    @hf.on(Question)
    async def answer(self, message: Question) -> int:
        await asyncio.sleep(3.0)
        return 42


class Filter(hf.Actor):
    """Publishes each `each`-th, after so many seconds."""

    def __init__(self) -> None:
        self.each, self.count, self.seconds = 2, 0, 0.0
        self.oracle: hf.ActorRef[Oracle] | None = None

    @hf.on(Each)
    def set(self, message: Each) -> None:
        self.each = message.each

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        if self.seconds:
            await asyncio.sleep(self.seconds)
        if self.oracle is not None:
            await self.oracle.ask(Question())
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
        self.bad = Counter[Literal]()

    async def send(self, count: int, pause: float, burst: int = 1, rng: random.Random | None = None) -> None:
        """Publish what comes in, and note whether anything bad is said."""
        for number in range(count):
            for _ in range(burst):
                await self.system.publish("/in", Item(number))
                self.filter.tell(Item(number))
            await asyncio.sleep(pause * (rng.uniform(0.2, 1.8) if rng is not None else 1.0))
            self.bad.update(atom for atom, good in self.said.items() if not good)

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
    assert not world.bad
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


@pytest.mark.parametrize("how", ["it is started again", "it is started again soon", "it goes on by itself"])
async def test_a_silence_that_was_a_fault_is_found_again(how: str) -> None:
    """Of those that end by themselves the first two are no measure; then they are usual."""
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        source = await system.start(hf.child("filter", hf.start(Filter)))
        made = {"/out": FlowSource((source.path,))}
        await system.start(observer("topics", hf.start(FlowObserver, made, leave_out=(OBSERVATIONS,))))

        async def flow() -> None:
            for number in range(200):
                source.tell(Item(number))
                await asyncio.sleep(0.05)

        await flow()
        for _ in range(3 if how == "it goes on by itself" else 2):
            assert said[ok("/out")] is True
            if how == "it is started again soon":
                await asyncio.sleep(1.8)
                await system.ref("/t", hf.Supervisor).ask(hf.RestartChild("filter", running=True))
                await flow()
            await asyncio.sleep(5.0)
            assert said[ok("/out")] is False
            if how == "it is started again":
                await system.ref("/t", hf.Supervisor).ask(hf.RestartChild("filter", running=True))
            await flow()
        await asyncio.sleep(5.0)
        assert (said.get(ok("/out")) is False) is (how != "it goes on by itself")


@pytest.mark.parametrize(("known", "is_enough"), [(30, False), (400, True)])
async def test_the_more_is_known_the_less_has_to_come_in_until_silence_is_a_fault(
    world: World, known: int, is_enough: bool
) -> None:
    await world.set_each(1)
    await world.send(known, 0.1)
    await world.set_each(0)
    await world.send(7, 1.0)
    assert (world.said.get(ok("/out")) is False) is is_enough
    await world.send(8, 1.0)
    assert world.said[ok("/out")] is False


async def test_behind_a_pause_it_is_silent_from_when_something_comes_in(world: World) -> None:
    await world.set_each(1)
    await world.send(400, 0.1)
    await asyncio.sleep(5.0)
    world.filter._cell.actor.seconds = 1.5  # type: ignore[union-attr]
    for _ in range(30):
        await world.send(1, 0.0)
    await world.send(5, 0.2)
    assert ok("/out") not in world.bad


async def test_who_is_missed_by_what_has_come_is_so_however_long_that_pauses(world: World) -> None:
    rng = random.Random(1)
    await world.set_each(1)
    await world.send(40, 1.5, burst=20, rng=rng)
    await world.set_each(0)
    await world.send(10, 1.0, burst=20)
    await asyncio.sleep(30.0)
    assert world.said == {ok("/in"): True, ok("/out"): False}


async def test_who_waits_for_a_reply_is_silent_by_that(world: World) -> None:
    await world.set_each(1)
    await world.send(400, 0.1)
    world.filter._cell.actor.oracle = world.system.spawn(hf.start(Oracle))  # type: ignore[union-attr]
    await world.send(80, 0.1)
    assert not world.bad


async def test_a_burst_however_large_has_no_rhythm() -> None:
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        arrivals = [("/in", asyncio.get_running_loop().time())] * 100
        start = hf.start(FlowObserver, MADE, leave_out=(OBSERVATIONS,), arrivals=arrivals)
        await system.start(observer("topics", start))
        await asyncio.sleep(60.0)
        assert said.get(ok("/in")) is None


async def test_of_a_topic_of_which_half_is_lost_too_little_goes_out(world: World) -> None:
    await world.send(600, 0.05)
    assert world.said[ok("/out")]
    await world.set_each(5)
    await world.send(200, 0.05)
    assert world.said[ok("/out")] is False
    await world.set_each(2)
    await world.send(120, 0.05)
    assert world.said[ok("/out")]


async def test_a_burst_that_is_larger_than_ever_and_is_worked_off_slowly_is_no_fault(world: World) -> None:
    await world.send(600, 0.05)
    world.filter._cell.actor.seconds = 0.05  # type: ignore[union-attr]
    await world.send(6, 0.3, burst=60)
    await asyncio.sleep(60.0)
    await world.send(600, 0.1)
    assert ok("/out") not in world.bad


async def test_a_block_of_which_less_goes_out_now_and_then_is_learned_and_two_in_a_row_are_not() -> None:
    flow, learned = _Flow(0.0), Usual()

    def block(goes_out: int) -> bool:
        flow.in_block, flow.out_of_block = 50, goes_out
        flow.end_block(learned)
        return flow.poor > 1

    assert not any(block(out) for out in (*[25] * 10, 11, 25, 25, 25))
    assert (block(5), block(5), learned.least_out) == (False, True, 0.22)
    assert not any(block(out) for out in (25, 5, 25, 25, 25, 5, 5, 5))
    assert learned.least_out == 0.1


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_source_in_a_process_that_has_turns_and_publishes_nothing_is_seen(recovery: Any) -> None:
    """It goes by no clock, and nobody else publishes what it is made from."""
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        spec = hf.child("filter", hf.start(Filter), isolation="process", recovery=recovery)
        source = await system.start(spec)
        made = {"/out": FlowSource((source.path,))}
        manner = Manner(every=0.05)
        start = hf.start(FlowObserver, made, leave_out=(OBSERVATIONS,), patience=0.5, manner=manner)
        await system.start(observer("topics", start))
        async with asyncio.timeout(60.0):
            for each in (2, 0):
                await source.ask(Each(each))
                number = 0
                while said.get(ok("/out")) is not bool(each) or number < 100:
                    source.tell(Item(number := number + 1))
                    await asyncio.sleep(0.5 if number % 20 == 0 else 0.01)


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_sensor_of_which_only_the_timer_goes_on_is_seen(place: Any) -> None:
    """It went by no clock, so only its turns tell; in a process those are known there alone."""
    said: dict[Literal, bool] = {}
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        system.spawn(hf.start(Notes, said))
        sensor = await system.start(hf.child("sensor", hf.start(Sensor), isolation=place))
        made = {"/out": FlowSource((sensor.path,))}
        start = hf.start(FlowObserver, made, leave_out=(OBSERVATIONS,), patience=0.5, manner=Manner(every=0.05))
        await system.start(observer("topics", start))
        for each in (1, 0, 1):
            await sensor.ask(Each(each))
            async with asyncio.timeout(30.0):
                while said.get(ok("/out")) is not bool(each):
                    await asyncio.sleep(0.05)
            await asyncio.sleep(2.0 * each)  # Now it is known that it goes by no clock.


async def test_a_clock_that_had_one_hiccup_is_one_again_after_a_while_and_bursts_are_none(world: World) -> None:
    await world.send(50, 0.1)
    await asyncio.sleep(0.6)
    await world.send(200, 0.1)
    await asyncio.sleep(1.0)
    await world.send(20000, 0.1)
    assert not world.bad
    await asyncio.sleep(10.0)
    assert world.said[ok("/in")] is False


async def test_bursts_never_go_by_a_clock(world: World) -> None:
    for _ in range(20):
        await world.send(1000, 0.1)
        await asyncio.sleep(1.5)
    await asyncio.sleep(60.0)
    assert not world.bad
    assert ok("/in") not in world.said


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
        assert not world.bad
