"""A mechanism that is written only here: what an assertion refuses is rolled back, and computed once more."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from holdfast.actors.errors import HoldfastError
from holdfast.ftm.alarms import Objected
from holdfast.ftm.bricks.brick_messages import Request, ServerState
from holdfast.ftm.bricks.runs import Deciding, Remembering, Run
from holdfast.ftm.model.mechanism import Mechanism, Role
from holdfast.ftm.votes.assertions import AssertionFailed, Inspector, names_of


class Checking(Deciding):
    """After: a second run, if there is something against the first one."""

    def on_start(self, restored: bool) -> None:
        assert isinstance(self.mechanism, Retry)
        self._inspector = Inspector(self.mechanism.checks)
        self._standing.server.hooks.append(self._inspector)

    def on_stop(self, reason: object) -> None:
        self._standing.server.hooks.remove(self._inspector)

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        standing = self._standing
        run = first or await self.run_here(before, requests)
        if run.objections:
            why, run = run.objection, await self.run_here(before, requests)
            by = "" if run.objections else standing.path
            standing.node.emit(Objected(standing.address, standing.path, why, by))
        return AssertionFailed(standing.address, run.objection) if run.objections else run


@dataclasses.dataclass(frozen=True)
class Retry(Mechanism):
    """Assertion and retry: masks transient value faults that the assertions see."""

    name: ClassVar[str] = "retry"
    tolerates: ClassVar[frozenset[str]] = frozenset({"transient_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"assertions", "state_access"})
    layer: ClassVar[str] = "repetition"
    roles: ClassVar[dict[str, Role]] = {"single": Role(before=Remembering, after=Checking)}

    checks: Any = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "checks", names_of(self.checks))
