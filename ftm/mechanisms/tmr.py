"""Triple modular redundancy (TMR): three replicas compute each request, and the one that leads votes.

Fault model  one replica at a time: crashed, silent, or wrong, for once or for good, in answers, outputs or state.
Guarantee    an outcome leaves when two replicas agree on it, state included, and any other that is up has answered.
             A replica that was outvoted ends, is started again and joins with the right state; if it was the one that
             leads, another one leads. Without a majority the ask fails with `NoMajority`, and nothing is changed.
             Through a failover the third replica stays one that could lead: whoever leads next brings it to its state
             before anything leaves.
Not covered  two faulty replicas at the same time; with one of three gone, a wrong value is seen and not masked (the ask
             fails); an ask of the actor in the middle of a turn leaves before the vote; `on_start`.
Needs        determinism, state access; three units.
Cost         little bandwidth: requests, outcomes and digests of states. All three compute, the leader first.
Source       Lyons and Vanderkulk 1962.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
from typing import Any, ClassVar

import msgspec

from ...actors.errors import ActorStopped, HoldfastError
from ..alarms import Masked, Outvoted
from ..bricks.brick_messages import Done, NotFollowing, Request, ServerState, StaleLeader, Strayed, is_marker
from ..bricks.runs import Deciding, Digests, Run, sent_by, turns_of, vote
from ..bricks.shadow_runs import NEEDS_STATE, Compute, Computed, Helping, Settled
from ..bricks.standing import PeerLost
from ..model.mechanism import Mechanism, Role
from ..model.mechanism_declaration import Cost
from ..votes.voters import MAJORITY, Median, NoMajority, Undecided
from .nvp import voter_of

NAMES = ("r1", "r2", "r3")
TRIES = 4
"""How often a replica is asked, if others join or go meanwhile."""


class OutvotedHere(HoldfastError, text="{why}"):
    """The other replicas agree on something else: this one begins again with their state."""

    why: str


class ComputingAlong(Helping):
    """Before of all three: computes for the one that leads."""

    follows_at_once = True  # An order says which state it begins from: nobody is left out until it is told to follow.

    def settled(self, message: Settled) -> None:
        """Outvoted: end, begin again, and join."""
        if not message.right and not self.leads:
            raise OutvotedHere(f"{self._standing.path} was outvoted")


class Voting(Deciding):
    """After of the one that leads."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._point: ServerState | None = None
        self._digest = b""
        self._digests = Digests()
        self._strayed: list[str] = []  # replicas that have not got the state behind what leaves next

    async def after(self, done: Done) -> Done | None:
        """Have the part decided. With what leaves, the root is told which replicas have not got the state behind it."""
        if is_marker(done.number):
            await self._bring_others()
        decided = await super().after(done)
        strayed, self._strayed = self._strayed, []
        if decided is not None:
            decided.more.extend(map(Strayed, strayed))
        return decided

    async def _bring_others(self) -> None:
        """We lead from now on: what only we had computed for the last leader leaves when the others have it too."""
        server = self._standing.server
        if server.turn < 0 or server.points.point is None:
            return
        point = server.capture()
        order = Compute(point.turn, self._digest_of(point), None, [], [], True, point.live)
        await asyncio.gather(*(self._at(path, point, order) for path in self._others()))

    async def choose(self, before: ServerState, requests: list[Request], first: Run | None) -> Run | HoldfastError:
        """What two of three have come to."""
        standing, mechanism = self._standing, self.mechanism
        assert isinstance(mechanism, TMR)
        base = self._digest_of(before)
        own = first or await self.run_here(before, requests)
        assert own.state is not None
        digest = self._digest_of(own.state)
        paths = self._others()
        order = Compute(before.turn, base, None, requests, self.heard(before), True, before.live, sent=sent_by(own))
        computed = await asyncio.gather(*(self._at(path, before, order) for path in paths))
        others = [None if one is None else Run(one.ends, None, one.digest) for one in computed]
        runs: list[Run | None] = [Run(own.ends, None, digest), *others]
        present = sum(run is not None for run in runs)
        if present == 1:
            standing.go_on_alone(one.feed.id for one in requests)
            return own  # Nobody is left to vote with.
        standing.other.is_missed = True
        decided = vote(mechanism.voter, runs)
        if isinstance(decided, Undecided):
            return NoMajority(standing.address, decided.why)
        wrong = [at for at in decided.dissenting if runs[at] is not None]
        if wrong:
            standing.node.emit(Masked(standing.address, standing.path, turns_of(runs)))
        for at in wrong:
            path = standing.path if at == 0 else paths[at - 1]
            standing.node.emit(Outvoted(standing.address, path, standing.epoch, turns_of(runs)))
            if at:
                self._strayed.append(paths[at - 1])
                self.ctx.create_task(self._tell(paths[at - 1]))
        if 0 in wrong:  # The right outcomes, and the state behind them, are with the others: one of them leads.
            raise OutvotedHere(f"{standing.path} leads and was outvoted")
        return own

    async def begun(self, done: Done) -> None:
        """The others begin with the state after `on_start`."""
        standing = self._standing
        point = standing.server.capture()
        log = [*standing.log.entries(), *standing.entries(done.ends)]
        order = Compute(point.turn, b"", point, [], [], True, point.live, log)
        await asyncio.gather(*(self._at(path, point, order) for path in self._others()))

    def _digest_of(self, state: ServerState) -> bytes:
        if self._point is not state and self._point != state:
            begin = time.perf_counter()
            self._point, self._digest = state, self._digests.of(state)
            self._standing.server.took(time.perf_counter() - begin, state.data.size)
        return self._digest

    def _others(self) -> list[str]:
        above, _, own = self._standing.path.rpartition("/")
        return [f"{above}/{name}" for name in NAMES if name != own]

    async def _at(self, path: str, before: ServerState, order: Compute) -> Computed | None:
        """What a replica has come to; None if it cannot be reached, or has not computed it: then it does not count."""
        for _ in range(TRIES):
            try:
                done = await self.ask_at(path, "tmr.before", order)
                if done.problem == NEEDS_STATE:
                    whole = msgspec.structs.replace(order, state=before, log=self._standing.log.entries())
                    done = await self.ask_at(path, "tmr.before", whole)
            except StaleLeader:
                raise
            except PeerLost:
                continue  # Another one has joined or gone meanwhile: this one may be there still.
            except (ActorStopped, NotFollowing):
                return None  # That life is over: the root knows, and counts on it no more.
            except HoldfastError:
                break
            if not done.problem:
                return done
            break
        self._strayed.append(path)
        return None

    async def _tell(self, path: str) -> None:
        try:
            await self.ask_at(path, "tmr.before", Settled(False))
        except HoldfastError:
            return  # It has ended: that is what it was told to.


@dataclasses.dataclass(frozen=True)
class TMR(Mechanism):
    """Triple modular redundancy: three replicas compute each request, and the majority's reply leaves.

    Args:
        voter: what decides; not a `Median`: all replicas run the same code, and who differs from it is faulty.
    """

    name: ClassVar[str] = "tmr"
    replicas: ClassVar[int] = 3
    tolerates: ClassVar[frozenset[str]] = frozenset({"crash", "transient_value", "permanent_value"})
    needs: ClassVar[frozenset[str]] = frozenset({"determinism", "state_access"})
    bandwidth: ClassVar[str] = "low"
    cpu: ClassVar[str] = "high"
    units: ClassVar[int] = 3
    layer: ClassVar[str] = "replication"
    keeps_members: ClassVar[bool] = True
    cost: ClassVar[Cost | None] = Cost(latency=2, total=3, requests=4, recovery=0.02)
    roles: ClassVar[dict[str, Role]] = {
        "leader": Role(before=ComputingAlong, after=Voting),
        "follower": Role(before=ComputingAlong, computes=False),
    }

    voter: Any = MAJORITY

    def __post_init__(self) -> None:
        object.__setattr__(self, "voter", voter_of(self.voter))
        if type(self.voter) is Median:
            raise ValueError("TMR: its replicas are to be alike, so none is outvoted by a Median; take Tolerance(...)")
