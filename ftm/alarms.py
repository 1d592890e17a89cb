"""What replicas tell of their protection, as events; `address` is the protected actor's."""

from __future__ import annotations

from ..actors.events import Event


class ProtectionLost(Event, frozen=True, eq=False):
    """A replica goes on alone: what it answers now is lost if it dies too."""

    replica: str
    epoch: int


class Diverged(Event, frozen=True, eq=False):
    """Two replicas have come to different outcomes of the same request: the actor is not deterministic (T8).

    `request` is its number and `name` what it was; from there on the follower's state is not the leader's.
    """

    replica: str
    epoch: int
    request: int
    name: str
    turn: int


class Masked(Event, frozen=True, eq=False):
    """Runs of the same requests have differed, and the majority was taken; `turns` names those that did."""

    replica: str
    turns: str


class Objected(Event, frozen=True, eq=False):
    """An assertion or acceptance test did not hold here; `by` has computed the request instead, "" if nobody has."""

    replica: str
    why: str
    by: str


class Outvoted(Event, frozen=True, eq=False):
    """The other replicas agree on something else than this one: it ends, and joins again with their state."""

    replica: str
    epoch: int
    turns: str
