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
from typing import Any, ClassVar

import msgspec

from ...checkpoint.protocol import FAILED, Answer, TurnEnd
from ..alarms import Masked
from ..bricks.brick_messages import Done
from ..bricks.bricks import FOREVER, After
from ..model.mechanism import Mechanism, Role
from ..replica.state_manager import LastRun, Ran, RunAgain, Undo
from ..votes.voters import NoMajority


def outcome(ran: Ran) -> tuple[Any, ...]:
    """What two runs have to agree on: how each turn ended, its answer, all that it has sent, and the state."""
    released = dict(ran.released)
    ends = [
        (
            end.id,
            end.turn,
            end.status,
            end.answer.kind,
            end.answer.name,
            b"" if end.answer.kind == "crash" else end.answer.body,  # A traceback tells where the runtime stood.
            tuple(released.get(end.turn, ())) + tuple(out.digest() for out in end.outs),
        )
        for end in ran.ends
    ]
    state = ran.state
    return ends, state.turn, state.data, state.deltas, [feed.id for feed in state.stash]


class Compare(After):
    """After of time redundancy: what leaves was computed alike twice."""

    async def after(self, done: Done) -> Done:
        """Run again what has just run, and compare."""
        if not done.ends:
            return done
        first = await self.state.ask(LastRun(done.ends), timeout=FOREVER)
        second = await self.state.ask(RunAgain(), timeout=FOREVER)
        if outcome(first) == outcome(second):
            return done
        third = await self.state.ask(RunAgain(), timeout=FOREVER)
        best = next((one for one in (first, second) if outcome(one) == outcome(third)), None)
        if best is None:
            return with_ends(done, await self._undone(done.ends))
        turns = ", ".join(str(turn) for turn in differing(first, second, third))
        self._standing.node.emit(Masked(self._standing.address, self._standing.path, turns))
        return with_ends(done, best.ends)

    async def _undone(self, ends: list[TurnEnd]) -> list[TurnEnd]:
        """No turn of this part has happened; whoever has asked for one hears why."""
        before = await self.state.ask(Undo(), timeout=FOREVER)
        standing = self._standing
        error = NoMajority(standing.address, "three runs have come to three different outcomes")
        answer = Answer(*standing.node.codec.encode_error(error))
        numbers = list(dict.fromkeys(end.id for end in ends))
        failed = [
            TurnEnd(turn, number, FAILED, [], answer if is_ask(standing, number) else Answer())
            for turn, number in enumerate(numbers, before.turn + 1)
        ]
        standing.server.skip_to(failed[-1].turn)
        return failed


def is_ask(standing: Any, number: int) -> bool:
    """Whether somebody waits for the outcome of this request."""
    request = standing.inside.get(number)
    return request is not None and bool(request.feed.is_ask)


def with_ends(done: Done, ends: list[TurnEnd]) -> Done:
    """The same message with other ends."""
    return msgspec.structs.replace(done, ends=ends)


def differing(*runs: Ran) -> list[int]:
    """The turns that have not ended alike in all runs; the last one, if only their states differ."""
    rows = [outcome(one)[0] for one in runs]
    found = [row[0][1] for row in zip(*rows, strict=False) if any(one != row[0] for one in row)]
    return found or [max(one.state.turn for one in runs)]


@dataclasses.dataclass(frozen=True)
class TR(Mechanism):
    """Time redundancy."""

    name: ClassVar[str] = "tr"
    replicas: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset({"transient_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"determinism", "state_access"})
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "high"
    units: ClassVar[int] = 1
    layer: ClassVar[str] = "repetition"
    roles: ClassVar[dict[str, Role]] = {"single": Role(after=Compare)}
