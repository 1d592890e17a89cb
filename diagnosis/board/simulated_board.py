"""The board itself, simulated: what its channels do and what it measures, without a network and without a clock."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable

import msgspec

from .board_frames import CHANNELS, ChannelSpecification, Measurements, Reading, Specification

RIPPLE = 0.01
"""Share of the current by which a measurement is off, at most."""
INRUSH_SECONDS = 0.05
"""After so long the current of a device that was switched on has fallen to a third of what it drew in excess."""
MOST = 2**31 - 1
SAG = 0.02
"""Share of the voltage that is lost at the current a channel may draw at most."""


class Load(msgspec.Struct, frozen=True):
    """What hangs on a channel.

    Attributes:
        name: what the channel is called.
        milliamperes: what it draws in the long run.
        inrush: how many times as much it draws in excess of that at first, >= 0.
        most_milliamperes: what the channel may draw.
    """

    name: str
    milliamperes: int = 500
    millivolts: int = 12_000
    inrush: float = 1.5
    most_milliamperes: int = 5_000


ROBOT: tuple[Load, ...] = (
    Load("robot base", 3_000, 24_000, most_milliamperes=20_000),
    Load("PC", 2_500),
    Load("sensor pan-tilt unit", 900),
    Load("laser alignment", 700),
    Load("thermal camera", 200),
    Load("LRF", 350),
    Load("Kinect", 1_000),
)
"""The seven channels that the paper's robot uses."""


class SimulatedBoard:
    """Ten channels with their loads. Time is what `clock` says, in seconds.

    Args:
        loads: of the first channels; nothing hangs on the others.
        defaults: channels that are on after a power-up of the board, such as the PC, so that it can start the rest.
        changed: is told of each channel that goes on or off.
    """

    def __init__(
        self,
        loads: Iterable[Load] = ROBOT,
        *,
        defaults: Iterable[int] = (1,),
        clock: Callable[[], float],
        rng: random.Random | None = None,
        changed: Callable[[int, bool], None] = lambda channel, on: None,
    ) -> None:
        named = list(loads)
        if len(named) > CHANNELS:
            raise ValueError(f"a board has {CHANNELS} channels, not {len(named)}")
        spare = [Load(f"spare {number}", 0) for number in range(len(named), CHANNELS)]
        self.loads = (*named, *spare)
        self._defaults = frozenset(defaults)
        if not self._defaults <= set(range(CHANNELS)):
            raise ValueError(f"defaults are channels 0 to {CHANNELS - 1}, not {sorted(self._defaults)}")
        self._clock, self._rng, self._changed = clock, rng or random.Random(0), changed
        self._on_since: dict[int, float] = {}
        self.stuck: set[int] = set()
        self.wrong: dict[int, int] = {}
        self.power_cycle()

    @property
    def on(self) -> frozenset[int]:
        """The channels that have power."""
        return frozenset(self._on_since)

    def power_cycle(self) -> None:
        """The board's own power goes and comes: then its default channels are on, and no others."""
        self._began = self._clock()
        for channel in range(CHANNELS):
            self._put(channel, channel in self._defaults)

    def specification(self) -> Specification:
        """Say what the board is, as any `Device` does."""
        channels = tuple(ChannelSpecification(one.name, one.millivolts, one.most_milliamperes) for one in self.loads)
        return Specification(channels, self._defaults)

    def switch(self, channel: int, on: bool) -> None:
        """See `Device`. A stuck channel stays as it is, and nobody says so."""
        if channel not in self.stuck:
            self._put(channel, on)

    def set_defaults(self, channels: frozenset[int]) -> None:
        """Set which channels are on after its own power-up."""
        self._defaults = channels

    def measure(self) -> Measurements:
        """Measure all channels, as any `Device` does."""
        uptime = max(0, round((self._clock() - self._began) * 1000))
        return Measurements(uptime, tuple(self._reading(channel) for channel in range(CHANNELS)))

    def _put(self, channel: int, on: bool) -> None:
        if on is (channel in self._on_since):
            return
        if on:
            self._on_since[channel] = self._clock()
        else:
            del self._on_since[channel]
        self._changed(channel, on)

    def _reading(self, channel: int) -> Reading:
        load, since = self.loads[channel], self._on_since.get(channel)
        drawn = 0.0
        if since is not None:
            excess = load.inrush * math.exp(-max(0.0, self._clock() - since) / INRUSH_SECONDS)
            drawn = load.milliamperes * (1.0 + excess) * (1.0 + RIPPLE * (2.0 * self._rng.random() - 1.0))
        drawn = self.wrong.get(channel, drawn)
        volts = load.millivolts * (1.0 - SAG * drawn / max(1, load.most_milliamperes)) if since is not None else 0.0
        return Reading(since is not None, _held(drawn), _held(volts))


def _held(value: float) -> int:
    """Whole, and no more than a frame can hold."""
    return round(min(max(value, -MOST), MOST))
