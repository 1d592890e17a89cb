"""The nodes of a robot, as plain classes: they subscribe to topics and publish, and know nothing of actors."""

import holdfast as hf
from holdfast.adapters import Bus, wrap


class Ticks(hf.Message):
    """The wheels have turned: how far since they were built."""

    total: int


class Wheels:
    """Turns, `rate` times a second, and says how far."""

    def __init__(self, bus: Bus, rate: float) -> None:
        self._bus = bus
        self.total = 0
        bus.every(1 / rate, self.turn)

    def turn(self) -> None:
        """Turn by one tick."""
        self.total += 1
        self._bus.publish("/ticks", Ticks(self.total))


class Odometry:
    """Adds up how far the robot has come. A tick that it misses puts it beside where it is, for ever."""

    def __init__(self, bus: Bus) -> None:
        self.total = 0
        self.missed = 0
        bus.subscribe("/ticks", self.take)

    def take(self, ticks: Ticks) -> None:
        """Take one tick."""
        self.missed += ticks.total - self.total - 1
        self.total = ticks.total


WheelsNode = wrap(Wheels, "WheelsNode", callbacks={"/none": Ticks})
OdometryNode = wrap(Odometry, "OdometryNode", callbacks={"/ticks": Ticks})
