"""The monitoring engine, as an actor: what it sees, what it has done, and what a person says to it (A6, T45, T46)."""

import asyncio

import msgspec
import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged, NondeterminismFound
from holdfast.ftm.bricks.sealed_frames import FrameRefused
from holdfast.ftm.events import MechanismAttached, MechanismChanged, MechanismDetached, ReplicaFaulty
from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses, Resources
from holdfast.ftm.monitoring.adaptations import (
    AdaptationDecided,
    AdaptationDone,
    AdaptationFailed,
    AdaptationHeld,
    AdaptationWithdrawn,
    MonitoringBlind,
    NothingValid,
)
from holdfast.ftm.monitoring.judge import Readings
from holdfast.ftm.monitoring.monitor import (
    Allow,
    ApplicationIs,
    ChangeStack,
    Forbid,
    Measured,
    MechanismIs,
    Object,
    Observe,
)
from holdfast.testing import advance
from tests.ftm.monitored import APP, NARROW, SETTINGS, WIDE, World, in_world

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Boom(hf.Message): ...


class Account(hf.Actor):
    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")


class Engine(hf.Actor):
    """An adaptation engine that is an actor; it keeps what it was told."""

    def __init__(self, told: list[ChangeStack]) -> None:
        self.told = told

    @hf.on(ChangeStack)
    def adapt(self, message: ChangeStack) -> None:
        self.told.append(message)


async def test_a_drop_in_bandwidth_is_decided_told_and_done() -> None:
    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(3.5)
        assert world.orders == []
        assert world.names() == ["AdaptationHeld"]
        await advance(1)
        (order,) = world.orders
        assert (order.address, order.current, order.target, order.is_urgent) == ("/app/alice", ("pbr",), ("lfr",), True)
        decided, done = world.told()
        assert isinstance(decided, AdaptationDecided)
        assert isinstance(done, AdaptationDone)
        assert decided.address == "/app/alice"
        assert "bytes/s between units" in decided.reason
        assert (decided.number, done.number, done.current) == (1, 1, ("lfr",))
        report = await world.report()
        assert (report.current, report.changes, report.verdict) == (("lfr",), 1, "stay")
        await advance(1000)
        assert len(world.orders) == 1  # and that was all
        assert world.told() == []

    await in_world(play)


async def test_it_measures_by_its_probe() -> None:
    readings = [WIDE]

    async def play(world: World) -> None:
        await advance(10)
        assert world.orders == []
        readings[0] = NARROW
        await advance(10)
        assert [order.target for order in world.orders] == [("lfr",)]

    await in_world(play, probe=lambda: readings[0])


async def test_what_cannot_be_measured_is_told_and_stays_as_it_was() -> None:
    def probe() -> Readings:
        raise OSError("no such sensor")

    async def play(world: World) -> None:
        await advance(2.5)
        assert [event.reason for event in world.told() if isinstance(event, MonitoringBlind)] == [
            "resources cannot be measured: OSError: no such sensor"
        ] * 2
        assert (await world.report()).resources.units == 2

    await in_world(play, probe=probe)


async def test_crashes_at_the_address_and_below_it_are_seen_and_no_others() -> None:
    settings = msgspec.structs.replace(SETTINGS, required=FaultClasses())

    async def play(world: World) -> None:
        other = await world.system.start(hf.child("other", hf.start(Account)))
        other.tell(Boom())
        await advance(5)
        assert (await world.report()).faults == FaultClasses()
        alice = await world.system.start(hf.child("alice", hf.start(Account)))
        alice.tell(Boom())
        await advance(1.5)
        assert (await world.report()).faults == FaultClasses.of("crash")
        await advance(5)
        assert [order.target for order in world.orders] == [("pbr",)]

    await in_world(play, settings, current=())


async def test_mismatches_add_tr_and_a_calm_takes_it_away() -> None:
    async def play(world: World) -> None:
        world.ref.tell(Observe("mismatch", 3))
        await advance(15)
        assert [order.target for order in world.orders] == [("pbr", "tr")]
        await advance(600)
        assert len(world.orders) == 1
        await advance(100)
        assert [order.target for order in world.orders] == [("pbr", "tr"), ("pbr",)]
        assert not world.orders[1].is_urgent

    quiet = Application("Account")
    await in_world(play, application=quiet)


async def test_divergence_shows_that_a_declaration_was_wrong() -> None:
    """T8: who says that it is deterministic, and is not, is treated as what it is until there is another version."""

    async def play(world: World) -> None:
        world.ref.tell(Observe("diverged"))
        await advance(5)
        assert [order.target for order in world.orders] == [("pbr",)]
        assert "lfr needs determinism" in world.orders[0].reason
        assert not (await world.report()).application.is_deterministic
        world.ref.tell(ApplicationIs(msgspec.structs.replace(APP, version="2")))
        assert (await world.report()).application.is_deterministic

    await in_world(play, current=("lfr",))


async def test_a_difference_is_a_wrong_value_until_it_is_known_to_be_the_applications_fault() -> None:
    """What masks value faults needs determinism: a flipped bit must not rule it out."""
    at = "/app/alice"

    async def play(world: World) -> None:
        for turn in range(3):
            world.system._node.emit(Diverged(at, f"{at}/ftm/r2", 1, turn, "Add", turn))
        await advance(1)
        report = await world.report()
        assert report.application.is_deterministic
        assert "transient_value" in report.faults.classes
        world.system._node.emit(NondeterminismFound(at, f"{at}/ftm/r2", 1, 3, "Add", 3))
        await advance(1)
        assert not (await world.report()).application.is_deterministic

    await in_world(play, current=("lfr",))


async def test_another_version_of_the_application_is_taken_into_account() -> None:
    async def play(world: World) -> None:
        world.ref.tell(ApplicationIs(Application("Account", version="2", has_state_access=False)))
        await advance(5)
        assert [order.target for order in world.orders] == [("lfr",)]
        assert "pbr needs state access" in world.orders[0].reason

    await in_world(play)


async def test_when_nothing_is_valid_that_is_told_once_and_nothing_is_changed() -> None:
    """T46."""
    degraded: list[str] = []

    async def play(world: World) -> None:
        world.ref.tell(Measured(Readings(units=1)))
        await advance(60)
        assert world.orders == []
        events = world.told()
        assert [type(event) for event in events] == [AdaptationHeld, NothingValid]
        nothing = events[1]
        assert isinstance(nothing, NothingValid)
        assert nothing.degraded == ("unprotected",)
        assert "needs 2 processing units, and has 1" in nothing.reason
        assert degraded == ["unprotected"]
        world.ref.tell(Measured(Readings(units=2)))
        await advance(2)
        world.ref.tell(Measured(Readings(units=1)))
        await advance(10)
        assert world.names()[-1] == "NothingValid"  # it is new again

    await in_world(play, degrade=lambda choices, reason: degraded.extend(map(str, choices)))


async def test_a_change_that_fails_leaves_the_old_mechanism_and_is_tried_again_later() -> None:
    tries: list[float] = []

    async def trigger(order: ChangeStack) -> None:
        tries.append(asyncio.get_running_loop().time())
        if len(tries) == 1:
            raise RuntimeError("roll-back")

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(6)
        (failed,) = (event for event in world.told() if isinstance(event, AdaptationFailed))
        assert failed.reason == "RuntimeError: roll-back"
        assert (await world.report()).current == ("pbr",)
        await advance(20)
        assert (await world.report()).current == ("lfr",)
        assert tries[1] - tries[0] >= SETTINGS.urgent_dwell

    await in_world(play, trigger=trigger)


async def test_a_trigger_that_hangs_is_given_up_and_nothing_else_is_begun_meanwhile() -> None:
    calls: list[ChangeStack] = []

    async def trigger(order: ChangeStack) -> None:
        calls.append(order)
        await asyncio.Event().wait()

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(30)
        assert len(calls) == 1
        await advance(10)
        (failed,) = (event for event in world.told() if isinstance(event, AdaptationFailed))
        assert failed.reason == "TimeoutError"

    await in_world(play, trigger=trigger, patience=30.0)


async def test_the_trigger_may_be_an_actor() -> None:
    told: list[ChangeStack] = []

    async def play(world: World) -> None:
        world.watch.trigger = world.system.spawn(hf.start(Engine, told), name="engine")
        world.ref.tell(Measured(NARROW))
        await advance(6)
        assert [order.target for order in told] == [("lfr",)]
        assert (await world.report()).current == ("lfr",)

    await in_world(play)


# -- what a person says ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("answer", [True, "not during the show"])
async def test_a_veto_keeps_the_old_mechanism(answer: bool | str) -> None:
    asked: list[ChangeStack] = []

    async def veto(order: ChangeStack) -> bool | str:
        asked.append(order)
        return answer

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(30)
        assert world.orders == []
        (withdrawn,) = (event for event in world.told() if isinstance(event, AdaptationWithdrawn))
        assert withdrawn.reason == ("a person's veto" if answer is True else answer)
        assert len(asked) == 1  # a person is not asked every second
        await advance(SETTINGS.dwell)
        assert len(asked) == 2

    await in_world(play, veto=veto)


async def test_a_veto_that_says_nothing_lets_it_pass_and_one_that_fails_does_not() -> None:
    async def passes(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(6)
        assert len(world.orders) == 1

    await in_world(passes, veto=lambda order: None)

    def broken(order: ChangeStack) -> bool:
        raise OSError("nobody is there")

    async def fails(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(6)
        assert world.orders == []
        assert any(
            "nobody is there" in event.reason for event in world.told() if isinstance(event, AdaptationWithdrawn)
        )

    await in_world(fails, veto=broken)


async def test_a_decision_that_was_announced_waits_for_objections() -> None:
    settings = msgspec.structs.replace(SETTINGS, notice=10)

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(5)
        (decided,) = (event for event in world.told() if isinstance(event, AdaptationDecided))
        assert decided.notice == 10
        assert (await world.report()).announced == decided.number
        assert not await world.ref.ask(Object(decided.number + 1))
        assert await world.ref.ask(Object(decided.number, "I am working on it"))
        assert not await world.ref.ask(Object(decided.number))
        await advance(30)
        assert world.orders == []
        await advance(60)
        assert [order.target for order in world.orders] == [("lfr",)]  # the objection has run out

    await in_world(play, settings)


async def test_a_decision_that_is_not_wanted_any_more_is_withdrawn() -> None:
    settings = msgspec.structs.replace(SETTINGS, notice=10)

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(5)
        world.ref.tell(Measured(WIDE))
        await advance(30)
        assert world.orders == []
        assert world.names() == ["AdaptationHeld", "AdaptationDecided", "AdaptationWithdrawn"]

    await in_world(play, settings, application=msgspec.structs.replace(APP, rate=99))


async def test_what_is_forbidden_is_not_chosen_until_it_is_allowed() -> None:
    settings = msgspec.structs.replace(SETTINGS, notice=10)

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(5)
        world.ref.tell(Forbid(("lfr",), 1000, "licence"))
        await advance(20)
        assert world.orders == []
        events = world.told()
        assert [event.reason for event in events if isinstance(event, AdaptationWithdrawn)] == [
            "lfr was forbidden: licence"
        ]
        assert any("lfr: licence (veto)" in event.reason for event in events if isinstance(event, NothingValid))
        world.ref.tell(Allow(("lfr",)))
        await advance(20)
        assert [order.target for order in world.orders] == [("lfr",)]

    await in_world(play, settings)


async def test_a_change_that_somebody_else_made_counts() -> None:
    async def play(world: World) -> None:
        world.ref.tell(MechanismIs(("tmr",)))
        await advance(10)
        assert (await world.report()).current == ("tmr",)
        assert world.orders == []  # it dwells
        await advance(60)
        assert [order.current for order in world.orders] == [("tmr",)]

    await in_world(play, resources=Resources(units=3))


async def test_a_change_that_somebody_else_made_is_seen_by_its_event() -> None:
    async def play(world: World) -> None:
        emit = world.system._node.emit
        emit(MechanismChanged("/app/bob", ("pbr",), ("lfr",), 2, 0.0))  # Of somebody else.
        await advance(2)
        assert (await world.report()).current == ("pbr",)
        emit(MechanismChanged("/app/alice", ("pbr",), ("lfr",), 2, 0.0))
        await advance(2)
        assert (await world.report()).current == ("lfr",)
        emit(MechanismDetached("/app/alice", ("lfr",), 0.0))
        await advance(2)
        assert (await world.report()).current == ()
        emit(MechanismAttached("/app/alice", ("nobodys_own",), 0.0))
        world.told()
        await advance(2)
        (blind,) = [event for event in world.told() if isinstance(event, MonitoringBlind)]
        assert "no declaration of nobodys_own" in blind.reason

    await in_world(play)


async def test_another_class_at_the_address_is_another_version() -> None:
    """A2."""

    class Moody(Account):
        deterministic = False

    async def play(world: World) -> None:
        alice = await world.system.start(hf.child("alice", hf.start(Account)))
        await advance(2)
        assert (await world.report()).application == APP
        await world.system.suspend(alice)
        await world.system.replace_code(alice, Moody)
        await world.system.resume(alice)
        await advance(2)
        seen = (await world.report()).application
        assert not seen.is_deterministic
        assert (seen.state_bytes, seen.rate) == (APP.state_bytes, APP.rate)
        await advance(5)
        assert [order.target for order in world.orders] == [("pbr",)]

    await in_world(play, current=("lfr",))


@pytest.mark.parametrize(("reason", "seen"), [("forged", True), ("replayed", True), ("stale_epoch", False)])
async def test_refused_frames_are_signs_but_not_those_of_the_time_before(reason: str, seen: bool) -> None:
    async def play(world: World) -> None:
        for count in range(3):
            world.system._node.emit(FrameRefused("/app/alice", "/app/alice/ftm/r1", reason, count + 1))
        await advance(1.5)
        assert ("forgery" in (await world.report()).faults.classes) is seen

    await in_world(play)


async def test_a_replica_that_is_faulty_again_and_again_is_a_permanent_fault() -> None:
    async def play(world: World) -> None:
        world.system._node.emit(ReplicaFaulty("/app/alice", "r2", 1, 3))
        await advance(1.5)
        assert "permanent_value" in (await world.report()).faults.classes

    await in_world(play)
