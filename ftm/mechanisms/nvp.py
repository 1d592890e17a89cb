"""N-version programming (NVP): independent versions compute each request, and vote.

Fault model  development faults of a minority of versions; value faults of a minority of runs; crashes of a version.
Guarantee    outcomes leave only if a majority has come to them, state included; a version that was outvoted goes on
             from the state of the majority. Without a majority the ask fails with `NoMajority`, and nothing is changed.
Not covered  faults that a majority of versions shares; a version that never returns without awaiting anything;
             `on_start`; crashes of the process (compose it with PBR). An ask of the actor leaves in the run of the
             protected class; a version that asks anything else is outvoted.
Needs        versions (at least two besides the actor's own class), determinism, state access; one unit.
Cost         no bandwidth; a run for each version, one after the other, and the states compared.
Source       Avizienis 1985; Lyu and Avizienis on inexact voting.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import msgspec

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ..alarms import Masked
from ..bricks.brick_messages import Request, ServerState
from ..bricks.runs import Deciding, Remembering, Run, Shadow, sent_by, turns_of, vote
from ..model.mechanism import Mechanism, Role
from ..model.mechanism_declaration import Cost
from ..votes.assertions import names_of
from ..votes.versions import version
from ..votes.voters import MAJORITY, AnyVoter, Custom, Median, NoMajority, Undecided, Voter
from .rb import protected_class


class Versions(Deciding):
    """After: has the other versions compute, and votes."""

    def on_start(self, restored: bool) -> None:
        """Each version has a life of its own."""
        mechanism = self.mechanism
        assert isinstance(mechanism, NVP)
        kind = protected_class(self._standing)
        self._others = [
            Shadow(self._standing, version(kind, name, "nvp"), mechanism.within) for name in mechanism.versions
        ]

    async def on_stop(self, reason: object) -> None:
        """Stop the shadows of the other versions too."""
        for shadow in self._others:
            await shadow.close()

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        """What the majority has come to."""
        standing, mechanism = self._standing, self.mechanism
        assert isinstance(mechanism, NVP)
        own = first or await self.run_here(before, requests)
        runs: list[Run | None] = [own]
        heard, sent = self.heard(before), sent_by(own)
        for shadow in self._others:
            run = await shadow.run(before, requests, heard, sent)
            runs.append(run if isinstance(run, Run) else None)
        decided = vote(mechanism.voter, runs, with_state=mechanism.compare_state)
        if isinstance(decided, Undecided):
            return NoMajority(standing.address, decided.why)
        if not decided.is_unanimous:
            standing.node.emit(Masked(standing.address, standing.path, turns_of(runs)))
        # Those that agree are alike for a voter that compares; one that picks has picked this very run.
        picks = isinstance(mechanism.voter, (Custom, Median))
        return own if 0 in decided.agreeing and not picks else decided.value


@dataclasses.dataclass(frozen=True)
class NVP(Mechanism):
    """N-version programming: several versions of the class compute each request, and a voter decides.

    Args:
        versions: the others besides the protected class: actor classes with the same messages and state, or handlers
            (functions with `@on`) that replace those of the protected class; or their names.
        voter: what decides. A `Median` takes the run that is in the middle with all its numbers, those of its state
            too (or of its answers alone, with `compare_state=False`); if none is, there is no majority.
        compare_state: whether the states must agree too, as the voter sees it.
        within: seconds in which a version must have come to its end.
    """

    name: ClassVar[str] = "nvp"
    replicas: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset({"development", "transient_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"versions", "determinism", "state_access"})
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "high"
    units: ClassVar[int] = 1
    layer: ClassVar[str] = "repetition"
    cost: ClassVar[Cost | None] = Cost(runs=3, latency=3, total=3)
    roles: ClassVar[dict[str, Role]] = {"single": Role(before=Remembering, after=Versions)}

    versions: Any = ()
    voter: Any = MAJORITY
    compare_state: bool = True
    within: float = 5.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "versions", names_of(self.versions))
        object.__setattr__(self, "voter", voter_of(self.voter))
        if len(self.versions) < 2:
            raise ValueError("NVP takes at least two versions besides the protected class: two of three decide")

    def check(self, kind: type[Actor], where: str = "") -> None:
        super().check(kind, where)
        for name in self.versions:
            version(kind, name, self.name)


def voter_of(value: Any) -> Any:
    """A voter, as it was given or as it came from another process.

    Raises:
        ValueError: it is none.
    """
    try:
        made: Any = msgspec.convert(value, AnyVoter) if isinstance(value, dict) else value
    except msgspec.ValidationError as error:
        raise ValueError(f"{value!r} is no voter: {error}") from error
    is_voter = isinstance(made, Voter) and not isinstance(made, type)
    if not is_voter:
        known = "Exact(), Majority(), Tolerance(...), Median() or custom(function) of holdfast.ftm.votes.voters"
        raise ValueError(f"a voter is one such as {known}, not {made!r}")
    return made
