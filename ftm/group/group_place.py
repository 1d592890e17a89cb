"""The place of a protected actor: a group of replicas lives the life at its address.

Its home feeds, holds, journals and answers as for any recorded actor. An actor without recovery has a home as long as
it is protected: nothing is kept of what it has handled, and when no replica is left it begins afresh.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.backoff import Backoff
from ...actors.errors import HoldfastError, StartFailed
from ...actors.exit_reasons import KILLED, ExitReason, crash, pack_exit, unpack_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Start
from ...actors.kernel.address_host import AddressHost, Parent, Place
from ...actors.kernel.cell import DOWN, GONE, RUNNING, Cell
from ...actors.kernel.lifecycle import NEAR
from ...actors.migration.move import CommitGate
from ...actors.process.resource_limits import limits_data
from ...checkpoint.home.homes import Homes
from ...checkpoint.home.journal_home import Entered, JournalHome
from ...checkpoint.method import Method
from ...checkpoint.protocol import Restore
from ...supervision.respec import replace_mechanism, respec
from ...supervision.spec import ChildSpec, Flags, child
from ...supervision.supervisor import Supervisor
from ..bricks.brick_messages import Lead
from ..bricks.replica_orders import Finish, Install, Setting
from ..events import ReplicaLost
from ..model.detection import Detection
from ..model.mechanism import NOTHING, compose, detection_in
from .adaptation_engine import AdaptationEngine
from .detector import Detector
from .failover import FailoverManager
from .group import Group
from .join import Joiner
from .membership import LookAgain, Membership
from .probation import UNJUDGED, Probation
from .proxy import Proxy, TakeAll
from .reconfiguration import CannotAdapt, Reconfiguration, names_for
from .replicas import fault_of
from .steering import LOOK_AGAIN, bind, give_order, leave_resting
from .transient_homes import UNKEPT, TransientHome, is_unkept

if TYPE_CHECKING:
    from ...actors.control.orders_lane import QueuedOrder
    from ...actors.process.worker_pool import Worker
    from ...checkpoint.home.switch import Switch
    from ...checkpoint.protocol import Live, TurnEnd
    from ..bricks.sealed_frames import SecuredLink
    from ..model.mechanism import Mechanism

LED_WITHIN = 60.0
"""Seconds that the first replica may take to take up its state."""
JOINED_WITHIN = 10.0
"""Seconds that a start waits for another replica to catch up; after that the first one goes on alone."""
FINISHED_WITHIN = 3600.0
"""Seconds that `on_stop` may take; whoever has ordered the end keeps the time."""
REPLICA_SHUTDOWN = 20.0
"""Seconds that a replica may take to end its bricks, before its process is killed."""
REPLICA_BACKOFF = Backoff(initial=0.01, maximum=0.8, reset_after=1.0)
"""Waits before a replica is started again: with jitter less than a second, for the last one may be alone meanwhile."""
BUILT_WITHIN = 60.0
"""Seconds that the processes of a group may take to come up."""
BRICKS_FLAGS = Flags(intensity=100, period=5.0)
"""How many ends of parts and replicas, within how many seconds, do not give up the whole group."""


class GroupPlace(Place):
    """Replicas, each in a process of its own."""

    is_here = False
    kind = "replicas"
    owns_processes = True

    def __init__(self, home: JournalHome, parent: Parent, mechanism: Any) -> None:
        self.home, self.parent = home, parent
        self.layers = compose(mechanism)
        self.group: Group | None = None
        self.epoch = 0
        self.config = 1
        self.replica: Callable[..., Start[Any]] = replica
        self.last_config = 1  # that was ever given to a stack of mechanisms
        self.on_step: Callable[[str], None] | None = None  # for tests: called before each step of a failover
        self.on_switched: Callable[[], None] = lambda: None
        self.ended_at = home.homes.node.clock.wall()  # when the last group ended
        self.probation: Probation | None = None  # of the stack that there is, if it is not trusted yet
        self._starting: asyncio.Task[None] | None = None
        self._ending: asyncio.Task[None] | None = None
        self._stop_wanted: ExitReason | None = None
        self._careful: set[int] = set()

    @property
    def is_ending(self) -> bool:
        """Whether the replicas have been told to end, or are to be."""
        return self._ending is not None or self._stop_wanted is not None

    def process(self, cell: Cell) -> Worker | None:
        """The process of the replica that leads."""
        group = self.group
        leader = None if group is None else group.membership.primary
        return None if group is None or leader is None else group.replicas.worker_of(leader)

    def known_as(self, cell: Cell) -> str:
        """The address of the actor in the replica that leads."""
        group = self.group
        leader = None if group is None else group.membership.primary
        return cell.path if group is None or leader is None else group.replicas.place(f"{leader}/server")

    def replica_states(self) -> dict[str, str]:
        """How each replica does; none while the actor is being recovered."""
        group = self.group
        if group is None or group.membership.is_over:
            return {}
        known = group.membership
        return {name: known.state_of(name, group.replicas.life_of(name)) for name in known.names}

    def handed_to(self, parent: Parent) -> None:
        """The replicas stay: another supervisor hears of the end of the life."""
        self.parent = parent

    @property
    def detection(self) -> Detection:
        """How the replicas are watched: as the outermost mechanism says that says anything about it."""
        return detection_in(self.layers) or Detection()

    # -- beginning --------------------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> asyncio.Future[None]:
        start = cell.extra().start
        if start is not None:
            cell.table = start.kind._table
        self._stop_wanted = None
        entered = self.home.enter(cell)  # Now: from here on what is sent is admitted by the home.
        self._starting = lifecycle.outside_turn(cell, self._recover(cell, entered))
        return self._starting

    async def _recover(self, cell: Cell, entered: Entered) -> None:
        home, switch = self.home, entered.switch
        await home.let_begin()
        if not home.is_gated:
            home.isolated()
        if cell.state is not DOWN:
            raise StartFailed(cell.path, "it was stopped while it started")
        cell.life += 1
        cell.state = RUNNING
        try:
            group = await self.build(cell, switch)
            home.subscribe(cell, self.parent.topics(cell))
            await self.lead(group, switch)
            start = cell.extra().start
            if start is not None and not start.kind.state_access and not switch.turns:
                group.joins_early = True  # Nobody can be brought to what it has when it has handled something.
                await self.protected(group)
            ends = switch.ledger.own_end.wanted
            if ends is not None:
                self._stop_wanted = ends.exit_reason
            await home.replay(cell, group, entered)
            await self.protected(group)
        except BaseException as error:
            if cell.host.place is not self:
                return  # It was up, though not protected yet, and its life was carried elsewhere.
            if isinstance(error, asyncio.CancelledError):
                error = StartFailed(cell.path, "it was stopped while it started")
            failed = error if isinstance(error, StartFailed) else StartFailed(cell.path, str(error))
            reason = cell.extra().reason if cell.state is not RUNNING else KILLED
            ending = lifecycle.outside_turn(cell, self._end(cell, reason, failed), "end")
            cell.node.end_after(ending, cell.path)  # Whoever gives up the address meanwhile gives up this task alone.
            await asyncio.shield(ending)
            if not isinstance(error, HoldfastError):
                raise
            raise failed from error
        home.clock = None
        if self._stop_wanted is not None:
            self._begin_to_finish(cell, group, self._stop_wanted)

    async def build(self, cell: Cell, switch: Switch) -> Group:
        """Start the parts and the replicas.

        Raises:
            StartFailed: one of them could not be started.
        """
        names = tuple(f"r{number}" for number in range(1, max(layer.replicas for layer in self.layers) + 1))
        self.epoch += 1
        group = self.group = Group(cell, switch, self, Membership(names, self.epoch))
        group.delivery.careful = {key for key in self._careful if key in switch.open}
        if self.probation is not None:
            self.probation.moved(group)
        group.delivery.is_held = len(names) > 1
        group.membership.keeps_members = any(layer.keeps_members for layer in self.layers)
        group.replicas.secure(self.layers[0])
        if group.replicas.link is not None:
            await group.replicas.link.ready()
        ftm = cell.node.cell_below(cell, "ftm")
        ftm.extra()
        recipe = Start(Supervisor, (BRICKS_FLAGS, self._children(cell, group)))
        try:
            up = lifecycle.begin(ftm, recipe)
        except BaseException:
            lifecycle.retire(ftm, "it could not be started")
            raise
        ftm.ended().add_done_callback(lambda done: self._parts_ended(group))
        if up is not None:
            done, _ = await asyncio.wait((up,), timeout=BUILT_WITHIN)
            if not done:
                raise StartFailed(cell.path, f"its replicas were not up within {BUILT_WITHIN:g} s")
            up.result()
        return group

    def _children(self, cell: Cell, group: Group) -> tuple[ChildSpec, ...]:
        parts = (
            child("proxy", Start(Proxy, (group,))),
            child("detector", Start(Detector, (group.replicas,))),
            child("failover", Start(FailoverManager, (group, self._step))),
            child("join", Start(Joiner, (group,))),
            child("adapt", Start(AdaptationEngine, (group, self._step))),
        )
        return parts + tuple(self.replica_spec(cell, name, self.config, self.layers) for name in group.membership.names)

    def replica_spec(self, cell: Cell, name: str, config: int, layers: tuple[Mechanism, ...]) -> ChildSpec:
        """How a replica is started that has the stack with this number."""
        start = self._replica_start(cell, name, config, layers)
        return child(name, start, isolation="process", shutdown=REPLICA_SHUTDOWN, backoff=REPLICA_BACKOFF)

    def _replica_start(self, cell: Cell, name: str, config: int, layers: tuple[Mechanism, ...]) -> Start[Any]:
        more = cell.extra()
        bindings = {port: target.path for port, target in more.bindings.items()}
        usual, method = Detection(), self.home.method.data()
        interval, watch_turns = usual.interval, usual.watch_turns or 0.0
        setting = Setting(name, config, method, bindings, interval, watch_turns, more.claimed)
        return self.replica(
            setting, self.parent.recipe(cell), tuple(layer.for_replicas().describe() for layer in layers)
        )

    # -- other mechanisms -------------------------------------------------------------------------------------------

    async def adapt(
        self, cell: Cell, mechanism: Any, switched: Callable[[], None], gate: CommitGate | None = None
    ) -> Reconfiguration:
        """Go on with another stack of mechanisms.

        Args:
            cell: the address.
            mechanism: the whole new stack.
            switched: called at the instant from which on it is the one.
            gate: where it waits when all is ready.

        Raises:
            CannotAdapt: why it stays as it was.
        """
        group = self.group
        if group is None or group.membership.is_over or self._ending is not None:
            raise CannotAdapt(cell.path, "it is being recovered; try again")
        for back in (group.adaptation.change, group.adaptation.gone_back):
            if back is not None and back.is_back and not back.outcome.done():  # It is told as settled, and ends soon.
                await asyncio.wait((back.outcome,))
                return await self.adapt(cell, mechanism, switched, gate)
        if group.adaptation.change is not None:
            raise CannotAdapt(cell.path, "it is being changed already")
        change = self._change(group, compose(mechanism))
        change.gate, group.adaptation.change, self.on_switched = gate, change, switched
        if gate is not None:
            gate.on_closed(change.give_up)
        group.replicas.tell("adapt", LookAgain())
        await asyncio.shield(change.outcome)
        return change

    def _change(self, group: Group, layers: tuple[Mechanism, ...], *, is_back: bool = False) -> Reconfiguration:
        self.last_config += 1
        path, names, loop = group.replicas.path, names_for(group.membership, layers), group.replicas.node.loop
        return Reconfiguration(path, self.last_config, layers, names, loop, group.stir_engine, is_back)

    # -- probation --------------------------------------------------------------------------------------------------

    def _put_on_probation(self, group: Group, before: tuple[Mechanism, ...]) -> None:
        earlier = None if self.probation is None or self.probation.is_over else self.probation
        self.probation = Probation(group, before, earlier)

    def attached(self, group: Group) -> None:
        """There was no mechanism before."""
        self._put_on_probation(group, NOTHING)
        group.copies.begin()

    def probation_over(self, probation: Probation) -> None:
        """It is known whether a stack stays; the one before may not be trusted either."""
        if self.probation is probation:
            earlier = probation.earlier
            is_wanted = not probation.settled.result().is_kept and earlier is not None and not earlier.is_over
            self.probation = earlier if is_wanted else None

    def at_fault(self, group: Group, name: str, why: str) -> None:
        """A replica fails by its own doing: what it prepares is given up; a stack that is new gives way."""
        change = group.adaptation.change
        if change is not None and change.preparation.is_under_way and not change.is_back:
            change.give_up(f"{name} has failed when it prepared it: {why}")
        if self.probation is not None and group is self.group:
            self.probation.failed(f"{name}: {why}")

    def drops(self, end: TurnEnd) -> bool:
        """Whether a request that bricks have let fall is asked again, of the stack before."""
        return self.probation is not None and self.probation.drops(end)

    def _judge(self, cell: Cell, fault: str, why: str) -> None:
        """No replica is left: if that is the fault of a stack that is new, the next life begins with the one before."""
        probation = self.probation
        if probation is None or probation.is_over or not (probation.why or fault):
            return
        probation.why = probation.why or why
        self.last_config += 1
        self.layers, self.config = probation.before, self.last_config
        self.respecified(cell)
        probation.went_back()

    def respecified(self, cell: Cell) -> None:
        """The next lives have the stack that there is now."""
        replace_mechanism(cell, dataclasses.replace(cell.spec, mechanism=as_spec(self.layers)))
        self.parent.respecified(cell, self.spec_data(cell))

    def described(self) -> list[Any]:
        """Describe the stack of mechanisms as data."""
        return [msgspec.to_builtins(layer.describe()) for layer in self.layers]

    def spec_data(self, cell: Cell) -> dict[str, Any]:
        """What the spec says of where the next lives are lived, as data."""
        said: dict[str, Any] = {"layers": self.described()}
        if isinstance(cell.spec, ChildSpec):
            said |= {"isolation": cell.spec.isolation, "limits": limits_data(cell.spec.limits)}
        return said

    def back_to(self, group: Group) -> Reconfiguration | None:
        """Find the stack that whoever leads next has to be brought to first."""
        probation = self.probation
        if probation is None or probation.is_over or not probation.why or group is not self.group:
            return None
        if probation.back is None or probation.back.outcome.done():
            probation.back = self._change(group, probation.before, is_back=True)
        return probation.back

    def begin_going_back(self) -> None:
        """Go back while the group is led; if nobody leads now, whoever leads next is brought back."""
        group = self.group
        if group is None or group.membership.is_over or self._ending is not None:
            return
        other = group.adaptation.change
        if other is not None:
            other.give_up("the mechanism before comes back")  # Tried again soon.
            return
        back = self.back_to(group)
        if back is not None and back.stage == "preparing":
            group.adaptation.change = back
            group.replicas.tell("adapt", LookAgain())

    def went_back(self, group: Group, back: Reconfiguration) -> None:
        """Whoever is to lead has the stack before, and so have all that are started from now on."""
        if back.stage == "over" or back is not self.back_to(group):
            return
        back.stage = "tidying"
        back.names = names_for(group.membership, back.layers)
        self.switch_to(group, back)
        if group.adaptation.change is not back:
            group.adaptation.gone_back = back
        group.replicas.tell("adapt", LookAgain())

    def switch_to(self, group: Group, change: Reconfiguration) -> None:
        """This stack is in force from now on."""
        before, probation, cell, replicas = self.layers, self.probation, group.replicas.cell, group.replicas
        self.layers, self.config = change.layers, change.config
        group.adaptation.config = change.config
        group.membership.keeps_members = any(layer.keeps_members for layer in change.layers)
        replicas.watch_as(self.detection)
        replicas.secure(change.layers[0], change.link)
        for name in group.membership.names:
            one = replicas.cell_of(name)
            if one is not None:
                respec(one, self._replica_start(cell, name, change.config, change.layers))
        if not change.is_back:
            self._put_on_probation(group, before)
            self.on_switched()
            self.parent.respecified(cell, self.spec_data(cell))
        elif probation is not None:
            self.respecified(cell)
            group.send_again()  # What the bricks have let fall; they are at rest.
            probation.went_back()

    def _step(self, name: str) -> None:
        if self.on_step is not None:
            self.on_step(name)

    async def lead(self, group: Group, switch: Switch, *, traps: bool = False) -> None:
        """Give the first replica what there is, and have it lead; `traps`: the life that comes to it traps exits.

        Raises:
            StartFailed: it could not.
        """
        known, replicas = group.membership, group.replicas
        first = known.names[0]
        life = replicas.life_of(first)
        if not life:
            raise StartFailed(replicas.path, f"{first} has ended")
        try:
            pieces = switch.restore_records(maps=False)  # A replica takes its state as it takes that of its leader.
            if not pieces and switch.ledger.state_turn >= 0:
                pieces = [Restore(b"")]  # It begins afresh, but its turns are counted on.
            traps = traps or any(piece.traps for piece in pieces)
            variables = tuple(name for piece in pieces for name in piece.variables)
            timers = {key: clock for piece in pieces for key, clock in piece.timers.items()}
            for index, piece in enumerate(pieces, 1):
                is_last = index == len(pieces)
                turn, stash = switch.ledger.state_turn, switch.ledger.stash
                order = Install(known.epoch, turn, piece.data, stash, is_last, [], traps, variables, timers)
                await replicas.ask(first, order, LED_WITHIN)
            await replicas.ask(first, Lead(known.epoch, self.config), LED_WITHIN)
        except HoldfastError as error:
            why = await replicas.why_ended(first, life, error)
            raise StartFailed(replicas.path, f"{first} cannot lead: {why}") from error
        known.members[first] = life
        known.primary, known.is_begun = first, True
        replicas.bind_proxy()
        replicas.watch(first)
        replicas.wake()

    async def protected(self, group: Group) -> None:
        """Wait until somebody could take over, but not for ever: then it goes on alone, and says so."""
        known, replicas = group.membership, group.replicas
        if len(known.names) > 1 and len(known.members) < 2 and not known.is_over:
            replicas.wake()
            try:
                async with asyncio.timeout(JOINED_WITHIN):
                    await replicas.have_backup()
            except TimeoutError:
                replicas.node.emit(ReplicaLost(replicas.path, known.names[1], known.epoch, "it has not caught up yet"))
            if known.is_over:
                raise StartFailed(replicas.path, known.why)
        group.go_on()

    def life_is_up(self, group: Group, live: Live) -> None:
        """The life has caught up."""
        group.switch.from_life(msgspec.structs.replace(live, promises=None))  # Replicas get states in other ways, too.

    def start_failed(self, group: Group, end: TurnEnd) -> None:
        """The actor could not be started."""
        kind, name, body = end.answer.kind, end.answer.name, end.answer.body
        error = group.replicas.node.codec.decode_error(kind, name, body) if kind else ""
        self._fail(group, f"on_start raised {error}" if error else "on_start raised")

    def _fail(self, group: Group, why: str) -> None:
        if self.home.switch is not None:
            self.home.switch.life.fail(StartFailed(group.replicas.path, why))

    # -- ending -----------------------------------------------------------------------------------------------------

    def has_fallen(self, group: Group, why: str) -> None:
        """No replica is left that could lead: the life is over, and whose fault it was may be known."""
        cell, delivery = group.replicas.cell, group.delivery
        if cell.host.place is not self:
            return  # It has never been its life: another one goes on.
        self._careful = set() if delivery.out is None else {one.feed.id for one in delivery.out.requests}
        if self._starting is not None and not self._starting.done() and not delivery.is_live:
            self._fail(group, why)
            return
        ends = self._ends(group)
        faults = [reason for reason in ends if not reason.is_clean]
        self._begin_end(cell, [KILLED, *ends[:1], *faults][-1], delivery.only_suspect_input())

    def _ends(self, group: Group) -> list[ExitReason]:
        """How the replicas have ended last, in their order."""
        cells = [group.replicas.cell_of(name) for name in group.membership.names]
        return [one.more.reason for one in cells if one is not None and one.more is not None]

    def _parts_ended(self, group: Group) -> None:
        """The mechanism's supervisor has given up."""
        if group is self.group and not group.membership.is_over:
            group.fall("the supervisor of its mechanism has given up")

    def has_ended_itself(self, group: Group, reason: dict[str, Any]) -> None:
        """The actor has stopped, and with it its life."""
        cell = group.replicas.cell
        if cell.state is RUNNING and self._ending is None:
            self._begin_end(cell, unpack_exit(reason), -1)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        group = self.group
        if cell.state is not RUNNING or self._ending is not None:
            return
        if group is None or not group.delivery.is_live or (self._starting is not None and not self._starting.done()):
            self._stop_wanted = reason
        else:
            self._begin_to_finish(cell, group, reason)

    def _begin_to_finish(self, cell: Cell, group: Group, reason: ExitReason) -> None:
        group.delivery.is_stopping = True
        context = cell.node.base_context.copy()  # Not in the name of whoever happens to tell us.
        self._ending = lifecycle.outside_turn(cell, self._finish(cell, group, reason), "stop", context)

    async def _finish(self, cell: Cell, group: Group, reason: ExitReason) -> None:
        """A last snapshot, then `on_stop`, by whoever leads; if that one dies of it, so be it.

        Behind the turn in hand, or before it, if it rests, for that may be for days: the next life goes on with that.
        """
        ended: ExitReason = KILLED
        known, replicas, quiet = group.membership, group.replicas, group.quiet()
        while known.primary is not None or known.leading is not None:
            primary, epoch = known.primary, known.epoch
            if primary is None or group.delivery.inside:
                await asyncio.sleep(0.005)  # Another one is being told to lead, or knows more than the home.
                continue
            if not (await asyncio.wait((quiet,), timeout=LOOK_AGAIN))[0]:
                await leave_resting(group)
                continue
            try:
                await replicas.ask(primary, Finish(epoch, dict(pack_exit(reason))), FINISHED_WITHIN)
                proxy = replicas.cell_of("proxy")
                if proxy is not None:
                    with contextlib.suppress(HoldfastError):  # It is being restarted; its queue is kept.
                        await proxy.ref.ask(TakeAll(), 5.0)  # All that it was told has been taken.
                ended = reason
                break
            except HoldfastError:
                if known.is_over or replicas.is_well(primary):
                    break
                await asyncio.sleep(0.005)
        await self._end(cell, ended, None)

    def kill(self, cell: Cell) -> None:
        if cell.state is DOWN and self._starting is not None:
            self._starting.cancel()
        elif cell.state is RUNNING:
            if self._ending is not None and self.group is not None:  # Else its replicas are being ended already.
                self._ending.cancel()
                self._ending = None
            if self._starting is not None and not self._starting.done():
                self._starting.cancel()
            elif self.group is not None:  # Else it has ended already.
                self._begin_end(cell, KILLED, self.running(cell), ordered=True)

    def end(self, cell: Cell, reason: ExitReason) -> None:
        if self._starting is not None and not self._starting.done():
            self._starting.cancel()
        else:
            self._begin_end(cell, reason, self.running(cell), ordered=True)

    def left(self, cell: Cell) -> list[asyncio.Future[Any]]:
        return [task for task in (self._ending, self._starting) if task is not None and not task.done()]

    def _begin_end(self, cell: Cell, reason: ExitReason, running: int, *, ordered: bool = False) -> None:
        if self._ending is not None and not self._ending.done():
            return
        end = self._end(cell, reason, None, running, ordered=ordered)
        self._ending = lifecycle.outside_turn(cell, end, "end")

    async def _end(
        self, cell: Cell, reason: ExitReason, failed: StartFailed | None, running: int = -1, *, ordered: bool = True
    ) -> None:
        """End all replicas, then the life at the address."""
        noticed, copy = time.monotonic(), None if self.group is None else self.group.copies.newest
        ends = [] if self.group is None else self._ends(self.group)
        await self.dismantle(cell)
        self._ending = None
        if cell.state is not RUNNING or cell.host.place is not self:
            return  # Its life was carried elsewhere meanwhile, and goes on there.
        if failed is not None:
            reason = next((end for end in (*ends, crash(failed)) if end.common_cause), KILLED)
        if not ordered:
            if isinstance(self.home, TransientHome):
                self.home.copy = copy
            self._judge(cell, fault_of(reason), f"no replica is left: {failed or reason}")

        def over(recovers: bool | None) -> None:
            self.home.over(
                cell, running, str(failed or reason), ordered=ordered or running < 0, noticed=noticed, reason=reason,
                recovers=recovers,
            )  # fmt: skip

        self.parent.life_over(cell, reason, over)

    async def dismantle(self, cell: Cell) -> None:
        """End the mechanism; returns when all of its processes have been reaped."""
        group, self.group = self.group, None
        self.ended_at = cell.node.clock.wall()
        if group is not None:
            group.close("its life has ended")
            if group.replicas.link is not None:
                group.replicas.link.close()
        ftm = (cell.children or {}).get("ftm")
        if ftm is None:
            return
        if ftm.state not in (DOWN, GONE):
            ended = ftm.ended()
            if group is not None:
                group.replicas.dismiss()
            ftm.kill()
            await ended
        lifecycle.retire(ftm, "the mechanism has ended")

    def retired(self, cell: Cell) -> None:
        if self._starting is not None and not self._starting.done():
            self._starting.cancel()
        ftm = (cell.children or {}).get("ftm")
        if ftm is not None and ftm.state is not GONE:
            if self.group is not None:
                self.group.close("it has stopped")
                self.group.replicas.dismiss()
            ftm.kill()
        if self.probation is not None:
            self.probation.end(is_kept=True, why=UNJUDGED)
        for task in self.left(cell):
            cell.node.end_after(task, cell.path)

    # -- what else a host does --------------------------------------------------------------------------------------

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        give_order(self.group if cell.host.is_up(cell) else None, cell, call)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """Links and monitors are the home's; a binding is that of the actor in each replica."""
        if verb == "bind" and self.group is not None:
            for name in self.group.membership.names:
                bind(self.group.replicas, name, data)

    def readdress(self, cell: Cell, was: str, now: str) -> None:
        if self.link is not None:
            self.link.readdress(cell.path)

    @property
    def link(self) -> SecuredLink | None:
        """The root's end of the links to its replicas, if they are secured, and it lives."""
        return None if self.group is None else self.group.replicas.link

    def is_steady(self, cell: Cell) -> bool:
        group = self.group
        if group is None or not group.is_steady():
            return False
        known, replicas = group.membership, group.replicas
        return all(replicas.life_of(name) == known.up.get(name) for name in known.names)

    def is_up(self, cell: Cell) -> bool:
        return self.group is not None and not self.group.membership.is_over

    def running(self, cell: Cell) -> int:
        return -1 if self.group is None else self.group.delivery.only_suspect_input()

    def may_have_begun(self, cell: Cell, key: int) -> bool:
        return False  # Of what was given to the replicas the ask itself says so.


def as_spec(layers: tuple[Mechanism, ...]) -> Any:
    """Layers as a spec has them: one alone stands there as it is."""
    return layers[0] if len(layers) == 1 else layers


def replica(setting: Setting, start: Start[Any] | bytes, layers: tuple[Any, ...]) -> Start[Any]:
    """The recipe of a replica."""
    from ..replica.replica import Replica

    return Start(Replica, (setting, start, layers))


def protected_host(homes: Homes, method: Method | None, mechanism: Any, parent: Parent = NEAR) -> AddressHost:
    """The host of an actor that a mechanism protects; `method`: None if it has no recovery."""
    is_kept = method is not None and not is_unkept(method)
    home = JournalHome(homes, method or UNKEPT, parent) if is_kept else TransientHome(homes, parent)
    return AddressHost(home, GroupPlace(home, parent, mechanism), parent)
