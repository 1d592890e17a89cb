"""The adaptation engine: another stack of mechanisms for a protected actor, while requests flow (A5, A76 to A82).

The new stack is tried in a replica of its own, which is no part of the group (`trial.py`). Then the bricks that are new
are started in all replicas beside the old ones, in the one that leads last (prepare). Then nothing new goes in, what is
inside comes to its end, and each replica has all that the other has sent to it (rest). Only then the replicas bind
their bricks anew (commit); the old ones end behind that. Requests that come meanwhile wait at the home.

A replica that has not changed, though it should have, is killed, and begins again as the recipe then says.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import TYPE_CHECKING, Any

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import on
from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message
from ...actors.migration.move import UNWANTED
from ...supervision.admin import AlreadyPresent, StartChild
from ...supervision.spec import ChildSpec
from ..bricks.brick_messages import ConfigMismatch, StaleLeader
from ..bricks.replica_orders import Abort, Commit, PrepareStack, Quiesce, Stand
from .membership import LookAgain
from .reconfiguration import names_for, still_silent, what_is_wrong
from .replicas import GroupPart
from .steering import past_resting_turns
from .trial import TRIAL, TrialFailed, removed, tried, until_given_up
from .trial import ended as ended_trial

if TYPE_CHECKING:
    from .group import Group
    from .reconfiguration import Reconfiguration

PREPARED_WITHIN = 30.0
"""Seconds that a replica may take to start its new bricks, before it is ended; requests flow meanwhile."""
ABORTED_WITHIN = 5.0
"""Seconds that it may take to end them again, before it is ended."""
SECURED_WITHIN = 15.0
"""Seconds within which the authority has to have certified everybody."""
WHOLE_WITHIN = 30.0
"""Seconds for which replicas are waited for that are being replaced, before the others prepare."""
COPIED_WITHIN = 5.0
"""Seconds that a batch may take behind which the root gets the state."""
REST_WITHIN = 5.0
"""Seconds within which what is inside has to come to its end; requests wait meanwhile."""
COMMITTED_WITHIN = 5.0
"""Seconds after which a replica that has not changed is killed."""
STARTED_WITHIN = 60.0
"""Seconds that one more replica may take to come up."""
ALLOWED_WITHIN = 3600.0
"""Seconds that it waits for a transaction whose time limit is shorter."""
LOOK_AGAIN = 0.05
"""Seconds after which a group that is busy with itself is looked at again."""


class AdaptationEngine(GroupPart):
    """Carries out what the group's adaptation says."""

    def __init__(self, group: Group, step: Callable[[str], None]) -> None:
        self._group, self._known, self._replicas = group, group.membership, group.replicas
        self._step = step

    def on_start(self, restored: bool) -> None:
        """The last life may have died in the middle of it."""
        self._replicas.tell("adapt", LookAgain())

    @on(LookAgain)
    async def look(self, message: LookAgain) -> None:
        """Go on with the change, until it is made or undone."""
        while not self._known.is_over:
            change = self._group.adaptation.next_change()
            if change is None:
                return
            match change.next_stage():
                case "preparing":
                    await self._prepare(change)
                case "resting":
                    await self._rest(change)
                case "committing":
                    await self._commit(change)
                case "tidying":
                    await self._tidy(change)
                case "undoing" | "over":
                    await self._undo(change)

    # -- while requests flow ------------------------------------------------------------------------------------------

    async def _prepare(self, change: Reconfiguration) -> None:
        """Have all replicas start what is new."""
        known, replicas, preparation = self._known, self._replicas, change.preparation
        if not self._group.is_steady():
            await self._wait_for_change()
            return
        try:
            await until_given_up(self._try(change), change.given_up)
        except HoldfastError as error:
            change.give_up(str(error))
            return
        if not await self._is_safe(change):
            return
        self._step("start")
        try:
            await until_given_up(self._start_replicas(change), change.given_up)
        except HoldfastError as error:
            change.give_up(f"one more replica could not be started: {error}")
            return
        members, epoch = replicas.well(), known.epoch
        self._step("prepare")
        preparation.is_under_way = True
        try:
            errors = await until_given_up(self._have_prepared(change, members), change.given_up)
        except TrialFailed:
            preparation.is_under_way = False
            return
        if errors:
            await self._wait_for_change()  # If it has died, that is known soon.
        for name, found in errors.items():
            # Else a failover has broken it off: it is prepared again.
            if known.epoch == epoch and known.members.get(name) == members[name] and replicas.is_well(name):
                change.give_up(f"{name} could not prepare it: {found}")
                self._replace_late(name, members[name], found)
            elif why := preparation.break_off(name):
                change.give_up(why)
        preparation.is_under_way = False
        if not errors and change.stage == "preparing":  # Else a failover has brought the stack before back meanwhile.
            preparation.lives, preparation.epoch, change.stage = members, epoch, "resting"

    async def _have_prepared(self, change: Reconfiguration, members: dict[str, int]) -> dict[str, BaseException]:
        """Have these replicas start what is new; the errors of those that have not.

        The one that leads comes last: what goes wrong in another one keeps nobody waiting.
        """
        leads, order = self._known.primary, PrepareStack(change.config, change.descriptions)
        _, errors = await self._ask_all([name for name in members if name != leads], order, PREPARED_WITHIN)
        if not errors and leads in members:
            _, errors = await self._ask_all([leads], order, PREPARED_WITHIN)
        return errors

    async def _is_safe(self, change: Reconfiguration) -> bool:
        """Whether new bricks may run where the state is: others have it too, as far as somebody else can.

        What a trial does not show may end, or block, any replica that prepares, and another may die meanwhile.
        """
        group, end = self._group, self._now() + WHOLE_WITHIN
        if change.is_back:
            return group.is_steady()  # Whoever is not there comes with bricks that are not wanted.
        while not self._replicas.whole_since()[0] and self._now() < end and not change.why:
            await self._wait_for_change()
        if not change.why and not group.switch.calls.rests.is_busy:  # Else nothing is copied, perhaps for days.
            copied = group.keep_copy(change)
            await asyncio.wait((copied, change.given_up), timeout=COPIED_WITHIN, return_when=asyncio.FIRST_COMPLETED)
        return group.is_steady() and not change.why

    async def _try(self, change: Reconfiguration) -> None:
        """See, where it hurts nobody, whether the bricks start and pass a batch on, and whether links can be secured.

        Raises:
            HoldfastError: why it cannot be.
        """
        replicas, outermost = self._replicas, change.layers[0]
        if not (change.preparation.is_tried or change.is_back):
            self._step("try")
            await tried(replicas, self._supervisor(), self._spec(TRIAL, change))
            change.preparation.is_tried = True
        if change.link is not None or (replicas.link is not None and replicas.link.mechanism == outermost):
            return
        link = replicas.linked(outermost, lambda: dict.fromkeys((*self._known.names, *change.names)))
        if link is None:
            return
        try:
            async with asyncio.timeout(SECURED_WITHIN):
                await link.ready()
            change.link = link
        except TimeoutError:
            raise TrialFailed(replicas.path, f"the authority has not answered within {SECURED_WITHIN:g} s") from None
        finally:
            if change.link is not link:
                link.close()

    def _spec(self, name: str, change: Reconfiguration) -> ChildSpec:
        return self._group.place.replica_spec(self._replicas.cell, name, change.config, change.layers)

    def _replace_late(self, name: str, life: int, why: BaseException) -> None:
        """A replica that does not answer in time is ended, and started again, unless it is all there is."""
        if isinstance(why, AskTimeout) and any(one != name for one in self._replicas.well()):
            why_replaced = "it has not answered in time when the mechanism was to be changed"
            self._replicas.suspect(name, life, why_replaced)

    async def _start_replicas(self, change: Reconfiguration) -> None:
        """Those that only the new stack needs come up beside the others."""
        above: Any = self._supervisor().ref
        for name in change.names:
            if name in self._known.names or self._replicas.life_of(name):
                continue
            if name not in change.preparation.started:
                change.preparation.started.append(name)
            if self._replicas.cell_of(name) is None:
                self._known.expect(name)
            try:
                await above.ask(StartChild(self._spec(name, change)), STARTED_WITHIN)
            except AlreadyPresent:
                continue

    def _supervisor(self) -> Cell:
        parent = self.ctx._cell.parent
        assert parent is not None
        return parent

    # -- while they wait ----------------------------------------------------------------------------------------------

    async def _rest(self, change: Reconfiguration) -> None:
        """Nothing new goes in, and all that is inside comes to its end."""
        if self._is_as_prepared(change):
            self._step("rest")
            self._group.delivery.is_resting = True
            change.rest_at = time.monotonic()
            if await self._is_at_rest(change) and change.stage == "resting":
                change.stage, self._group.adaptation.is_changing = "committing", True
                return
            self._go_on()
        if change.stage == "resting":
            change.stage = "preparing"

    def _go_on(self) -> None:
        self._group.delivery.is_resting = self._group.adaptation.is_changing = False
        self._group.poke()
        self._replicas.wake()

    def _is_as_prepared(self, change: Reconfiguration) -> bool:
        return self._group.is_steady() and change.preparation.still_holds(self._known, self._replicas.lives())

    async def _is_at_rest(self, change: Reconfiguration) -> bool:
        known, replicas, lives = self._known, self._replicas, change.preparation.lives
        end = self._now() + REST_WITHIN
        primary, config = known.primary, self._group.adaptation.config
        if primary is None:
            return False
        self._step("quiesce")
        # All at once, and behind the batch that is out: requests wait for one way there and back, not for one each.
        order, seconds = Quiesce(known.epoch, config), REST_WITHIN + 1.0
        asked = {name: replicas.ask(name, order, seconds) for name in lives}
        for future in asked.values():
            future.add_done_callback(_heard)  # If this is given up, nobody looks at it.
        quiet = self.ctx.create_task(past_resting_turns(self._group, self._group.quiet()))
        if not await self._ends(quiet, change, end, "a turn of it has not ended"):
            quiet.cancel()
            return False
        for name, future in asked.items():
            if change.is_back and name != primary:  # What keeps it may be what is to go: it is replaced.
                await asyncio.wait((future,), timeout=max(0.0, end - self._now()))
                if not future.done():
                    replicas.suspect(name, lives[name], "it has not come to rest")
            elif not await self._ends(future, change, end, f"{name} has not come to rest"):
                return False
            if not future.done():
                return False
            if (error := future.exception()) is not None:
                if isinstance(error, (ConfigMismatch, StaleLeader)):
                    change.give_up(f"{name} stands elsewhere: {error}")
                return False
        stands: dict[str, Stand] = {name: future.result() for name, future in asked.items()}
        if why := what_is_wrong(stands, primary, config):
            change.give_up(why)
        change.turn = stands[primary].turn
        if change.gate is not None and not change.gate.opened.done():
            with change.gate.waiting() as opened:
                if not await self._ends(opened, change, self._now() + ALLOWED_WITHIN, "nobody has said that it may be"):
                    return False
        if change.gate is not None and change.gate.is_closed:
            change.give_up(UNWANTED)
        return not change.why and self._is_as_prepared(change)

    async def _commit(self, change: Reconfiguration) -> None:
        """Have all replicas bind their bricks anew. As soon as one has, there is no way back."""
        group, known, replicas = self._group, self._known, self._replicas
        group.delivery.is_resting = group.adaptation.is_changing = True
        self._step("commit")
        order = Commit(change.config)
        turns, errors = await self._ask_until_silent(change, order)
        if errors and replicas.link is not None:  # Done for an earlier life of ours, their links have ended.
            done, _ = await self._ask_all(errors, order, COMMITTED_WITHIN, plainly=True)
            turns |= done
            errors = {name: error for name, error in errors.items() if name not in done}
        behind = change.judge_commit(turns, errors, {name: replicas.life_of(name) for name in errors})
        for name, error in errors.items():
            if name in change.failed:
                replicas.suspect(name, change.failed[name], f"it did not change its mechanism: {error}")
        if not turns:
            return
        self._step("switch")
        change.stage = "tidying"
        group.place.switch_to(group, change)
        change.gone_on_at = time.monotonic()
        for name in behind:
            if name in known.members and name != known.primary:
                replicas.lost(name, "it had not got all when the mechanism was changed")
                known.dropped.add(name)
        self._go_on()

    async def _ask_until_silent(
        self, change: Reconfiguration, order: Commit
    ) -> tuple[dict[str, Any], dict[str, BaseException]]:
        """Order all that are prepared, and those again that may not have heard it yet: twice is as good as once."""
        replicas, begin = self._replicas, self._now()
        starved = {name: replicas.starved(name) for name in change.preparation.lives}
        turns: dict[str, Any] = {}
        found: dict[str, BaseException] = {}
        left = list(starved)
        while left:
            done, errors = await self._ask_all(left, order, COMMITTED_WITHIN)
            turns |= done
            found |= errors
            excused = {name: replicas.excused(name, starved[name]) for name in errors}
            left = still_silent(errors, self._now() - begin, excused, COMMITTED_WITHIN)
        return turns, {name: error for name, error in found.items() if name not in turns}

    # -- while requests flow again ------------------------------------------------------------------------------------

    async def _tidy(self, change: Reconfiguration) -> None:
        """Take in the replicas that are new, and end those that are not needed any more."""
        known, replicas = self._known, self._replicas
        self._step("tidy")
        self._go_on()
        for name, life in change.failed.items():
            await replicas.bury(name, life)
        try:
            await self._start_replicas(change)
        except HoldfastError:  # The supervisor of the replicas tries again.
            await self._wait_for_change()
        left = [name for name in known.names if name not in change.names]
        if left and known.primary is None:
            await self._wait_for_change()
            return
        if known.primary in left:  # It has changed over meanwhile.
            change.names = names_for(known, change.layers)
            left = [name for name in known.names if name not in change.names]
        known.names = change.names
        for name in left:
            replicas.lost(name, "it is not needed any more")
            known.dropped.add(name)
        replicas.wake()
        for name in left:
            await removed(replicas, self._supervisor(), name)
        replicas.tell("join", LookAgain())
        self._over(change)
        change.succeed()

    async def _undo(self, change: Reconfiguration) -> None:
        """Everything stays as it was."""
        self._step("abort")
        self._go_on()
        if change.link is not None:
            change.link.close()
        members = self._replicas.well()
        _, errors = await self._ask_all(members, Abort(change.config), ABORTED_WITHIN)
        for name, why in errors.items():
            self._replace_late(name, members[name], why)
        await ended_trial(self._replicas, self._supervisor())
        for name in change.preparation.started:
            await removed(self._replicas, self._supervisor(), name)
        self._over(change)
        change.fail(change.why)

    def _over(self, change: Reconfiguration) -> None:
        self._group.copies.untrusted.discard(change)
        self._group.adaptation.end(change)

    # -- waiting ------------------------------------------------------------------------------------------------------

    def _now(self) -> float:
        return self._replicas.node.loop.time()

    async def _wait_for_change(self) -> None:
        await asyncio.wait((self._replicas.stirred(),), timeout=LOOK_AGAIN)

    async def _ends(self, future: asyncio.Future[Any], change: Reconfiguration, end: float, why: str) -> bool:
        """Whether it does before the time is over, before a replica dies, and before the change is given up."""
        while not future.done() and not change.why:
            left = end - self._now()
            if left <= 0:
                change.give_up(f"{why} within {REST_WITHIN:g} s")
                return False
            stirred = self._replicas.stirred()
            await asyncio.wait((future, stirred), timeout=left, return_when=asyncio.FIRST_COMPLETED)
            if stirred.done() and not self._is_as_prepared(change):
                return False
        return not change.why

    async def _ask_all(
        self, names: Collection[str], message: Message[Any], seconds: float, *, plainly: bool = False
    ) -> tuple[dict[str, Any], dict[str, BaseException]]:
        """Order all of these replicas at once: replies, and the errors of those that have not done so."""

        async def ask(name: str) -> Any:
            ask = self._replicas.reach(name) if plainly else partial(self._replicas.ask, name)
            return await ask(message, seconds)

        found = dict(zip(names, await asyncio.gather(*map(ask, names), return_exceptions=True), strict=True))
        errors = {name: one for name, one in found.items() if isinstance(one, BaseException)}
        return {name: one for name, one in found.items() if name not in errors}, errors


def _heard(done: asyncio.Future[Any]) -> None:
    if not done.cancelled():
        done.exception()
