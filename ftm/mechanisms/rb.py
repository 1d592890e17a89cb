"""Recovery blocks (RB): what the acceptance test refuses is rolled back, and an alternate computes it.

Fault model  development faults of a version, and value faults, that the acceptance test sees; crashes of a version.
Guarantee    no outcome leaves for which the test does not hold. Alternates are tried in order, each from the state
             before the turn; if none is accepted, the ask fails with `NotAccepted`, and nothing is changed.
Not covered  wrong values that the test does not see; faults that all versions have; a version that never returns
             without awaiting anything; `on_start`; crashes of the process (compose it with PBR).
Needs        versions and assertions, state access; one unit.
Cost         the test, for each turn. After a refusal: a state restored, and a turn, for each alternate that is tried.
Source       Randell 1975; the alternates share messages and state with the primary.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ..alarms import Objected
from ..bricks.brick_messages import Request, ServerState
from ..bricks.runs import Deciding, Missing, Remembering, Run, Shadow, sent_by
from ..model.mechanism import Mechanism, Role
from ..votes.assertions import Inspector, check_assertions, names_of
from ..votes.versions import version


class NotAccepted(HoldfastError, text="{actor}: {why}"):
    """No version has come to an outcome that the acceptance test takes: nothing was changed."""

    actor: str
    why: str


class Alternating(Deciding):
    """After: tests, and has alternates try."""

    def on_start(self, restored: bool) -> None:
        """The test is asked at the end of each turn, of whatever version."""
        assert isinstance(self.mechanism, RB)
        server = self._standing.server
        kind = protected_class(self._standing)
        self._inspector = Inspector(self.mechanism.test)
        server.hooks.append(self._inspector)
        within = self.mechanism.within
        self._alternates = [
            (name, Shadow(self._standing, version(kind, name, "rb"), within)) for name in self.mechanism.alternates
        ]

    async def on_stop(self, reason: object) -> None:
        """It is asked no longer."""
        self._standing.server.hooks.remove(self._inspector)
        for _, shadow in self._alternates:
            await shadow.close()

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        """The first that is accepted."""
        standing = self._standing
        own = first or await self.run_here(before, requests)
        if not own.objections:
            return own
        if len(requests) > 1:  # One by one: only what was refused is an alternate's.
            return NotAccepted(standing.address, own.objection)
        refused = [own.objection]
        for name, shadow in self._alternates:
            run = await shadow.run(before, requests, self.heard(before), sent_by(own))
            if isinstance(run, Run) and not run.objections:
                standing.node.emit(Objected(standing.address, standing.path, "; ".join(refused), name))
                return run
            refused.append(f"{name}: {run.why if isinstance(run, Missing) else run.objection}")
        standing.node.emit(Objected(standing.address, standing.path, "; ".join(refused), ""))
        return NotAccepted(standing.address, "; ".join(refused))


def protected_class(standing: Any) -> type[Actor]:
    """The class of the protected actor."""
    start = standing.server.cell.extra().start
    return start.kind  # type: ignore[no-any-return]


@dataclasses.dataclass(frozen=True)
class RB(Mechanism):
    """Recovery blocks: an alternate computes a request again whose outcome the test has not accepted.

    Args:
        alternates: actor classes with the same messages and state, or handlers (functions with `@on`) that replace
            those of the protected class; or their names.
        test: functions of any of `reply`, `message` and `state`, all of which must hold; or their names.
        within: seconds in which an alternate must have come to its end.
    """

    name: ClassVar[str] = "rb"
    replicas: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset({"development", "transient_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"versions", "assertions", "state_access"})
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "low"
    units: ClassVar[int] = 1
    layer: ClassVar[str] = "repetition"
    roles: ClassVar[dict[str, Role]] = {"single": Role(before=Remembering, after=Alternating)}

    alternates: Any = ()
    test: Any = ()
    within: float = 5.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "alternates", names_of(self.alternates))
        object.__setattr__(self, "test", names_of(self.test))
        if not self.alternates or not self.test:
            raise ValueError("RB takes at least one alternate and one test")

    def check(self, kind: type[Actor], where: str = "") -> None:
        super().check(kind, where)
        for name in self.alternates:
            version(kind, name, self.name)
        check_assertions(self.test, self.name, "test")
