"""The adaptation engine: another stack of mechanisms for a protected actor, while requests flow (A5, A76 to A82).

The new stack is tried in a replica of its own, which is no part of the group (`trial.py`). Then the bricks that are new
are started in all replicas beside the old ones, in the one that leads last (prepare). Then nothing new goes in, what is
inside comes to its end, and each replica has all that the other has sent to it (rest). Only then the replicas bind
their bricks anew (commit); the old ones end behind that. Requests that come meanwhile wait at the home.

What is under way stands in the group, outside this actor: it may die at any moment, and its next life goes on. Up to
the commit a change can be given up; from there on it is carried to its end, for a replica that has changed stays so. A
replica that has not, though it should have, is killed, and begins again as the recipe then says.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message
from ...supervision.admin import AlreadyPresent, RemoveChild, StartChild
from ...supervision.spec import ChildSpec
from ..bricks.brick_messages import ConfigMismatch, StaleEpoch
from ..bricks.replica_orders import Abort, Commit, Prepare, Quiesce, Stand
from .failover import bury
from .group import Look
from .trial import TRIAL, TrialFailed, tried, until_given_up
from .trial import ended as ended_trial

if TYPE_CHECKING:
    from ...actors.migration.move import Gate
    from ..bricks.sealed_frames import SecuredLink
    from ..model.mechanism import Mechanism
    from .group import Group

PREPARED_WITHIN = 30.0
"""Seconds that a replica may take to start its new bricks, before it is ended; requests flow meanwhile."""
ABORTED_WITHIN = 5.0
"""Seconds that it may take to end them again, before it is ended."""
SECURED_WITHIN = 15.0
"""Seconds within which the authority has to have certified everybody."""
MOST_BROKEN_OFF = 3
"""Replicas that end while they prepare, whoever has ended them: then it is given up."""
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
LOOK_AGAIN = 0.05
"""Seconds after which a group that is busy with itself is looked at again."""

PREPARING, RESTING, COMMITTING, TIDYING, UNDOING, OVER = (
    "preparing",
    "resting",
    "committing",
    "tidying",
    "undoing",
    "over",
)
ALLOWED_WITHIN = 3600.0
"""Seconds that it waits for a transaction whose time limit is shorter."""
STEPS = ("try", "start", "prepare", "rest", "quiesce", "commit", "switch", "tidy")
"""Where the engine may be struck by a test; undoing has `abort` instead of the last three."""


class CannotAdapt(HoldfastError, text="{actor} keeps its mechanism: {why}"):
    """The mechanism stays as it was."""

    actor: str
    why: str


class Reconfiguration:
    """One change of a stack of mechanisms, as far as it has come."""

    def __init__(self, group: Group, config: int, layers: tuple[Mechanism, ...], rest_within: float) -> None:
        self.config, self.layers, self.rest_within = config, layers, rest_within
        self.descriptions = [layer.for_replicas().describe() for layer in layers]
        self.names = names_for(group, layers)
        self.stage = PREPARING
        self.is_back = False  # to what has worked before
        self.is_preparing = False  # replicas start its bricks
        self.is_tried = False
        self.broken_off = 0  # how often a replica has ended, or has changed its part, while it prepared
        self.gate: Gate | None = None  # it waits there when all is ready
        self.link: SecuredLink | None = None  # that of the new stack, if it is another one
        self.given_up: asyncio.Future[str] = group.node.loop.create_future()
        self.prepared: dict[str, int] = {}  # name to life, of those that have the new bricks
        self.epoch = -1  # in which they were prepared
        self.turn = -1  # the last one of the primary when it had come to rest
        self.behind: set[str] = set()  # those that have not got all that the primary had
        self.failed: dict[str, int] = {}  # name to life, of those that have not changed though they should have
        self.started: list[str] = []  # replicas that are new
        self.why = ""  # it is given up
        self.rest_at = self.gone_on_at = 0.0
        self.outcome: asyncio.Future[None] = group.node.loop.create_future()
        self._group = group

    @property
    def is_committed(self) -> bool:
        """Whether the new stack is the one."""
        return self.stage in (TIDYING, OVER) and not self.why

    def give_up(self, why: str) -> None:
        """It is not wanted any more, unless it has gone too far."""
        if self.stage in (PREPARING, RESTING):
            self.why = self.why or why
            if not self.given_up.done():
                self.given_up.set_result(self.why)
            self._group.stir()
            self._group.tell("adapt", Look())

    def close(self, why: str) -> None:
        """The life at the address is over; the next one begins as its recipe says."""
        if self.outcome.done():
            return
        if self.is_committed:
            self.outcome.set_result(None)
        else:
            self.fail(why)

    def fail(self, why: str) -> None:
        """Nothing has changed."""
        if not self.outcome.done():
            self.outcome.set_exception(CannotAdapt(self._group.path, why))
            self.outcome.exception()  # Nobody may wait for it any more.


def names_for(group: Group, layers: tuple[Mechanism, ...]) -> tuple[str, ...]:
    """The replicas that there are to be: those that are there, as far as they are needed, the primary first."""
    wanted = max(layer.replicas for layer in layers)
    there = sorted(group.names, key=lambda name: (name != group.primary, name not in group.members))
    kept = there[:wanted]
    number = 1
    while len(kept) < wanted:
        if f"r{number}" not in group.names:
            kept.append(f"r{number}")
        number += 1
    return tuple(kept)


class AdaptationEngine(Actor):
    """Carries out what `group.change` says. `spec` makes the spec of a replica; `switched` makes a change last."""

    _is_part: ClassVar[bool] = True

    deterministic = False

    def __init__(
        self,
        group: Group,
        spec: Callable[[str, int, tuple[Mechanism, ...]], ChildSpec],
        switched: Callable[[Reconfiguration], None],
        step: Callable[[str], None],
    ) -> None:
        self._group, self._spec, self._switched, self._step = group, spec, switched, step

    def on_start(self, restored: bool) -> None:
        """The last life may have died in the middle of it."""
        self._group.tell("adapt", Look())

    @on(Look)
    async def look(self, message: Look) -> None:
        """Go on with the change, until it is made or undone."""
        group = self._group
        while not group.is_over:
            change = group.change
            if change is None or change.stage is OVER:
                change = group.change = group.gone_back  # Those that only the stack before needs, or does not need.
                group.gone_back = None
            if change is None:
                return
            if change.why and change.stage in (PREPARING, RESTING):
                change.stage = UNDOING
            match change.stage:
                case "preparing":
                    await self._prepare(change)
                case "resting":
                    await self._rest(change)
                case "committing":
                    await self._commit(change)
                case "tidying":
                    await self._tidy(change)
                case _:
                    await self._undo(change)

    # -- while requests flow ------------------------------------------------------------------------------------------

    async def _prepare(self, change: Reconfiguration) -> None:
        """Have all replicas start what is new."""
        group = self._group
        if not group.is_steady():
            await self._wait_for_change(LOOK_AGAIN)
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
        members = {name: life for name, life in group.members.items() if group.is_well(name)}
        epoch, order = group.epoch, Prepare(change.config, change.descriptions)
        self._step("prepare")
        change.is_preparing = True
        # The one that leads comes last: what goes wrong in another one keeps nobody waiting.
        for names in ([name for name in members if name != group.primary], [group.primary]):
            _, errors = await self._ask_all(
                [name for name in names if name in members], order, PREPARED_WITHIN, given_up=change.given_up
            )
            if errors:
                await self._wait_for_change(LOOK_AGAIN)  # If it has died, that is known soon.
                for name, why in errors.items():
                    # Else a failover has broken it off: it is prepared again.
                    if group.epoch == epoch and group.members.get(name) == members[name] and group.is_well(name):
                        change.give_up(f"{name} could not prepare it: {why}")
                        self._replace_late(name, members[name], why)
                    else:
                        change.broken_off += 1
                        if change.broken_off == MOST_BROKEN_OFF:
                            change.give_up(f"{MOST_BROKEN_OFF} replicas have ended while they prepared it, {name} last")
                change.is_preparing = False
                return
        change.is_preparing = False
        if change.stage is PREPARING:  # Else a failover has brought the stack before back meanwhile.
            change.prepared, change.epoch, change.stage = members, epoch, RESTING

    async def _is_safe(self, change: Reconfiguration) -> bool:
        """Whether new bricks may run where the state is: others have it too, as far as somebody else can.

        What a trial does not show may end, or block, any replica that prepares, and another may die meanwhile.
        """
        group, end = self._group, self._now() + WHOLE_WITHIN
        if change.is_back:
            return group.is_steady()  # Whoever is not there comes with bricks that are not wanted.
        while not group.whole_since()[0] and self._now() < end and not change.why:
            await self._wait_for_change(LOOK_AGAIN)
        if not change.why:
            copied = group.keep_copy(change)
            await asyncio.wait((copied, change.given_up), timeout=COPIED_WITHIN, return_when=asyncio.FIRST_COMPLETED)
        return group.is_steady() and not change.why

    async def _try(self, change: Reconfiguration) -> None:
        """See, where it hurts nobody, whether the bricks start and pass a batch on, and whether links can be secured.

        Raises:
            HoldfastError: why it cannot be.
        """
        group, outermost = self._group, change.layers[0]
        if not (change.is_tried or change.is_back):
            self._step("try")
            await tried(group, self._supervisor(), self._spec(TRIAL, change.config, change.layers))
            change.is_tried = True
        if change.link is not None or (group.link is not None and group.link.mechanism == outermost):
            return
        link = group.linked(outermost, lambda: dict.fromkeys((*group.names, *change.names)))
        if link is None:
            return
        try:
            async with asyncio.timeout(SECURED_WITHIN):
                await link.ready()
        except TimeoutError:
            link.close()
            raise TrialFailed(group.path, f"the authority has not answered within {SECURED_WITHIN:g} s") from None
        except BaseException:
            link.close()
            raise
        change.link = link

    def _replace_late(self, name: str, life: int, why: BaseException) -> None:
        """A replica that does not answer in time is ended, and started again, unless it is all there is."""
        group = self._group
        if isinstance(why, AskTimeout) and any(one != name and group.is_well(one) for one in group.members):
            group.suspect(name, life, "it has not answered in time when the mechanism was to be changed")

    async def _start_replicas(self, change: Reconfiguration) -> None:
        """Those that only the new stack needs come up beside the others."""
        above: Any = self._supervisor().ref
        for name in change.names:
            if name in self._group.names or self._group.life_of(name):
                continue
            if name not in change.started:
                change.started.append(name)
            if self._group.cell_of(name) is None:
                self._group.expect(name)
            try:
                await above.ask(StartChild(self._spec(name, change.config, change.layers)), STARTED_WITHIN)
            except AlreadyPresent:
                continue

    def _supervisor(self) -> Cell:
        parent = self.ctx.cell.parent
        assert parent is not None
        return parent

    # -- while they wait ----------------------------------------------------------------------------------------------

    async def _rest(self, change: Reconfiguration) -> None:
        """Nothing new goes in, and all that is inside comes to its end."""
        group = self._group
        if not self._is_as_prepared(change):
            change.stage = PREPARING
            return
        self._step("rest")
        group.is_resting = True
        change.rest_at = time.monotonic()
        if await self._is_at_rest(change) and change.stage is RESTING:
            change.stage, group.is_changing = COMMITTING, True
            return
        self._go_on()
        if change.stage is RESTING:
            change.stage = PREPARING

    def _go_on(self) -> None:
        group = self._group
        group.is_resting = group.is_changing = False
        group.poke()
        group.wake()

    def _is_as_prepared(self, change: Reconfiguration) -> bool:
        """Whether those that count are those that were prepared, in the parts that they had then."""
        group = self._group
        well = {name: life for name, life in group.members.items() if group.is_well(name)}
        return group.is_steady() and group.epoch == change.epoch and well == change.prepared

    async def _is_at_rest(self, change: Reconfiguration) -> bool:
        group = self._group
        end = self._now() + change.rest_within
        primary = group.primary
        if primary is None:
            return False
        self._step("quiesce")
        # All at once, and behind the batch that is out: requests wait for one way there and back, not for one each.
        order, seconds = Quiesce(group.epoch, group.config), change.rest_within + 1.0
        asked = {name: group.protocol(name).ask(order, seconds) for name in change.prepared}
        for future in asked.values():
            future.add_done_callback(_heard)  # If this is given up, nobody looks at it.
        if not await self._ends(group.quiet(), change, end, "a turn of it has not ended"):
            return False
        for name, future in asked.items():
            if change.is_back and name != primary:  # What keeps it may be what is to go: it is replaced.
                await asyncio.wait((future,), timeout=max(0.0, end - self._now()))
                if not future.done():
                    group.suspect(name, change.prepared[name], "it has not come to rest")
            elif not await self._ends(future, change, end, f"{name} has not come to rest"):
                return False
            if not future.done():
                return False
            if (error := future.exception()) is not None:
                if isinstance(error, (ConfigMismatch, StaleEpoch)):
                    change.give_up(f"{name} stands elsewhere: {error}")
                return False
        stands: dict[str, Stand] = {name: future.result() for name, future in asked.items()}
        self._check_stands(change, stands, primary)
        if change.gate is not None and not change.gate.opened.done():
            with change.gate.waiting() as opened:
                if not await self._ends(opened, change, self._now() + ALLOWED_WITHIN, "nobody has said that it may be"):
                    return False
        if change.gate is not None and change.gate.is_closed:
            change.give_up("it is not wanted any more")
        return not change.why and self._is_as_prepared(change)

    def _check_stands(self, change: Reconfiguration, stands: dict[str, Stand], primary: str) -> None:
        """Exactly one leads, and all have the same configuration."""
        group = self._group
        leading = [name for name, stand in stands.items() if stand.leads]
        if leading != [primary]:
            change.give_up(f"{', '.join(leading) or 'nobody'} leads, and it should be {primary} alone")
        configs = {stand.config for stand in stands.values()}
        if configs != {group.config}:
            change.give_up(f"the replicas have different configurations: {sorted(configs)}")
        change.turn = stands[primary].turn

    async def _commit(self, change: Reconfiguration) -> None:
        """Have all replicas bind their bricks anew. As soon as one has, there is no way back."""
        group = self._group
        group.is_resting = group.is_changing = True
        self._step("commit")
        order = Commit(change.config)
        turns, found = await self._ask_until_silent(change, order)
        if found and group.link is not None:  # Done for an earlier life of ours, their links have ended.
            done, _ = await self._ask_all(found, order, COMMITTED_WITHIN, reach=group.entry)
            turns |= done
            found = {name: error for name, error in found.items() if name not in done}
        change.behind = {name for name, turn in turns.items() if turn != change.turn}
        for name, error in found.items():
            # One that has refused has what it had, which all go on with if none has changed.
            if group.life_of(name) == change.prepared[name] and (turns or isinstance(error, AskTimeout)):
                change.failed[name] = change.prepared[name]
                group.suspect(name, change.prepared[name], f"it did not change its mechanism: {error}")
        if not turns:
            change.stage, change.why = UNDOING, f"no replica could: {'; '.join(str(one) for one in found.values())}"
            return
        self._step("switch")
        change.stage = TIDYING
        self._switched(change)
        change.gone_on_at = time.monotonic()
        for name in change.behind:
            if name in group.members and name != group.primary:
                group.lost(name, "it had not got all when the mechanism was changed")
                group.dropped.add(name)
        self._go_on()

    async def _ask_until_silent(
        self, change: Reconfiguration, order: Commit
    ) -> tuple[dict[str, Any], dict[str, BaseException]]:
        """Order all that are prepared, and those again that may not have heard it yet: twice is as good as once."""
        group, begin = self._group, self._now()
        starved = {name: group.starved(name) for name in change.prepared}
        turns: dict[str, Any] = {}
        found: dict[str, BaseException] = {}
        left = list(change.prepared)
        while left:
            done, errors = await self._ask_all(left, order, COMMITTED_WITHIN)
            turns |= done
            found |= errors
            silent = self._now() - begin
            left = [
                name
                for name, error in errors.items()
                if isinstance(error, AskTimeout) and silent - group.excused(name, starved[name]) < COMMITTED_WITHIN
            ]
        return turns, {name: error for name, error in found.items() if name not in turns}

    # -- while requests flow again ------------------------------------------------------------------------------------

    async def _tidy(self, change: Reconfiguration) -> None:
        """Take in the replicas that are new, and end those that are not needed any more."""
        group = self._group
        self._step("tidy")
        self._go_on()
        for name, life in change.failed.items():
            await bury(group, name, life)
        try:
            await self._start_replicas(change)
        except HoldfastError:  # The supervisor of the replicas tries again.
            await self._wait_for_change(LOOK_AGAIN)
        left = [name for name in group.names if name not in change.names]
        if group.primary is None and left:
            await self._wait_for_change(LOOK_AGAIN)
            return
        if left:
            if group.primary in left:  # It has changed over meanwhile.
                change.names = names_for(group, change.layers)
                left = [name for name in group.names if name not in change.names]
            group.names = change.names
            for name in left:
                group.lost(name, "it is not needed any more")
                group.dropped.add(name)
            group.wake()
            await self._end_replicas(left)
        group.names = change.names
        group.wake()
        group.tell("join", Look())
        self._over(change)
        if not change.outcome.done():
            change.outcome.set_result(None)

    async def _end_replicas(self, names: list[str]) -> None:
        above: Any = self._supervisor().ref
        for name in names:
            if self._group.cell_of(name) is None:
                continue
            try:
                await above.ask(RemoveChild(name, erase=True), STARTED_WITHIN)
            except HoldfastError:
                continue  # It is gone already.

    async def _undo(self, change: Reconfiguration) -> None:
        """Everything stays as it was."""
        group = self._group
        self._step("abort")
        self._go_on()
        if change.link is not None:
            change.link.close()
        members = {name: life for name, life in group.members.items() if group.is_well(name)}
        _, errors = await self._ask_all(members, Abort(change.config), ABORTED_WITHIN)
        for name, why in errors.items():
            self._replace_late(name, members[name], why)
        await ended_trial(group, self._supervisor())
        await self._end_replicas(change.started)
        self._over(change)
        change.fail(change.why)

    def _over(self, change: Reconfiguration) -> None:
        change.stage = OVER
        self._group.untrusted.discard(change)
        if self._group.change is change:
            self._group.change = None

    # -- waiting ------------------------------------------------------------------------------------------------------

    def _now(self) -> float:
        return self._group.node.loop.time()

    async def _wait_for_change(self, seconds: float) -> None:
        await asyncio.wait((self._group.stirred(),), timeout=seconds)

    async def _ends(self, future: asyncio.Future[Any], change: Reconfiguration, end: float, why: str) -> bool:
        """Whether it does before the time is over, before a replica dies, and before the change is given up."""
        while not future.done() and not change.why:
            left = end - self._now()
            if left <= 0:
                change.give_up(f"{why} within {change.rest_within:g} s")
                return False
            stirred = self._group.stirred()
            await asyncio.wait((future, stirred), timeout=left, return_when=asyncio.FIRST_COMPLETED)
            if stirred.done() and not self._is_as_prepared(change):
                return False
        return not change.why

    async def _ask_all(
        self,
        names: Iterable[str],
        message: Message[Any],
        seconds: float,
        reach: Callable[[str], Any] | None = None,
        given_up: asyncio.Future[str] | None = None,
    ) -> tuple[dict[str, Any], dict[str, BaseException]]:
        """Order all of these replicas at once: replies, and the errors of those that have not done so.

        Those that have not answered when it is given up are left out.
        """
        group, asked = self._group, dict[str, asyncio.Future[Any]]()
        replies: dict[str, Any] = {}
        errors: dict[str, BaseException] = {}
        for name in names:
            try:
                asked[name] = (reach or group.protocol)(name).ask(message, seconds)
                asked[name].add_done_callback(_heard)  # If this actor is killed, nobody looks at it.
            except HoldfastError as error:
                errors[name] = error
        if given_up is None:
            given_up = self._group.node.loop.create_future()
        if asked:
            all_of_them = asyncio.gather(*asked.values(), return_exceptions=True)
            await asyncio.wait((all_of_them, given_up), return_when=asyncio.FIRST_COMPLETED)
        for name, future in asked.items():
            if not future.done():
                errors[name] = TrialFailed(self._group.path, "it was given up")
            elif (failed := future.exception()) is not None:
                errors[name] = failed
            else:
                replies[name] = future.result()
        return replies, errors


def _heard(done: asyncio.Future[Any]) -> None:
    if not done.cancelled():
        done.exception()
