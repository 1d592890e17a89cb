"""Events of protected addresses; `address` is the protected actor's."""

from __future__ import annotations

from ..actors.events import Event


class MechanismAttached(Event, frozen=True, eq=False):
    """The actor is protected from now on; `layers` are the mechanisms, outermost first."""

    layers: tuple[str, ...]
    seconds: float


class MechanismDetached(Event, frozen=True, eq=False):
    """The actor is not protected any more; its life goes on."""

    layers: tuple[str, ...]
    seconds: float


class MechanismChanged(Event, frozen=True, eq=False):
    """The actor is protected by other layers from now on, without having stopped; `seconds` it handled nothing."""

    before: tuple[str, ...]
    layers: tuple[str, ...]
    config: int
    seconds: float


class MechanismSettled(Event, frozen=True, eq=False):
    """The probation of a change of layers is over: they stay (`is_kept`), or those before are there again, and why.

    `why` is empty if they have passed. Else it says why they are taken back, or what ended the probation early.
    """

    before: tuple[str, ...]
    layers: tuple[str, ...]
    is_kept: bool
    why: str
    seconds: float


class FailedOver(Event, frozen=True, eq=False):
    """Another replica leads; `seconds` from when the end of the old one was noticed."""

    replica: str
    epoch: int
    seconds: float
    why: str


class ReplicaJoined(Event, frozen=True, eq=False):
    """A replica has caught up with the one that leads, and can take its place from now on."""

    replica: str
    epoch: int
    turn: int
    seconds: float


class ReplicaLost(Event, frozen=True, eq=False):
    """A replica that counted does not any more."""

    replica: str
    epoch: int
    why: str


class TurnHung(Event, frozen=True, eq=False):
    """A turn has taken longer than `Detection.watch_turns`, for the `times`-th time for its message."""

    replica: str
    epoch: int
    message: str
    times: int


class ReplicaFaulty(Event, frozen=True, eq=False):
    """A follower has diverged `times` times in a row, right after it had the leader's state: its process is ended."""

    replica: str
    epoch: int
    times: int


class WrongSuspicion(Event, frozen=True, eq=False):
    """A replica that was suspected has been heard of again; `wrong` counts these at its address."""

    replica: str
    wrong: int


class BackgroundWorkLost(Event, frozen=True, eq=False):
    """Whoever led has died, or its life was begun again because a turn failed, with background work (`pipe_to_self`)
    out, and no journal leads to its being begun anew."""

    epoch: int
    count: int
