"""Events of the monitoring engine; `address` is the protected one."""

from __future__ import annotations

from ...actors.events import Event


class AdaptationDecided(Event, frozen=True, eq=False):
    """The mechanism is to be changed. In `notice` seconds, unless a person objects to decision `number`."""

    number: int
    current: tuple[str, ...]
    target: tuple[str, ...]
    reason: str
    is_urgent: bool
    notice: float


class AdaptationHeld(Event, frozen=True, eq=False):
    """The mechanism would be changed, but not yet, or a person does not want it."""

    current: tuple[str, ...]
    target: tuple[str, ...]
    reason: str


class NothingValid(Event, frozen=True, eq=False):
    """No mechanism suits what there is: the present one goes on, and is not enough. `degraded` are ways to go on."""

    current: tuple[str, ...]
    reason: str
    degraded: tuple[str, ...]


class AdaptationDone(Event, frozen=True, eq=False):
    """A decision was carried out."""

    number: int
    current: tuple[str, ...]


class AdaptationFailed(Event, frozen=True, eq=False):
    """A decision could not be carried out: the mechanism is the one before."""

    number: int
    target: tuple[str, ...]
    reason: str


class AdaptationWithdrawn(Event, frozen=True, eq=False):
    """A decision that was announced is not carried out."""

    number: int
    target: tuple[str, ...]
    reason: str


class MonitoringBlind(Event, frozen=True, eq=False):
    """Something could not be seen: a measurement failed, or so many events came that some were missed."""

    reason: str
