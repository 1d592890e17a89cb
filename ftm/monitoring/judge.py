"""The decisions of the monitoring engine, as a pure function of what was seen and when.

Four things keep it from flapping (T45). A fault class is present while its rate is high, and gone only when it has been
low for a while (`Signal`). A resource is smoothed, and a mechanism that is in use may need a little more than there is,
where one that is to come must need a little less (`margin`). A wish must hold for `confirm` seconds. After a change
nothing changes for `dwell` seconds, and a change that is not needed must save more than it costs.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

import msgspec

from ..model.application import Application
from ..model.change_model import (
    Choice,
    FaultClasses,
    Pricing,
    RefusedStack,
    Resources,
    Selection,
    check,
    choice_of,
    label,
    resource_price,
    select,
)
from ..model.mechanism_declaration import Entry, Mechanisms

ADAPT, HOLD, NONE, STAY = "adapt", "hold", "none", "stay"
"""Decisions: change; a change is wanted and held back; nothing is valid; all is well."""


class Threshold(msgspec.Struct, frozen=True):
    """When a class of faults is present.

    Args:
        fault: the class of the change model.
        count: so many signals within `window` seconds make it present.
        leave: with at most so many within `window` it is on its way out.
        calm: it is gone after so many seconds on its way out.
    """

    fault: str
    count: int = 1
    window: float = 60.0
    leave: int = 0
    calm: float = 600.0

    def __post_init__(self) -> None:
        if not 0 <= self.leave < self.count:
            raise ValueError(f"{self.fault}: leave must be less than count, or the two would answer each other")
        if not (self.window > 0 and self.calm >= 0):
            raise ValueError(f"{self.fault}: window must be > 0 and calm >= 0")


THRESHOLDS: Final = {
    "crash": Threshold("crash"),
    "mismatch": Threshold("transient_value", count=3, window=60.0, leave=0, calm=600.0),
    "repeated_mismatch": Threshold("permanent_value", count=1, window=60.0, leave=0, calm=600.0),
    "rejected": Threshold("forgery", count=3, window=60.0, leave=0, calm=600.0),
}
"""Kinds of signals, and what they say of the faults there are."""


class Settings(msgspec.Struct, frozen=True):
    """The speed and the stubbornness of the monitoring engine.

    Args:
        required: faults to be tolerated whatever is seen.
        thresholds: what signals say of others.
        interval: seconds between two looks.
        smoothing: part of a new reading in the smoothed value, 0 to 1.
        margin: part of a resource within which nothing changes.
        confirm: seconds a wish must hold before it is followed.
        dwell: seconds after a change in which nothing changes that need not.
        urgent_dwell: seconds after a change in which nothing changes at all; after it, what is not valid may go.
        transition_cost: how much cheaper (in `price`) another choice must be, if the present one is valid. By default
            less than one computation more or less per request, so that what was left for want of a resource comes
            back with it.
        notice: seconds between telling a decision and carrying it out, for a person to object.
    """

    required: FaultClasses = FaultClasses()
    thresholds: dict[str, Threshold] = msgspec.field(default_factory=lambda: dict(THRESHOLDS))
    interval: float = 1.0
    smoothing: float = 0.3
    margin: float = 0.2
    confirm: float = 5.0
    dwell: float = 300.0
    urgent_dwell: float = 10.0
    transition_cost: float = 0.3
    notice: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.smoothing <= 1 or not 0 <= self.margin < 1:
            raise ValueError("smoothing must be in (0, 1] and margin in [0, 1)")
        if not 0 <= self.urgent_dwell <= self.dwell or self.interval <= 0 or min(self.confirm, self.notice) < 0:
            raise ValueError("times must be >= 0, interval > 0, and urgent_dwell at most dwell")


class Readings(msgspec.Struct, frozen=True):
    """Resources as they were measured; None for what cannot be."""

    units: int | None = None
    bandwidth: float | None = None
    cpu: float | None = None
    energy: float | None = None
    certificates: bool | None = None


class Verdict(msgspec.Struct, frozen=True):
    """What is to be done, and why.

    `is_urgent`: the present mechanism is not valid any more. `target` is None if nothing is valid or nothing changes.
    """

    kind: str
    reason: str
    target: tuple[str, ...] | None = None
    is_urgent: bool = False
    faults: FaultClasses = FaultClasses()
    resources: Resources = Resources()
    degraded: tuple[Choice, ...] = ()


class Signals:
    """Whether one class of faults is present, by the times at which signals of it came."""

    def __init__(self, threshold: Threshold) -> None:
        self.threshold = threshold
        self._times: deque[float] = deque()
        self._calm_since: float | None = None
        self.is_present = False

    def put(self, now: float, count: int = 1) -> None:
        """Signals came; more than would matter are not kept."""
        self._times.extend([now] * min(count, self.threshold.count))
        while len(self._times) > self.threshold.count:
            self._times.popleft()

    def look(self, now: float) -> bool:
        """Whether it is present at this time."""
        while self._times and now - self._times[0] > self.threshold.window:
            self._times.popleft()
        rate = len(self._times)
        if rate >= self.threshold.count:
            self.is_present = True
        if not self.is_present or rate > self.threshold.leave:
            self._calm_since = None
        elif self._calm_since is None:
            self._calm_since = now
        if self._calm_since is not None and now - self._calm_since >= self.threshold.calm:
            self.is_present, self._calm_since = False, None
        return self.is_present


class Judge:
    """Knows what was seen, and says what is to be done. Times are seconds on any clock that does not go back."""

    def __init__(
        self,
        settings: Settings,
        application: Application,
        current: tuple[str, ...],
        mechanisms: Mechanisms,
        resources: Resources | None = None,
        price: Pricing = resource_price,
    ) -> None:
        if not callable(price):
            raise TypeError(f"price is a function, such as response_price of holdfast.ftm, and not {price!r}")
        self.settings = settings
        self.application = application
        self.resources = Resources() if resources is None else resources
        self.price = price
        self.forbidden: dict[tuple[str, ...], tuple[float, str]] = {}
        self._entries = {entry.name: entry for entry in map(Entry.of, mechanisms)}
        self._signals = {kind: Signals(threshold) for kind, threshold in settings.thresholds.items()}
        self._smoothed: dict[str, float] = {}
        self._wish: tuple[Any, float] | None = None  # what is wanted, and since when
        self._changed_at = -math.inf
        self.current = self._known(current)

    def _known(self, layers: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in layers if name not in self._entries]
        if unknown:
            raise ValueError(f"no declaration of {', '.join(unknown)}; there are {', '.join(self._entries)}")
        return layers

    # -- what is seen -----------------------------------------------------------------------------------------------

    def signal(self, kind: str, now: float, count: int = 1) -> None:
        """A sign of a fault was seen; of a kind nobody has a threshold for it is nothing."""
        if kind in self._signals and count > 0:
            self._signals[kind].put(now, count)

    def read(self, readings: Readings) -> None:
        """Something was measured. Counts are taken as they are, amounts are smoothed; not-a-number is not measured."""
        changes: dict[str, Any] = {}
        if readings.units is not None:
            changes["units"] = readings.units
        if readings.certificates is not None:
            changes["certificates"] = readings.certificates
        for name in ("bandwidth", "cpu", "energy"):
            value = getattr(readings, name)
            if value is not None and not math.isnan(value):
                changes[name] = self._smooth(name, value)
        self.resources = msgspec.structs.replace(self.resources, **changes)

    def _smooth(self, name: str, value: float) -> float:
        before = self._smoothed.get(name, value)
        if math.isinf(before) or math.isinf(value):
            smoothed = value
        else:
            smoothed = before + self.settings.smoothing * (value - before)
        self._smoothed[name] = smoothed
        return smoothed

    def changed(self, layers: tuple[str, ...], now: float) -> None:
        """The mechanism is another one from now on, whoever has changed it."""
        self.current = self._known(layers)
        self._changed_at = now
        self._wish = None

    def failed(self, now: float) -> None:
        """A change was tried and did not succeed: it is not tried again at once."""
        self._changed_at = now
        self._wish = None

    def forbid(self, layers: tuple[str, ...], until: float, why: str) -> None:
        """A person does not want this mechanism or composition."""
        self.forbidden[layers] = (until, why)

    def allow(self, layers: tuple[str, ...]) -> None:
        """A person has nothing against it any more."""
        self.forbidden.pop(layers, None)

    # -- what is decided --------------------------------------------------------------------------------------------

    def faults(self, now: float) -> FaultClasses:
        """The faults that have to be tolerated now."""
        present = frozenset(signals.threshold.fault for signals in self._signals.values() if signals.look(now))
        return FaultClasses(self.settings.required.classes | present)

    def decide(self, now: float) -> Verdict:
        """What is to be done at this time."""
        faults = self.faults(now)
        # What is in use may need a little more than there is; what is to come must need a little less.
        problems = check(self.layers(), faults, self.application, self.resources.scaled(1 + self.settings.margin))
        wanted, verdict = self._want(faults, [str(problem) for problem in problems], now)
        if verdict.kind == STAY:
            self._wish = None
            return verdict
        if self._wish is None or self._wish[0] != wanted:
            self._wish = (wanted, now)
        why = self._too_early(now, is_urgent=bool(problems))
        if why:
            return msgspec.structs.replace(verdict, kind=HOLD, reason=f"{verdict.reason}; held back: {why}")
        return verdict

    def layers(self) -> list[Entry]:
        """The declarations of the present mechanism, outermost first."""
        return [self._entries[name] for name in self.current]

    def _want(self, faults: FaultClasses, problems: list[str], now: float) -> tuple[object, Verdict]:
        """What would be done if it could be done at once, and what makes it another wish than one before."""
        selection = self._select(faults, now)
        best = selection.best
        about: dict[str, Any] = {"faults": faults, "resources": self.resources, "is_urgent": bool(problems)}
        if problems:
            reason = f"{label(self.current)} is not valid any more: {'; '.join(problems)}"
            if best is None:
                reason = f"{reason}. Nothing else is: {selection.explain()}"
                # Whatever the reasons are at the moment, it is one and the same trouble.
                return NONE, Verdict(NONE, reason, degraded=selection.degraded, **about)
            # That it must go is what has to be confirmed, not where to: the second best is no worse for it.
            return "away", Verdict(ADAPT, f"{reason}; {best} is the cheapest that is", best.layers, **about)
        energy = self._narrow().energy  # As in what it is compared with.
        here = choice_of(self.layers(), faults, self.application, price=self.price, energy=energy)
        if best is None or best.layers == self.current or best.price > here.price - self.settings.transition_cost:
            return None, Verdict(STAY, f"{label(self.current)} is valid, and nothing is enough cheaper", **about)
        reason = f"{best} is cheaper than {here}: {best.price:.3g} against {here.price:.3g}"
        return best.layers, Verdict(ADAPT, reason, best.layers, **about)

    def _narrow(self) -> Resources:
        """What there is for a choice that is to come."""
        return self.resources.scaled(1 - self.settings.margin)

    def _select(self, faults: FaultClasses, now: float) -> Selection:
        selection = select(faults, self.application, self._narrow(), list(self._entries.values()), price=self.price)
        for layers, (until, _) in list(self.forbidden.items()):
            if now >= until:
                del self.forbidden[layers]
        allowed = tuple(choice for choice in selection.valid if choice.layers not in self.forbidden)
        vetoed = [
            RefusedStack(choice.layers, "veto", self.forbidden[choice.layers][1])
            for choice in selection.valid
            if choice.layers in self.forbidden
        ]
        return msgspec.structs.replace(selection, valid=allowed, refused=(*vetoed, *selection.refused))

    def _too_early(self, now: float, *, is_urgent: bool) -> str:
        assert self._wish is not None
        held = now - self._wish[1]
        if held < self.settings.confirm:
            return f"wanted for {held:.3g} s of {self.settings.confirm:.3g}"
        dwell = self.settings.urgent_dwell if is_urgent else self.settings.dwell
        if now - self._changed_at < dwell:
            return f"the last change was {now - self._changed_at:.3g} s ago, and it stays for {dwell:.3g}"
        return ""
