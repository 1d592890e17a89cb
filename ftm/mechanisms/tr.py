"""Time redundancy (TR): compute twice, compare, and vote with a third run.

Fault model  transient value faults: in an answer, in what is sent, in the state.
Guarantee    outcomes leave only when two runs agree on answers, outputs and state; a difference is settled by a third
             run, two of three; without a majority the asks fail with `NoMajority`, and nothing is changed (T43, T44).
Not covered  crashes; permanent value faults, which are alike in every run; an ask of the protected actor leaves in the
             first run (its outcome serves all of them), and is compared afterwards.
Needs        determinism and state access; one unit, two to three times the computation.
Cost         no bandwidth; a batch takes two runs and two state copies.
Source       Lauer et al. 2018, Tables I and II (A38); A65.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from ...actors.errors import HoldfastError
from ..alarms import Masked
from ..bricks.brick_messages import Request, ServerState
from ..bricks.runs import Deciding, Run, turns_of, vote
from ..model.mechanism import Mechanism, Role
from ..votes.voters import MAJORITY, Agreed, NoMajority, Undecided


class Compare(Deciding):
    """After of time redundancy: what leaves was computed alike twice."""

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        """Run again what has just run, and compare; a third run decides."""
        first = first or await self.run_here(before, requests)
        runs: list[Run | None] = [first, await self.run_here(before, requests)]
        if isinstance(vote(MAJORITY, runs), Agreed):
            return first
        standing, third = self._standing, await self.run_here(before, requests)
        decided = vote(MAJORITY, [*runs, third])
        if isinstance(decided, Undecided):
            return NoMajority(standing.address, decided.why)
        standing.node.emit(Masked(standing.address, standing.path, turns_of([*runs, third])))
        return third


@dataclasses.dataclass(frozen=True)
class TR(Mechanism):
    """Time redundancy, as its file describes it."""

    name: ClassVar[str] = "tr"
    replicas: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset({"transient_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"determinism", "state_access"})
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "high"
    units: ClassVar[int] = 1
    layer: ClassVar[str] = "repetition"
    roles: ClassVar[dict[str, Role]] = {"single": Role(after=Compare)}
