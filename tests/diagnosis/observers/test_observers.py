"""Each kind of observer, in a running system, on the virtual clock."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis import GRACE, OBSERVATIONS, Grace, observer
from holdfast.diagnosis.board import BoardMeasured, Measurements, Reading
from holdfast.diagnosis.literals import ok
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import (
    Agreement,
    BinaryQualitativeObserver,
    Channel,
    Check,
    ConditionedObserver,
    DiagnosticObserver,
    GeneralObserver,
    HardwareObserver,
    Learned,
    Limits,
    Manner,
    Median,
    NodeObserver,
    Observer,
    QualitativeObserver,
    ScoreObserver,
    Source,
    TimeoutObserver,
    TriggeredObserver,
)
from holdfast.testing import Probe, advance, probe

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

QUICK = Manner(every=0.5)


class Value(hf.Message):
    x: float = 0.0
    key: int = 0


class Source_(hf.Actor):
    """Publishes what it is told, and knows nothing of observers."""

    @hf.on(Value)
    async def _idle(self, message: Value) -> None:
        await self.ctx.publish("/t", message)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


class Watched:
    """A system with an observer in it, and what that says."""

    def __init__(self, system: hf.ActorSystem, spec: hf.ChildSpec) -> None:
        self.system, self.spec = system, spec
        self.probe: Probe = probe(system)
        self.probe.subscribe(OBSERVATIONS)
        self.ref: Any = None

    async def begin(self) -> None:
        self.ref = await self.system.start(self.spec)
        await advance(0.0)

    async def publish(self, topic: str, message: hf.Message[Any]) -> None:
        await self.system.publish(topic, message)

    async def stream(
        self, topic: str, seconds: float, rate: float, make: Callable[[float], hf.Message[Any]] = lambda t: Value(t)
    ) -> None:
        """Publish at a rate."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while loop.time() < end - 1e-9:
            await self.publish(topic, make(loop.time()))
            await advance(1 / rate)

    def heard(self) -> list[Observation]:
        """What it has said since the last call."""
        heard = self.probe.waiting  # in order, without waiting
        self.probe._inbox.clear()
        return [one for one in heard if isinstance(one, Observation)]

    def changes(self) -> list[str]:
        """What it has said since the last call: without renewals; `unknown ...` if it has taken something back."""
        said: list[str] = []
        for one in self.heard():
            text = str(one.literal) if one.time_to_live > 0 else f"unknown {one.literal.atom}"
            if not said or said[-1] != text:
                said.append(text)
        return said


async def watch(system: hf.ActorSystem, kind: type[Observer], *args: Any, **kwargs: Any) -> Watched:
    watched = Watched(system, observer("o", hf.start(kind, *args, **kwargs)))
    await watched.begin()
    return watched


async def test_a_rate_is_good_silence_is_bad_and_too_much_is_bad(system: hf.ActorSystem) -> None:
    # D19: |f(t) - mean| < deviation over a window; polled, so that silence is seen
    seen = await watch(system, GeneralObserver, "/t", 10.0, 3.0, window=1.0, manner=QUICK)
    await seen.stream("/t", 0.5, 10)
    assert seen.changes() == []  # the first window is not over: unknown
    await seen.stream("/t", 2.5, 10)
    assert seen.changes() == ["ok(/t)"]
    await advance(3.0)
    assert seen.changes() == ["not ok(/t)"]
    await seen.stream("/t", 3.0, 10)
    assert seen.changes()[-1] == "ok(/t)"
    await seen.stream("/t", 2.0, 50)
    assert seen.changes()[-1] == "not ok(/t)"


async def test_what_was_counted_before_somebody_acted_says_nothing_of_after(system: hf.ActorSystem) -> None:
    # T51, O3: a base is switched on again, and its driver stays silent: what came before is no proof that it works.
    manner = Manner(every=0.1, time_to_live=2.0)
    seen = await watch(system, GeneralObserver, "/t", 10.0, 9.0, window=1.0, manner=manner)
    await seen.stream("/t", 2.5, 10)
    assert seen.changes() == ["ok(/t)"]
    await seen.publish(GRACE, Grace(("/t",), 2.0))
    await advance(1.9)
    assert seen.changes() == ["unknown ok(/t)"]
    await advance(0.5)
    assert seen.changes() == ["not ok(/t)"]
    await seen.publish(GRACE, Grace(("/t",), 2.0))
    await seen.stream("/t", 0.5, 10)
    assert seen.changes() == ["unknown ok(/t)", "ok(/t)"]  # enough is seen before the window is over


async def test_a_rate_that_is_not_given_is_learned(system: hf.ActorSystem) -> None:
    seen = await watch(system, GeneralObserver, "/t", window=1.0, manner=QUICK)
    await advance(20.0)
    assert seen.changes() == []  # never heard: nothing is known
    await seen.stream("/t", 8.0, 20)
    assert seen.changes() == ["ok(/t)"]
    await advance(2.0)
    assert seen.changes()[-1] == "not ok(/t)"


async def test_a_learned_rate_outlives_its_observer(system: hf.ActorSystem) -> None:
    # Else a topic that is silent when its observer is restarted would stay unknown for ever.
    seen = await watch(system, GeneralObserver, "/t", window=1.0, learned=Learned(), manner=QUICK)
    await seen.stream("/t", 8.0, 20)
    assert seen.changes() == ["ok(/t)"]
    seen.ref.kill()
    await advance(3.0)
    assert seen.changes()[-1] == "not ok(/t)"


async def test_literals_are_renewed_within_their_time_to_live_and_carry_time_and_source(
    system: hf.ActorSystem,
) -> None:
    # T50, T67
    seen = await watch(system, GeneralObserver, "/t", 10.0, window=1.0, manner=Manner(every=0.5, time_to_live=3.0))
    await advance(20.0)
    said = seen.heard()
    assert {str(one.literal) for one in said} == {"not ok(/t)"}
    assert {one.source for one in said} == {"/t/o"}
    gaps = [later.time - earlier.time for earlier, later in itertools.pairwise(said)]
    assert max(gaps) <= 1.5
    assert len(said) <= 20  # renewed, not repeated with each look


async def test_rules_over_published_values(system: hf.ActorSystem) -> None:
    # D18, T52: limits with hysteresis, a filter against outliers, and a value that does not come any more
    checks = [
        Check("ok(temperature)", "x", Limits(high=40.0, hysteresis=5.0)),
        Check(ok("filtered"), lambda message: message.x, Limits(high=40.0), lambda: Median(3)),
    ]
    seen = await watch(system, DiagnosticObserver, "/t", checks, manner=QUICK)
    for x in (20.0, 41.0, 38.0):
        await seen.publish("/t", Value(x))
        await advance(0.0)
    assert seen.changes() == ["ok(temperature)", "ok(filtered)", "not ok(temperature)"]
    await seen.publish("/t", Value(34.0))
    await advance(0.0)
    assert seen.changes() == ["ok(temperature)"]
    await advance(10.0)
    assert sorted(set(seen.changes())) == ["unknown ok(filtered)", "unknown ok(temperature)"]


async def test_a_verdict_needs_as_many_samples_as_were_asked_for(system: hf.ActorSystem) -> None:
    # T52
    manner = Manner(agreement=Agreement(3, 4))
    seen = await watch(system, DiagnosticObserver, "/t", [Check("ok(a)", "x", Limits(high=1.0))], manner=manner)
    for x in (0.0, 0.0, 0.0, 9.0, 0.0, 9.0, 0.0, 0.0, 9.0, 9.0, 9.0):
        await seen.publish("/t", Value(x))
    await advance(0.0)
    assert seen.changes() == ["ok(a)", "not ok(a)"]


async def test_an_actor_that_ends_is_not_running(system: hf.ActorSystem) -> None:
    # D20
    worker = await system.start(hf.child("worker", hf.start(Source_)))
    seen = await watch(system, NodeObserver, {"w": "/t/worker", "x": "/t/nobody"}, manner=QUICK)
    assert sorted(seen.changes()) == ["not running(x)", "running(w)"]
    await system.suspend(worker)
    await advance(1.0)
    assert "unknown running(w)" in seen.changes()  # on purpose, for a while: neither
    await system.resume(worker)
    await advance(1.0)
    assert "running(w)" in seen.changes()
    await system.stop(worker)
    await advance(1.0)
    assert "not running(w)" in seen.changes()


async def test_an_actor_whose_turn_does_not_end_is_not_running(system: hf.ActorSystem) -> None:
    class Hangs(hf.Actor):
        @hf.on(Value)
        async def _hang(self, message: Value) -> None:
            await asyncio.sleep(30.0)

    worker = await system.start(hf.child("worker", hf.start(Hangs)))
    seen = await watch(system, NodeObserver, {"w": "/t/worker"}, hung_after=5.0, manner=QUICK)
    worker.tell(Value())
    await advance(4.0)
    assert seen.changes() == ["running(w)"]
    await advance(4.0)
    assert seen.changes()[-1] == "not running(w)"
    await advance(30.0)
    assert seen.changes()[-1] == "running(w)"


async def test_what_a_message_triggers_must_come_in_time(system: hf.ActorSystem) -> None:
    # D21
    seen = await watch(
        system,
        TriggeredObserver,
        "/ask",
        "/answer",
        "ok(service)",
        within=1.0,
        when=lambda message: message.x > 0,
        key=lambda message: message.key,
        manner=QUICK,
    )
    await seen.publish("/ask", Value(0.0, key=7))  # no trigger
    await advance(3.0)
    assert seen.changes() == []
    await seen.publish("/ask", Value(1.0, key=1))
    await advance(0.2)
    await seen.publish("/answer", Value(key=2))  # to another question
    await advance(0.2)
    assert seen.changes() == []
    await seen.publish("/answer", Value(key=1))
    await advance(0.0)
    assert seen.changes() == ["ok(service)"]
    await seen.publish("/ask", Value(1.0, key=3))
    await advance(2.0)
    assert seen.changes() == ["not ok(service)"]
    await advance(10.0)
    assert seen.changes() == ["unknown ok(service)"]


async def test_what_is_due_while_a_condition_holds_must_come(system: hf.ActorSystem) -> None:
    # D21
    seen = await watch(
        system, ConditionedObserver, "/mode", "/t", "ok(drive)", holds=lambda m: m.x > 0, within=1.0, manner=QUICK
    )
    await advance(5.0)
    assert seen.changes() == []
    await seen.publish("/mode", Value(1.0))
    await seen.stream("/t", 3.0, 4)
    assert seen.changes() == ["ok(drive)"]
    await advance(2.0)
    assert seen.changes()[-1] == "not ok(drive)"
    await seen.publish("/mode", Value(0.0))
    await advance(1.0)
    assert seen.changes() == ["unknown ok(drive)"]


async def test_trends(system: hf.ActorSystem) -> None:
    # D22
    seen = await watch(system, QualitativeObserver, "v", "/t", "x", slope=0.5, window=2.0, manner=QUICK)
    await seen.stream("/t", 1.8, 10)
    assert seen.changes() == []  # the window is not full
    await seen.stream("/t", 3.0, 10)
    assert seen.changes() == ["inc(v)"]
    await seen.stream("/t", 5.0, 10, lambda t: Value(-2 * t))
    assert seen.changes()[-1] == "dec(v)"
    await seen.stream("/t", 5.0, 10, lambda t: Value(3.0))
    assert seen.changes()[-1] == "const(v)"
    await advance(5.0)
    assert seen.changes()[-1].startswith("unknown")  # silence is no trend


async def test_two_values_match_while_their_trends_do(system: hf.ActorSystem) -> None:
    # D23
    seen = await watch(
        system,
        BinaryQualitativeObserver,
        Source("odom.yaw", "/odom", "x"),
        Source("imu.yaw", "/imu", "x"),
        tolerance=0.3,
        window=2.0,
        manner=QUICK,
    )

    async def move(seconds: float, odom: float, imu: float) -> None:
        for _ in range(round(seconds * 10)):
            now = asyncio.get_running_loop().time()
            await seen.publish("/odom", Value(odom * now))
            await seen.publish("/imu", Value(imu * now + 5.0))
            await advance(0.1)

    await move(4.0, 1.0, 1.1)
    assert seen.changes() == ["matched(odom.yaw,imu.yaw)"]
    await move(6.0, 0.0, 1.0)
    assert seen.changes()[-1] == "not matched(odom.yaw,imu.yaw)"
    await seen.stream("/odom", 5.0, 10)
    assert seen.changes()[-1] == "unknown matched(odom.yaw,imu.yaw)"  # one is silent


async def test_what_the_board_says_of_devices(system: hf.ActorSystem) -> None:
    # D24: the switch, the current that shows that it is not only the switch, and a board that is silent
    def measured(is_on: bool, milliamperes: int) -> BoardMeasured:
        off = Reading(False, 0, 0)
        return BoardMeasured(0.0, Measurements(0, (off, off, Reading(is_on, milliamperes, 12_000), *[off] * 7)))

    limits = Limits(low=500.0, high=2000.0)
    seen = await watch(
        system,
        HardwareObserver,
        Channel("laser", 2, least=100, current=("ok(laser.current)", limits)),
        Channel("base", 0),
        manner=QUICK,
    )
    for reading in ((True, 700), (True, 3000), (True, 10), (False, 0)):
        await seen.publish("/board_measurements", measured(*reading))
        await advance(0.0)
    assert seen.changes() == [
        "on(laser)",
        "ok(laser.current)",
        "not on(base)",
        "not ok(laser.current)",
        "not on(laser)",
        "unknown ok(laser.current)",
    ]
    await advance(10.0)
    assert {"unknown on(laser)", "unknown on(base)"} <= set(seen.changes())


async def test_silence_is_too_long(system: hf.ActorSystem) -> None:
    seen = await watch(system, TimeoutObserver, "/t", 2.0, manner=QUICK)
    await advance(1.8)
    assert seen.changes() == []
    await advance(1.0)
    assert seen.changes() == ["not ok(/t)"]  # nothing has ever come
    await seen.publish("/t", Value())
    await advance(0.0)
    assert seen.changes() == ["ok(/t)"]  # at once
    await advance(5.0)
    assert seen.changes()[-1] == "not ok(/t)"


async def test_the_average_score_must_be_good(system: hf.ActorSystem) -> None:
    seen = await watch(system, ScoreObserver, "/t", "x", Limits(low=0.5), weight=0.5, least=2, manner=QUICK)
    for score in (1.0, 1.0, 0.0, 1.0, 0.0, 0.0):
        await seen.publish("/t", Value(score))
    await advance(0.0)
    assert seen.changes() == ["ok(/t)", "not ok(/t)", "ok(/t)", "not ok(/t)"]
    await advance(10.0)
    assert seen.changes()[-1] == "unknown ok(/t)"


async def test_nothing_bad_is_said_in_the_grace_after_an_action(system: hf.ActorSystem) -> None:
    # T51
    seen = await watch(system, TimeoutObserver, "/t", 1.0, manner=QUICK)
    await advance(3.0)
    assert seen.changes() == ["not ok(/t)"]
    await seen.publish(GRACE, Grace(("/other",), 5.0))
    await advance(1.0)
    assert "unknown ok(/t)" not in seen.changes()
    await seen.publish(GRACE, Grace(("/t",), 5.0))
    await advance(4.0)
    assert seen.changes() == ["unknown ok(/t)"]  # what was said before the action is taken back
    await advance(2.0)
    assert seen.changes() == ["not ok(/t)"]
    await seen.publish(GRACE, Grace(("/t",), 5.0))
    await seen.publish("/t", Value())
    await advance(0.5)
    assert seen.changes()[-1] == "ok(/t)"  # what is good is said at once


async def test_what_is_good_still_is_not_taken_back_behind_an_action(system: hf.ActorSystem) -> None:
    ref: hf.ActorRef[Source_] = await system.start(hf.child("x", hf.start(Source_)))
    manner = Manner(every=0.5, agreement=Agreement(2, 3))
    seen = await watch(system, NodeObserver, {"x": ref.path}, manner=manner)
    await advance(3.0)
    await seen.publish(GRACE, Grace(("x",), 0.1))
    await advance(8.0)
    assert seen.changes() == ["running(x)"]


async def test_after_an_action_a_trend_is_looked_for_anew(system: hf.ActorSystem) -> None:
    # T51: a line through before and after would rise.
    seen = await watch(system, QualitativeObserver, "v", "/t", "x", slope=0.5, window=2.0, manner=QUICK)
    await seen.stream("/t", 4.0, 10, lambda t: Value(10 * t))
    assert seen.changes() == ["inc(v)"]
    await seen.publish(GRACE, Grace(("v",), 0.5))
    await seen.stream("/t", 4.0, 10, lambda t: Value(0.0))
    assert seen.changes() == ["unknown inc(v)", "const(v)"]


async def test_after_an_action_an_average_begins_anew(system: hf.ActorSystem) -> None:
    # T51
    seen = await watch(system, ScoreObserver, "/t", "x", Limits(low=0.5), weight=0.1, manner=QUICK)
    await seen.stream("/t", 5.0, 10, lambda t: Value(0.0))
    assert seen.changes() == ["not ok(/t)"]
    await seen.publish(GRACE, Grace(("/t",), 0.1))
    await seen.stream("/t", 0.6, 10, lambda t: Value(1.0))
    assert seen.changes() == ["unknown ok(/t)", "ok(/t)"]


async def test_after_an_action_old_triggers_and_old_times_do_not_count(system: hf.ActorSystem) -> None:
    # T51
    seen = await watch(system, TriggeredObserver, "/t", "/u", "ok(u)", within=2.0, manner=QUICK)
    await seen.publish("/t", Value())
    await advance(3.0)
    assert seen.changes() == ["not ok(u)"]
    await seen.publish("/t", Value())
    await advance(0.1)
    await seen.publish(GRACE, Grace(("u",), 1.0))
    await advance(4.0)
    assert seen.changes() == ["unknown ok(u)"]


async def test_nothing_bad_is_said_in_the_grace_after_its_own_start(system: hf.ActorSystem) -> None:
    # T51
    seen = await watch(system, NodeObserver, {"x": "/t/nobody"}, manner=Manner(every=0.5, grace=3.0))
    await advance(2.9)
    assert seen.changes() == []
    await advance(1.0)
    assert seen.changes() == ["not running(x)"]


async def test_an_observer_that_crashes_is_restarted_and_hears_again(system: hf.ActorSystem) -> None:
    class Strict(Observer):
        def hear(self, topic: str, message: Any) -> None:
            self.verdict(ok(topic), 1 / message.x > 0)

    seen = await watch(system, Strict, "/t", manner=QUICK)
    await seen.publish("/t", Value(0.0))
    await advance(1.0)
    await seen.publish("/t", Value(1.0))
    await advance(0.0)
    assert seen.changes() == ["ok(/t)"]


async def test_an_ear_that_is_killed_takes_its_observer_along(system: hf.ActorSystem) -> None:
    seen = await watch(system, TimeoutObserver, "/t", 60.0, manner=QUICK)
    (ear,) = seen.ref._cell.children.values()
    ear.kill()
    await advance(1.0)
    await seen.publish("/t", Value())
    await advance(0.0)
    assert seen.changes() == ["ok(/t)"]


async def test_the_observed_actor_is_not_touched(system: hf.ActorSystem) -> None:
    # D26: an observer needs no change of what it observes, and nothing is added to it
    source = await system.start(hf.child("source", hf.start(Source_)))
    cell = source._cell
    before = (cell.table, type(cell.ctx), type(cell.actor), vars(cell.actor).copy())
    seen = await watch(system, NodeObserver, {"s": "/t/source"}, manner=QUICK)
    await system.start(observer("rate", hf.start(GeneralObserver, "/t", 1.0, window=1.0, manner=QUICK)))
    source.tell(Value())
    await advance(3.0)
    assert set(seen.changes()) >= {"running(s)"}
    assert (cell.table, type(cell.ctx), type(cell.actor), vars(cell.actor)) == before
