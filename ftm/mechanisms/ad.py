"""Assertion and duplex (A&D): assertions say whether an outcome can be right; if not, the other replica computes.

Fault model  value faults of one replica, transient and permanent, that the assertions see; with the mechanism below it
             (PBR or LFR), the crash of a replica.
Guarantee    no outcome leaves, and no state is replicated, for which an assertion does not hold. What the other replica
             has come to is taken, state and all; if it is not right there either, the ask fails with `AssertionFailed`
             and nothing is changed. A turn that crashes counts as wrong, unless it crashes alike on both.
Not covered  wrong values that no assertion sees; development faults, which are alike on both (they are said, not
             masked); `on_start`. Alone (the other replica is lost), what is wrong fails and is not masked. A permanent
             fault that destroys the state in between two turns.
Needs        assertions, and state access; two units, of the mechanism below.
Cost         the assertions, for each turn. After an objection: a state goes there and back.
Source       Lauer et al. 2018, Tables I and II; Stoicescu et al. 2017.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ..alarms import Objected
from ..bricks.brick_messages import Request, ServerState
from ..bricks.runs import Deciding, Run, sent_by, vote
from ..bricks.shadow_runs import Compute, Helping
from ..model.mechanism import Mechanism, Role
from ..votes.assertions import AssertionFailed, Inspector, check_assertions, names_of
from ..votes.voters import MAJORITY, Agreed


class Assisting(Helping):
    """Before of both replicas: computes for the other one; has the assertions asked at the end of each turn."""

    def on_start(self, restored: bool) -> None:
        """Have the assertions asked at the end of each turn from now on."""
        assert isinstance(self.mechanism, AD)
        self._inspector = Inspector(self.mechanism.assertions)
        self._standing.server.hooks.append(self._inspector)

    async def on_stop(self, reason: object) -> None:
        """Have the assertions asked no longer."""
        self._standing.server.hooks.remove(self._inspector)
        await super().on_stop(reason)


class Asserting(Deciding):
    """After of a replica that computes."""

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        """What was computed here, if nothing is against it; else what the other replica comes to."""
        standing = self._standing
        own = first or await self.run_here(before, requests)
        if not own.objections:
            return own
        other = await self._at_peer(before, requests, own)
        alike = isinstance(other, Run) and isinstance(vote(MAJORITY, [own, other]), Agreed)
        if isinstance(other, Run) and (not other.objections or (alike and is_crash(own))):
            standing.node.emit(Objected(standing.address, standing.path, own.objection, standing.other.path or ""))
            return own if alike else other
        why = f"here: {own.objection}; " + (f"there: {other.objection}" if isinstance(other, Run) else other)
        standing.node.emit(Objected(standing.address, standing.path, why, ""))
        return AssertionFailed(standing.address, why)

    async def _at_peer(self, before: ServerState, requests: list[Request], own: Run) -> Run | str:
        standing = self._standing
        if standing.other.path is None:
            return "there is no other replica"
        order = Compute(before.turn, b"", before, requests, self.heard(before), False, before.live, sent=sent_by(own))
        try:
            done = await self.ask_at(standing.other.path, "ad.before", order)
        except HoldfastError as error:
            return f"the other replica cannot compute it: {error}"
        if done.problem or done.state is None:
            return f"the other replica has not computed it: {done.problem}"
        return Run(done.ends, done.state, objections=done.objections)


def is_crash(run: Run) -> bool:
    """Whether all that is against a run are crashes."""
    crashed = {end.id for end in run.ends if end.status == "failed"}
    return all(number in crashed for number, _ in run.objections)


@dataclasses.dataclass(frozen=True)
class AD(Mechanism):
    """Assertion and duplex, over PBR or LFR: `compose(AD(assertions=(is_solvent,)), PBR())`.

    Args:
        assertions: functions, or names ("module:function"), of any of `reply`, `message` and `state`.
    """

    name: ClassVar[str] = "ad"
    replicas: ClassVar[int] = 2
    tolerates: ClassVar[frozenset[str]] = frozenset({"transient_value", "permanent_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"assertions", "state_access"})
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "low"
    units: ClassVar[int] = 2
    layer: ClassVar[str] = "assertion"
    over: ClassVar[frozenset[str]] = frozenset({"replication"})
    roles: ClassVar[dict[str, Role]] = {
        "primary": Role(before=Assisting, after=Asserting),
        "backup": Role(before=Assisting, after=Asserting),
    }

    assertions: Any = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "assertions", names_of(self.assertions))
        if not self.assertions:
            raise ValueError("AD takes at least one assertion")

    def check(self, kind: type[Actor], where: str = "") -> None:
        super().check(kind, where)
        check_assertions(self.assertions, self.name, "assertion")
