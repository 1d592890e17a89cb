"""An observer of the power board: `on(h)` for devices, and whether what they draw is right (D24)."""

from __future__ import annotations

from typing import Any

import msgspec

from ..board.board_actor import TOPIC, BoardMeasured
from ..literals import Literal, atom_of, on
from .observer import Manner, Observer
from .verdicts import Limits


class Channel(msgspec.Struct, frozen=True):
    """A device on a channel of the board.

    Attributes:
        device: its name in the model.
        number: of the channel, 0 to 9.
        least: milliamperes without which it is not on, whatever the board says of its switch.
        current: an atom that holds while the milliamperes of the device, when it is on, are within limits.
    """

    device: str
    number: int
    least: int = 0
    current: tuple[Literal | str, Limits] | None = None


class HardwareObserver(Observer):
    """Says which devices have power, as long as the board is heard of.

    Args:
        channels: the devices.
        topic: where the board's measurements are published (by `BoardActor`).
        manner: see `Observer`.
    """

    def __init__(self, *channels: Channel, topic: str = TOPIC, manner: Manner | None = None) -> None:
        super().__init__(topic, manner=manner)
        self._channels = [(channel, on(channel.device), *_current(channel)) for channel in channels]
        self._time = float("-inf")

    def hear(self, topic: str, message: Any) -> None:
        """Judge what the board has measured of all its channels."""
        if not isinstance(message, BoardMeasured):
            return
        self._time = self.now
        readings = message.measurements.channels
        for channel, atom, current, limits in self._channels:
            if not 0 <= channel.number < len(readings):
                continue
            reading = readings[channel.number]
            has_power = reading.on and reading.milliamperes >= channel.least
            self.verdict(atom, has_power)
            if current is not None:
                is_good = limits.holds(reading.milliamperes, self.said(current)) if has_power else None
                self.verdict(current, is_good)

    def look(self) -> None:
        """A board that is silent says nothing of its devices."""
        if self.now - self._time > self.manner.time_to_live:
            for _, atom, current, _ in self._channels:
                self.verdict(atom, None)
                if current is not None:
                    self.verdict(current, None)


def _current(channel: Channel) -> tuple[Literal | None, Limits]:
    if channel.current is None:
        return None, Limits()
    atom, limits = channel.current
    return atom_of(atom), limits
