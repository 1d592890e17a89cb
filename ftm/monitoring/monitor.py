"""The monitoring engine: watches whether the mechanism in force still suits, and has it changed if not (A6).

It looks at events of the protected address (crashes, mismatches, refused frames, mechanisms that somebody else has
changed) and at the class of what lives there, measures resources, and lets `Judge` decide. What it decides is an event
with its reason, and a call of what it was given: it changes nothing itself (`watched.watch_of` gives it transactions).
A person can forbid a mechanism, object to a decision that was announced, or be asked (`veto`).

What it knows is in a `MechanismWatch` outside of it: it can be killed at any moment, and its next life goes on.
"""

from __future__ import annotations

import asyncio
import inspect
import os
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

import msgspec

from ...actors.events import Event, EventHub, EventStream
from ...actors.exit_reasons import ExitReason
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.message import Message, RuntimeCall, RuntimeOrder
from ...actors.kernel.node import cell_kind
from ...actors.kernel.ref import ActorRef
from ...supervision.arbiter import Hand, arbiter_of
from ..events import MechanismAttached, MechanismChanged, MechanismDetached
from ..model.application import Application
from ..model.change_model import Choice, FaultClasses, Resources, choice_of, label
from .adaptations import (
    AdaptationDecided,
    AdaptationDone,
    AdaptationFailed,
    AdaptationHeld,
    AdaptationWithdrawn,
    MonitoringBlind,
    NothingValid,
)
from .judge import ADAPT, HOLD, NONE, STAY, Judge, Readings, Verdict

CRASH, MISMATCH, DIVERGED, FAULTY, REJECTED = "crash", "mismatch", "diverged", "repeated_mismatch", "rejected"
SIGNS: Final[Mapping[str, str]] = {
    "ActorCrashed": CRASH,
    "ProcessDied": CRASH,
    "ReplicaLost": CRASH,
    "Masked": MISMATCH,
    "Objected": MISMATCH,
    "Diverged": MISMATCH,  # Whoever has seen it computes again, before anybody blames the application.
    "StatesDiffer": MISMATCH,
    "NondeterminismFound": DIVERGED,
    "ReplicaFaulty": FAULTY,
    "FrameRefused": REJECTED,
}
"""Events, by the name of their class, and the kind of sign they are. One fault may leave several signs."""
HARMLESS: Final = frozenset({"stale_epoch", "stale_life", "wrong_session", "closed", "generation", "out_of_order"})
"""Why frames are refused that were underway when somebody was replaced, or when one was lost."""


SIZES: Final = ("assertions", "versions", "state_bytes", "delta_bytes", "request_bytes", "rate", "turn_seconds")
"""What is known of an application besides what its class says of itself."""


# -- what it is told -------------------------------------------------------------------------------------------------


class ChangeStack(RuntimeOrder[None]):
    """The order to change the mechanism of `address` to `target`, outermost layer first."""

    number: int
    address: str
    current: tuple[str, ...]
    target: tuple[str, ...]
    reason: str
    is_urgent: bool = False


class MonitorLook(Message):
    """Look at what there is, and decide. It tells itself."""


class Observe(RuntimeCall):
    """A sign was seen that is no event: `kind` is that of a threshold, or `diverged`."""

    kind: str
    count: int = 1


class Measured(RuntimeCall):
    """Resources were measured by somebody else."""

    readings: Readings


class ApplicationIs(RuntimeCall):
    """The application is this one now: another version, with what it declares."""

    application: Application


class MechanismIs(RuntimeCall):
    """Somebody has changed the mechanism."""

    layers: tuple[str, ...]


class Forbid(RuntimeOrder[None]):
    """A person does not want this mechanism or composition for so many seconds."""

    layers: tuple[str, ...]
    seconds: float
    why: str = "forbidden"


class Allow(RuntimeOrder[None]):
    """A person has nothing against it any more."""

    layers: tuple[str, ...]


class Object(RuntimeCall[bool]):
    """A person does not want decision `number` to be carried out; the reply is whether that was in time."""

    number: int
    why: str = "a person objects"


class Monitored(msgspec.Struct, frozen=True):
    """What the engine knows at the moment."""

    current: tuple[str, ...]
    faults: FaultClasses
    resources: Resources
    application: Application
    verdict: str
    reason: str
    changes: int
    announced: int = 0  # the decision that waits for its time; 0: none


class Report(Message[Monitored]):
    """Asks the engine for what it knows."""


class CarryOut(Message):
    """The time to object to a decision is over. It tells itself."""

    number: int


class Tried(Message):
    """What came of a decision. It tells itself."""

    number: int
    problem: str = ""
    is_veto: bool = False


Trigger = Callable[[ChangeStack], Awaitable[None] | None] | ActorRef[Any]
Veto = Callable[[ChangeStack], Any]
Probe = Callable[[], Readings]


def read_machine() -> Readings:
    """Measure this machine: the CPUs we may run on, their idle part since the last call, the battery if there is one.

    Bandwidth between units is not known here: pass a probe of your own that knows it.
    """
    import psutil  # A program that is told its resources, or has no engine, does without it.

    battery: Any = psutil.sensors_battery() if hasattr(psutil, "sensors_battery") else None
    energy = None if battery is None else 1.0 if battery.power_plugged else battery.percent / 100
    idle = 1.0 - psutil.cpu_percent(interval=None) / 100
    return Readings(units=len(os.sched_getaffinity(0)), cpu=idle, energy=energy)


class MechanismWatch:
    """What the engine knows and has been given; it outlives the engine's lives.

    Args:
        address: the protected one. Events count that happen there or below.
        judge: decides.
        trigger: what carries out a decision: a function of `ChangeStack`, maybe async, or an actor that handles it.
            When it returns, the mechanism is the target; when it raises, it is the one before.
        probe: measures resources; None if they are told by `Measured`.
        veto: asked before a decision is carried out, maybe async; True or a text (why) forbids the target for `dwell`
            seconds. If it raises, that is a veto, too.
        degrade: told when nothing is valid, with what could still be covered.
        signs: which events are signs of what.
        patience: seconds that trigger and veto may take.
    """

    def __init__(
        self,
        address: str,
        judge: Judge,
        trigger: Trigger,
        *,
        probe: Probe | None = read_machine,
        veto: Veto | None = None,
        degrade: Callable[[tuple[Choice, ...], str], None] | None = None,
        signs: Mapping[str, str] = SIGNS,
        patience: float = 60.0,
    ) -> None:
        self.address = address
        self.judge = judge
        self.trigger = trigger
        self.probe = probe
        self.veto = veto
        self.degrade = degrade
        self.signs = dict(signs)
        self.patience = patience
        self.verdict = Verdict(STAY, "nothing was looked at yet")
        self.announced: ChangeStack | None = None
        self.running: ChangeStack | None = None
        self.told: object = None  # the last thing told about what is held back, or that nothing is valid
        self.numbers = 0
        self.changes = 0
        self.kind: type | None = None  # the class of what lives there
        self.found: tuple[str, ...] | None = None  # the mechanism that somebody has given to it
        self._events: EventStream | None = None
        self._missed = 0

    def listen(self, hub: EventHub) -> None:
        """Begin to look at events; what happens between two lives of the engine is not missed."""
        if self._events is None:
            self._events = hub.listen()

    def close(self) -> None:
        """Look at no events any more."""
        if self._events is not None:
            self._events.close()
            self._events = None

    def follow(self, address: str) -> None:
        """The actor has moved to another supervisor: it is the protected one there."""
        self.address = address

    def take_signs(self) -> list[str]:
        """The kinds of the signs that came since the last time; what mechanisms there are now is noted."""
        events = self._events.take() if self._events is not None else []
        for event in events:
            if event.address == self.address and self.running is None:  # Else it may be the change that runs.
                if isinstance(event, (MechanismAttached, MechanismChanged)):
                    self.found = event.layers
                elif isinstance(event, MechanismDetached):
                    self.found = ()
        return [kind for event in events if (kind := self._kind(event)) is not None]

    def missed(self) -> int:
        """How many events could not be kept since the last time."""
        before, self._missed = self._missed, 0 if self._events is None else self._events.missed
        return self._missed - before

    def _kind(self, event: Event) -> str | None:
        if event.address != self.address and not event.address.startswith(f"{self.address}/"):
            return None
        if event.address.startswith(f"{self.address}/ftm/"):  # Replicas that are lost are told at the address itself.
            return None
        reason = getattr(event, "reason", None)
        if isinstance(reason, ExitReason) and reason.is_clean:  # A process that ended because it was to is no fault.
            return None
        if isinstance(reason, str) and reason in HARMLESS:
            return None
        return self.signs.get(type(event).__name__)


class MonitoringEngine(Actor):
    """Looks every `interval` seconds; see the module. It is no part of what it protects."""

    deterministic = False

    def __init__(self, watch: MechanismWatch) -> None:
        self._watch = watch

    def on_start(self, restored: bool) -> None:
        watch = self._watch
        watch.listen(self.ctx._cell.node.events)
        # Timers and tasks have ended with the life before this one.
        if watch.announced is not None:
            self._withdraw("the monitoring engine was restarted")
        if watch.running is not None:
            self._tried(Tried(watch.running.number, "the monitoring engine was restarted meanwhile"))
        self.ctx.every(watch.judge.settings.interval, MonitorLook())

    def _now(self) -> float:
        return self.ctx._cell.node.loop.time()

    def _emit(self, kind: type[Event], *parts: Any) -> None:
        self.ctx._cell.node.emit(kind(self._watch.address, *parts))

    # -- seeing -----------------------------------------------------------------------------------------------------

    @on(MonitorLook)
    def _look(self, message: MonitorLook) -> None:
        watch = self._watch
        there = self.ctx._cell.node.find(watch.address)
        if there is not None:
            watch.follow(there.path)
        for kind in watch.take_signs():
            self._sign(kind, 1)
        self._see_address()
        if watch.missed():
            self._emit(MonitoringBlind, "more events came than could be looked at")
        if watch.probe is not None:
            try:
                watch.judge.read(self._with_own_load(watch.probe()))
            except Exception as error:  # What is not measured stays as it was.
                self._emit(MonitoringBlind, f"resources cannot be measured: {type(error).__name__}: {error}")
        self._decide()

    def _see_address(self) -> None:
        """Who lives there, and what protects it: both may have been changed by somebody else."""
        watch, judge = self._watch, self._watch.judge
        found, watch.found = watch.found, None
        if found is not None and found != judge.current:
            try:
                judge.changed(found, self._now())
            except ValueError as error:
                self._emit(MonitoringBlind, f"somebody has changed the mechanism to {label(found)}: {error}")
        cell = self.ctx._cell.node.find(watch.address)
        kind = None if cell is None else cell_kind(cell)
        if kind is not None and kind is not watch.kind:
            if watch.kind is not None:  # Another version: only what no class says is still true.
                known = {name: getattr(judge.application, name) for name in SIZES}
                judge.application = Application.of(kind, **known)
            watch.kind = kind

    def _with_own_load(self, readings: Readings) -> Readings:
        """What the present mechanism takes can be taken by another one, too."""
        if readings.cpu is None:
            return readings
        judge = self._watch.judge
        own = choice_of(judge.layers(), FaultClasses(), judge.application).load
        return msgspec.structs.replace(readings, cpu=min(1.0, readings.cpu + own))

    @on(Observe)
    def _observe(self, message: Observe) -> None:
        self._sign(message.kind, message.count)

    def _sign(self, kind: str, count: int) -> None:
        judge = self._watch.judge
        judge.signal(kind, self._now(), count)
        if kind == DIVERGED:  # It says that it is deterministic, and is not: until there is another version.
            judge.application = msgspec.structs.replace(judge.application, is_deterministic=False)

    @on(Measured)
    def _measured(self, message: Measured) -> None:
        self._watch.judge.read(message.readings)

    @on(ApplicationIs)
    def _application_is(self, message: ApplicationIs) -> None:
        self._watch.judge.application = message.application

    @on(MechanismIs)
    def _mechanism_is(self, message: MechanismIs) -> None:
        self._watch.judge.changed(message.layers, self._now())

    @on(Report)
    def _report(self, message: Report) -> Monitored:
        watch, judge = self._watch, self._watch.judge
        return Monitored(
            current=judge.current,
            faults=judge.faults(self._now()),
            resources=judge.resources,
            application=judge.application,
            verdict=watch.verdict.kind,
            reason=watch.verdict.reason,
            changes=watch.changes,
            announced=0 if watch.announced is None else watch.announced.number,
        )

    # -- deciding ---------------------------------------------------------------------------------------------------

    def _decide(self) -> None:
        watch = self._watch
        if watch.running is not None:
            return
        watch.verdict = verdict = watch.judge.decide(self._now())
        announced = watch.announced
        if announced is not None:
            if verdict.kind != ADAPT or verdict.target != announced.target:
                self._withdraw(f"it is not wanted any more: {verdict.reason}")
            return
        if verdict.kind == ADAPT:
            busy = arbiter_of(self.ctx._cell.node).in_the_way(watch.address, Hand.ADAPTATION)
            if busy is None:
                self._announce(verdict)
            else:  # It would be refused.
                self._tell_once((HOLD, busy.hand), AdaptationHeld, Verdict(HOLD, str(busy), verdict.target))
        elif verdict.kind == HOLD:
            self._tell_once((HOLD, verdict.target), AdaptationHeld, verdict)
        elif verdict.kind == NONE:
            self._tell_once((NONE,), NothingValid, verdict)
        else:
            watch.told = None

    def _tell_once(self, what: object, kind: type[Event], verdict: Verdict) -> None:
        """Tell of what lasts when it begins."""
        watch = self._watch
        if watch.told == what:
            return
        watch.told, current = what, watch.judge.current
        if kind is NothingValid:
            self._emit(kind, current, verdict.reason, tuple(str(choice) for choice in verdict.degraded))
            if watch.degrade is not None:
                watch.degrade(verdict.degraded, verdict.reason)
        else:
            self._emit(kind, current, verdict.target or (), verdict.reason)

    def _announce(self, verdict: Verdict) -> None:
        watch, judge = self._watch, self._watch.judge
        assert verdict.target is not None
        watch.numbers += 1
        adapt = ChangeStack(
            watch.numbers, watch.address, judge.current, verdict.target, verdict.reason, is_urgent=verdict.is_urgent
        )
        notice = judge.settings.notice
        self._emit(AdaptationDecided, adapt.number, adapt.current, adapt.target, adapt.reason, adapt.is_urgent, notice)
        watch.announced, watch.told = adapt, None
        if notice > 0:
            self.ctx.tell_after(notice, CarryOut(adapt.number))
        else:
            self._carry_out(CarryOut(adapt.number))

    def _withdraw(self, why: str) -> None:
        watch = self._watch
        assert watch.announced is not None
        self._emit(AdaptationWithdrawn, watch.announced.number, watch.announced.target, why)
        watch.announced = None

    @on(CarryOut)
    def _carry_out(self, message: CarryOut) -> None:
        watch = self._watch
        adapt = watch.announced
        if adapt is None or adapt.number != message.number:
            return
        watch.announced, watch.running = None, adapt
        self.ctx.pipe_to_self(self._try(adapt), lambda tried: tried)

    async def _try(self, adapt: ChangeStack) -> Tried:
        """Ask the person, then have it done. It touches nothing of ours: what came of it is told."""
        watch = self._watch
        try:
            async with asyncio.timeout(watch.patience):
                why = await self._vetoed(adapt)
                if why:
                    return Tried(adapt.number, why, is_veto=True)
                if isinstance(watch.trigger, ActorRef):
                    await watch.trigger.ask(adapt, timeout=watch.patience)
                else:
                    done = watch.trigger(adapt)
                    if inspect.isawaitable(done):
                        await done
        except Exception as error:
            return Tried(adapt.number, f"{type(error).__name__}: {error}".rstrip(": "))
        return Tried(adapt.number)

    async def _vetoed(self, adapt: ChangeStack) -> str:
        veto = self._watch.veto
        if veto is None:
            return ""
        try:
            answer: Any = veto(adapt)
            if inspect.isawaitable(answer):
                answer = await answer
        except Exception as error:
            return f"the veto failed: {type(error).__name__}: {error}"
        return answer if isinstance(answer, str) else "a person's veto" if answer else ""

    @on(Tried)
    def _tried(self, message: Tried) -> None:
        watch, judge, now = self._watch, self._watch.judge, self._now()
        adapt = watch.running
        if adapt is None or adapt.number != message.number:
            return
        watch.running = None
        if message.is_veto:
            judge.forbid(adapt.target, now + judge.settings.dwell, message.problem)
            self._emit(AdaptationWithdrawn, adapt.number, adapt.target, message.problem)
        elif message.problem:
            judge.failed(now)
            self._emit(AdaptationFailed, adapt.number, adapt.target, message.problem)
        else:
            watch.changes += 1
            judge.changed(adapt.target, now)
            watch.verdict = Verdict(STAY, f"decision {adapt.number} was carried out: {adapt.reason}")
            self._emit(AdaptationDone, adapt.number, adapt.target)

    # -- what a person says -----------------------------------------------------------------------------------------

    @on(Forbid)
    def _forbid(self, message: Forbid) -> None:
        watch = self._watch
        watch.judge.forbid(message.layers, self._now() + message.seconds, message.why)
        if watch.announced is not None and watch.announced.target == message.layers:
            self._withdraw(f"{label(message.layers)} was forbidden: {message.why}")

    @on(Allow)
    def _allow(self, message: Allow) -> None:
        self._watch.judge.allow(message.layers)

    @on(Object)
    def _object(self, message: Object) -> bool:
        watch = self._watch
        if watch.announced is None or watch.announced.number != message.number:
            return False
        watch.judge.forbid(watch.announced.target, self._now() + watch.judge.settings.dwell, message.why)
        self._withdraw(message.why)
        return True
