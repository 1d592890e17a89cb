"""Events by which replicas report on their protection; `address` is the protected actor's."""

from __future__ import annotations

from ..actors.events import Event


class ProtectionLost(Event, frozen=True, eq=False):
    """A replica goes on alone: what it answers now is lost if it dies too."""

    replica: str
    epoch: int


class Diverged(Event, frozen=True, eq=False):
    """Two replicas have come to different outcomes of the same request (T8).

    `request` is its number and `name` what it was; from there on the follower's state is not the leader's. Whose fault
    it is, a comparison of two does not say: the follower computes the request again, and `NondeterminismFound` follows
    if that comes out differently each time.
    """

    replica: str
    epoch: int
    request: int
    name: str
    turn: int


class StatesDiffer(Event, frozen=True, eq=False):
    """After turn `turn` the follower's state was not the leader's, though no outcome has shown it."""

    replica: str
    epoch: int
    turn: int


class NondeterminismFound(Event, frozen=True, eq=False):
    """A replica has run requests up to `request` (`name`) again from the same state, and it came out differently.

    The actor is not deterministic; no single wrong value explains that.
    """

    replica: str
    epoch: int
    request: int
    name: str
    turn: int


class ProtectionCostly(Event, frozen=True, eq=False):
    """To compare runs, a replica had to go through the whole state of `size` bytes, and took `seconds` for it.

    It does so for each batch. Told once per life of a replica, from 10 ms on.
    """

    replica: str
    seconds: float
    size: int


class RequestsDropped(Event, frozen=True, eq=False):
    """A brick has neither passed these requests on nor ended them: they fail with `RequestDropped`."""

    replica: str
    numbers: str


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
