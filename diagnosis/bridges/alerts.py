"""Alerts from outside as observations: while one fires about a component, `ok(COMPONENT.alerts)` does not hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Final

from ...actors.kernel.message import Message
from ..literals import Literal, ok
from ..observers.observer import Manner, Observer
from .payload import WebhookPayload, fingerprint_of

ALERTS: Final = "/alerts"
"""`OutsideAlert`, from whoever has one."""
MOST_ALERTS: Final = 10_000
"""Alerts that are remembered; of more, the oldest count no longer."""


class OutsideAlert(Message):
    """Somebody else says that something is wrong with a component (its name, or its address), or is not any more.

    `key` tells alerts about one component from each other.
    """

    component: str
    is_firing: bool
    name: str = ""
    key: str = ""


def no_alert(component: str) -> Literal:
    """The literal that nobody outside complains about a component."""
    return ok(f"{component}.alerts")


def outside_alerts(payload: WebhookPayload, label: str) -> list[OutsideAlert]:
    """The alerts of a payload of Alertmanager, of which each names its component by a label.

    Raises:
        ValueError: one of them has no such label.
    """
    found: list[OutsideAlert] = []
    for one in payload.alerts:
        name = one.labels.get("alertname", "alert")
        if not (component := one.labels.get(label, "")):
            raise ValueError(f"{name} has no label {label!r}, which says whom it is about: add it to the rule")
        found.append(
            OutsideAlert(component, one.status == "firing", name, one.fingerprint or fingerprint_of(one.labels))
        )
    return found


@dataclasses.dataclass(frozen=True, slots=True)
class _Firing:
    component: str
    until: float


class AlertObserver(Observer):
    """Says that a component is not ok while an alert about it fires; when none does, nothing is known.

    Args:
        actors: component to address: an alert may name either. It may change.
        keeps: seconds after which an alert that was not said again counts no longer.
        manner: see `Observer`.
    """

    def __init__(self, actors: Mapping[str, str], *, keeps: float = 86_400.0, manner: Manner | None = None) -> None:
        super().__init__(ALERTS, manner=manner)
        if not keeps > 0:
            raise ValueError(f"keeps is {keeps!r}; it must be > 0 seconds")
        self._actors, self._keeps = actors, keeps
        self._firing: dict[tuple[str, str], _Firing] = {}

    def hear(self, topic: str, message: Any) -> None:
        """Take an alert in; one about nobody we know is said all the same, so that the diagnoser tells of it."""
        if not isinstance(message, OutsideAlert):
            return
        names = {path: component for component, path in self._actors.items()}
        component = names.get(message.component, message.component)
        self._firing.pop((component, message.key), None)
        if message.is_firing:
            self._firing[component, message.key] = _Firing(component, self.now + self._keeps)
            while len(self._firing) > MOST_ALERTS:
                del self._firing[next(iter(self._firing))]
        elif all(one.component != component for one in self._firing.values()):
            self.verdict(no_alert(component), None)
        self._say()

    def look(self) -> None:
        """Say again what still holds."""
        over = [key for key, one in self._firing.items() if one.until < self.now]
        ended = {self._firing.pop(key).component for key in over}
        for component in ended - {one.component for one in self._firing.values()}:
            self.verdict(no_alert(component), None)
        self._say()

    def _say(self) -> None:
        for component in dict.fromkeys(one.component for one in self._firing.values()):
            self.verdict(no_alert(component), False)
