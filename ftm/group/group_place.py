"""The place of a protected actor: the life at its address is lived by a group of replicas.

Its home feeds, holds, journals and answers as for any recorded actor. An actor without recovery has a home as long as
it is protected: nothing is kept of what it has handled, and when no replica is left it begins afresh.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError, StartFailed
from ...actors.exit_reasons import KILLED, ExitReason, pack_exit, unpack_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Start
from ...actors.kernel.address_host import AddressHost, Parent, Place
from ...actors.kernel.cell import DOWN, GONE, RUNNING, Cell
from ...actors.kernel.lifecycle import NEAR
from ...actors.migration.move import Gate
from ...actors.process.resource_limits import limits_data
from ...checkpoint.home.homes import Homes
from ...checkpoint.home.journal_home import Entered, JournalHome
from ...checkpoint.method import Method
from ...checkpoint.protocol import Restore
from ...supervision.backoff import Backoff
from ...supervision.respec import replace_mechanism, respec
from ...supervision.spec import ChildSpec, Flags, child
from ...supervision.supervisor import Supervisor
from ..bricks.brick_messages import Lead
from ..bricks.replica_orders import Finish, Install, Setting
from ..events import ReplicaLost
from ..model.detection import Detection
from ..model.mechanism import NOTHING, compose, detection_in, has_state_access
from .detector import Detector
from .failover import FailoverManager, why_ended
from .group import Group, Look
from .join import Joiner
from .membership import fault_of
from .probation import Probation
from .proxy import Proxy, Settle
from .reconfiguration import (
    OVER,
    PREPARING,
    REST_WITHIN,
    TIDYING,
    AdaptationEngine,
    CannotAdapt,
    Reconfiguration,
    names_for,
)
from .steering import bind, bind_again, give_order
from .transient_homes import UNKEPT, TransientHome, is_unkept

if TYPE_CHECKING:
    from ...actors.control.orders_lane import Call
    from ...checkpoint.home.switch import Switch
    from ...checkpoint.protocol import TurnEnd
    from ..model.mechanism import Mechanism

LED_WITHIN = 60.0
"""Seconds that the first replica may take to take up its state."""
JOINED_WITHIN = 10.0
"""Seconds that a start waits for another replica to catch up; after that the first one goes on alone."""
FINISHED_WITHIN = 3600.0
"""Seconds that `on_stop` may take; whoever has ordered the end keeps the time."""
REPLICA_SHUTDOWN = 20.0
"""Seconds that a replica may take to end its bricks, before its process is killed."""
BUILT_WITHIN = 60.0
"""Seconds that the processes of a group may take to come up."""
BRICKS_INTENSITY = 100
"""Ends of parts and replicas within `BRICKS_PERIOD` seconds after which the whole group is given up."""
BRICKS_PERIOD = 5.0


class GroupPlace(Place):
    """Replicas, each in a process of its own."""

    is_here = False

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
        self.ended_at = time.time()  # when the last group ended, by the system's clock
        self.probation: Probation | None = None  # of the stack that there is, if it is not trusted yet
        self._starting: asyncio.Task[None] | None = None
        self._ending: asyncio.Task[None] | None = None
        self._stop_wanted: ExitReason | None = None
        self._careful: set[int] = set()
        self._joined: asyncio.Future[None] | None = None

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
        await home.gate("restart")
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
            if start is not None and not has_state_access(start.kind) and not switch.turns:
                group.joins_early = True  # Nobody can be brought to what it has when it has handled something.
                await self.protected(group)
            await home.replay(cell, group, entered)
            await self.protected(group)
        except BaseException as error:
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
            self.stop(cell, self._stop_wanted)

    async def build(self, cell: Cell, switch: Switch) -> Group:
        """Start the parts and the replicas.

        Raises:
            StartFailed: one of them could not be started.
        """
        names = tuple(f"r{number}" for number in range(1, max(layer.replicas for layer in self.layers) + 1))
        self.epoch += 1
        group = self.group = Group(
            cell, switch, names, epoch=self.epoch, config=self.config, detection=self.detection
        )  # fmt: skip
        group.careful = {key for key in self._careful if key in switch.open}
        self.take_over(cell, group)
        group.is_held = len(names) > 1
        group.keeps_members = any(layer.keeps_members for layer in self.layers)
        group.secure(self.layers[0])
        if group.link is not None:
            await group.link.ready()
        ftm = cell.node.cell_below(cell, "ftm")
        ftm.extra()
        recipe = Start(
            Supervisor, (Flags(intensity=BRICKS_INTENSITY, period=BRICKS_PERIOD), self._children(cell, group))
        )
        try:
            up = lifecycle.begin(ftm, recipe)
        except BaseException:
            lifecycle.retire(ftm, "it could not be started")
            raise
        ftm.ended().add_done_callback(lambda done: self._parts_ended(cell, group))
        if up is not None:
            done, _ = await asyncio.wait((up,), timeout=BUILT_WITHIN)
            if not done:
                raise StartFailed(cell.path, f"its replicas were not up within {BUILT_WITHIN:g} s")
            up.result()
        return group

    def take_over(self, cell: Cell, group: Group) -> None:
        """What happens to the group happens to the life at the address."""
        group.on_live = group.switch.from_life
        group.on_over = lambda why: self._fell(cell, group)
        group.on_start_failed = lambda end: self._start_failed(cell, end)
        group.on_ended = lambda reason: self._ended_itself(cell, unpack_exit(reason))
        group.on_joined = self._has_joined
        group.on_fault = lambda name, why: self._at_fault(group, name, why)
        group.drops = lambda end: self.probation is not None and self.probation.drops(end)
        group.back_to = lambda: self._back_to(group)
        group.went_back = lambda back: self._went_back(cell, group, back)
        if self.probation is not None:
            self.probation.moved(group)
        group.on_joining = lambda name: bind_again(cell, group, name)

    def _children(self, cell: Cell, group: Group) -> tuple[ChildSpec, ...]:
        parts = (
            child("proxy", Start(Proxy, (group,))),
            child("detector", Start(Detector, (group,))),
            child("failover", Start(FailoverManager, (group, self._step))),
            child("join", Start(Joiner, (group,))),
            child("adapt", Start(AdaptationEngine, (group, *self._adapting(cell, group), self._step))),
        )
        return parts + tuple(self._replica_spec(cell, name, self.config, self.layers) for name in group.names)

    def _replica_spec(self, cell: Cell, name: str, config: int, layers: tuple[Mechanism, ...]) -> ChildSpec:
        return child(
            name,
            self._replica_start(cell, name, config, layers),
            isolation="process",
            shutdown=REPLICA_SHUTDOWN,
            backoff=Backoff(initial=0.01, maximum=2.0, reset_after=5.0),
        )

    def _replica_start(self, cell: Cell, name: str, config: int, layers: tuple[Mechanism, ...]) -> Start[Any]:
        more = cell.extra()
        bindings = {port: target.path for port, target in more.bindings.items()}
        usual, method = Detection(), self.home.method.data()
        interval, watch_turns = usual.interval, usual.watch_turns or 0.0
        setting = Setting(cell.path, name, config, method, bindings, interval, watch_turns, more.claimed)
        return self.replica(
            setting, self.parent.recipe(cell), tuple(layer.for_replicas().describe() for layer in layers)
        )

    # -- other mechanisms -------------------------------------------------------------------------------------------

    async def adapt(
        self,
        cell: Cell,
        mechanism: Any,
        switched: Callable[[], None],
        rest_within: float = REST_WITHIN,
        gate: Gate | None = None,
    ) -> Reconfiguration:
        """Go on with another stack of mechanisms.

        Args:
            cell: the address.
            mechanism: the whole new stack.
            switched: called at the instant from which on it is the one.
            rest_within: seconds within which what is inside has to come to its end.
            gate: where it waits when all is ready.

        Raises:
            CannotAdapt: why it stays as it was.
        """
        group = self.group
        if group is None or group.is_over or self._ending is not None:
            raise CannotAdapt(cell.path, "it is being recovered; try again")
        for back in (group.change, group.gone_back):
            if back is not None and back.is_back and not back.outcome.done():  # It is told as settled, and ends soon.
                await asyncio.wait((back.outcome,))
                return await self.adapt(cell, mechanism, switched, rest_within, gate)
        if group.change is not None:
            raise CannotAdapt(cell.path, "it is being changed already")
        self.last_config += 1
        change = group.change = Reconfiguration(group, self.last_config, compose(mechanism), rest_within)
        change.gate = gate
        self.on_switched = switched
        group.tell("adapt", Look())
        await asyncio.shield(change.outcome)
        return change

    # -- probation --------------------------------------------------------------------------------------------------

    def _put_on_probation(
        self, cell: Cell, group: Group, before: tuple[Mechanism, ...], change: Reconfiguration
    ) -> None:
        earlier = self.probation
        if earlier is not None and earlier.is_over:
            earlier = None
        self.probation = Probation(
            group, before, change, earlier, lambda: self._begin_going_back(cell), self._probation_over
        )  # fmt: skip

    def attached(self, cell: Cell, group: Group) -> None:
        """There was no mechanism before."""
        change = Reconfiguration(group, self.config, self.layers, REST_WITHIN)
        self._put_on_probation(cell, group, NOTHING, change)
        group.copy = group.switch.ledger.newest

    def _probation_over(self, probation: Probation) -> None:
        if self.probation is probation:
            earlier = probation.earlier
            is_wanted = not probation.settled.result().is_kept and earlier is not None and not earlier.is_over
            self.probation = earlier if is_wanted else None

    def _at_fault(self, group: Group, name: str, why: str) -> None:
        """A replica fails by its own doing: what it prepares is given up; a stack that is new gives way."""
        if group.change is not None and group.change.is_preparing and not group.change.is_back:
            group.change.give_up(f"{name} has failed when it prepared it: {why}")
        if self.probation is not None and group is self.group:
            self.probation.failed(f"{name}: {why}")

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
        """The mechanisms as data."""
        return [msgspec.to_builtins(layer.describe()) for layer in self.layers]

    def spec_data(self, cell: Cell) -> dict[str, Any]:
        """What the spec says of where the next lives are lived, as data."""
        said: dict[str, Any] = {"layers": self.described()}
        if isinstance(cell.spec, ChildSpec):
            said |= {"isolation": cell.spec.isolation, "limits": limits_data(cell.spec.limits)}
        return said

    def _back_to(self, group: Group) -> Reconfiguration | None:
        """What whoever leads next has to be brought to first."""
        probation = self.probation
        if probation is None or probation.is_over or not probation.why or group is not self.group:
            return None
        if probation.back is None or probation.back.outcome.done():
            self.last_config += 1
            probation.back = Reconfiguration(group, self.last_config, probation.before, REST_WITHIN)
            probation.back.is_back = True
        return probation.back

    def _begin_going_back(self, cell: Cell) -> None:
        """Go back while the group is led; if nobody leads now, whoever leads next is brought back."""
        group = self.group
        if group is None or group.is_over or self._ending is not None:
            return
        other = group.change
        if other is not None:
            other.give_up("the mechanism before comes back")  # Tried again soon.
            return
        back = self._back_to(group)
        if back is not None and back.stage == PREPARING:
            group.change = back
            group.tell("adapt", Look())

    def _went_back(self, cell: Cell, group: Group, back: Reconfiguration) -> None:
        """Whoever is to lead has the stack before, and so have all that are started from now on."""
        if back.stage == OVER or back is not self._back_to(group):
            return
        back.stage = TIDYING
        back.names = names_for(group, back.layers)
        self._switch_to(cell, group, back)
        if group.change is not back:
            group.gone_back = back
        group.tell("adapt", Look())

    def _adapting(self, cell: Cell, group: Group) -> tuple[Any, Any]:
        """What the engine needs of us: the spec of a replica, and how a change is made to last."""

        def spec(name: str, config: int, layers: tuple[Mechanism, ...]) -> ChildSpec:
            return self._replica_spec(cell, name, config, layers)

        def switched(change: Reconfiguration) -> None:
            self._switch_to(cell, group, change)

        return spec, switched

    def _switch_to(self, cell: Cell, group: Group, change: Reconfiguration) -> None:
        """This stack is the one from now on."""
        before, probation = self.layers, self.probation
        self.layers, self.config = change.layers, change.config
        group.config, group.detection = change.config, self.detection
        group.keeps_members = any(layer.keeps_members for layer in change.layers)
        group.secure(change.layers[0], change.link)
        for name in group.names:
            one = group.cell_of(name)
            if one is not None:
                respec(one, self._replica_start(cell, name, change.config, change.layers))
        if not change.is_back:
            self._put_on_probation(cell, group, before, change)
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
        first = group.names[0]
        life = group.life_of(first)
        if not life:
            raise StartFailed(group.path, f"{first} has ended")
        protocol = group.protocol(first)
        try:
            pieces = switch.restore_records()
            if not pieces and switch.ledger.state_turn >= 0:
                pieces = [Restore(b"")]  # It begins afresh, but its turns are counted on.
            traps = traps or any(piece.traps for piece in pieces)
            for index, piece in enumerate(pieces, 1):
                is_last = index == len(pieces)
                await protocol.ask(
                    Install(group.epoch, switch.ledger.state_turn, piece.data, switch.ledger.stash, is_last, [], traps),
                    LED_WITHIN,
                )
            await protocol.ask(Lead(group.epoch, group.config), LED_WITHIN)
        except HoldfastError as error:
            raise StartFailed(
                group.path, f"{first} cannot lead: {await why_ended(group, first, life, error)}"
            ) from error
        group.members[first] = life
        group.primary, group.is_begun = first, True
        group.bind_proxy()
        group.watch(first)
        group.wake()

    async def protected(self, group: Group) -> None:
        """Wait until somebody could take over, but not for ever: then it goes on alone, and says so."""
        if len(group.names) == 1 or len(group.members) > 1 or group.is_over:
            group.go_on()
            return
        joined = self._joined = group.node.loop.create_future()
        group.wake()
        done, _ = await asyncio.wait((joined,), timeout=JOINED_WITHIN)
        self._joined = None
        if not done:
            group.node.emit(ReplicaLost(group.path, group.names[1], group.epoch, "it has not caught up yet"))
        if group.is_over:
            raise StartFailed(group.path, group.why)
        group.go_on()

    def _has_joined(self) -> None:
        if self._joined is not None and not self._joined.done():
            self._joined.set_result(None)

    def _start_failed(self, cell: Cell, end: TurnEnd) -> None:
        error = (
            cell.node.codec.decode_error(end.answer.kind, end.answer.name, end.answer.body) if end.answer.kind else ""
        )
        switch = self.home.switch
        if switch is not None:
            switch.life.fail(StartFailed(cell.path, f"on_start raised {error}" if error else "on_start raised"))

    # -- ending -----------------------------------------------------------------------------------------------------

    def _fell(self, cell: Cell, group: Group) -> None:
        """No replica is left that could lead: the life is over, and whose fault it was may be known."""
        if cell.host.place is not self:
            return  # It has never been its life: another one goes on.
        self._has_joined()
        suspect = group.only_suspect_input()
        self._careful = {one.feed.id for one in group.out.requests} if group.out is not None else set()
        first = group.cell_of(group.names[0])
        reason: ExitReason = KILLED if first is None or first.more is None else first.more.reason
        for name in group.names:
            one = group.cell_of(name)
            if one is not None and one.more is not None and not one.more.reason.is_clean:
                reason = one.more.reason
        if self._starting is not None and not self._starting.done() and not group.is_live:
            switch = self.home.switch
            if switch is not None:
                switch.life.fail(StartFailed(cell.path, group.why))
            return
        self._begin_end(cell, reason, suspect)

    def _parts_ended(self, cell: Cell, group: Group) -> None:
        """The mechanism's supervisor has given up."""
        if group is self.group and not group.is_over:
            group.is_over, group.why = True, "the supervisor of its mechanism has given up"
            group.on_over(group.why)

    def _ended_itself(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is RUNNING and self._ending is None:
            self._begin_end(cell, reason, -1)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        group = self.group
        if cell.state is not RUNNING or self._ending is not None:
            return
        if group is None or not group.is_live or (self._starting is not None and not self._starting.done()):
            self._stop_wanted = reason
            return
        group.is_stopping = True
        context = cell.node.base_context.copy()  # Not in the name of whoever happens to tell us.
        self._ending = lifecycle.outside_turn(cell, self._finish(cell, group, reason), "stop", context)

    async def _finish(self, cell: Cell, group: Group, reason: ExitReason) -> None:
        """A last snapshot, then `on_stop`, by whoever leads; if that one dies of it, so be it."""
        ended: ExitReason = KILLED
        while group.primary is not None or group.leading is not None:
            primary, epoch = group.primary, group.epoch
            if primary is None or group.inside:
                await asyncio.sleep(0.005)  # Another one is being told to lead, or knows more than the home.
                continue
            try:
                await group.protocol(primary).ask(Finish(epoch, dict(pack_exit(reason))), FINISHED_WITHIN)
                await self._settled(group)
                ended = reason
                break
            except HoldfastError:
                if group.is_over or group.is_well(primary):
                    break
                await asyncio.sleep(0.005)
        await self._end(cell, ended, None)

    async def _settled(self, group: Group) -> None:
        """All that has been told to the proxy has been taken."""
        proxy = group.cell_of("proxy")
        if proxy is not None:
            try:
                await proxy.ref.ask(Settle(), 5.0)
            except HoldfastError:
                return  # It is being restarted; its queue is kept.

    def kill(self, cell: Cell) -> None:
        if cell.state is DOWN and self._starting is not None:
            self._starting.cancel()
        elif cell.state is RUNNING:
            if self._ending is not None:
                self._ending.cancel()
                self._ending = None
            if self._starting is not None and not self._starting.done():
                self._starting.cancel()
            elif self.group is not None:  # Else it has ended already.
                self._begin_end(cell, KILLED, -1, ordered=True)

    def give_up(self, why: str) -> None:
        if self.group is not None and self.group.change is not None:
            self.group.change.give_up(why)

    def end(self, cell: Cell, reason: ExitReason) -> None:
        if self._starting is not None and not self._starting.done():
            self._starting.cancel()
        else:
            self._begin_end(cell, reason, -1, ordered=True)

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
        noticed, copy = time.monotonic(), None if self.group is None else self.group.copy
        await self.dismantle(cell)
        self._ending = None
        if cell.state is not RUNNING:
            return
        if failed is not None:
            reason = KILLED
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
        self.ended_at = time.time()
        if group is not None:
            group.is_over = True
            group.hold.give_back()
            if group.link is not None:
                group.link.close()
            if group.change is not None:
                group.change.close("its life has ended")
        ftm = (cell.children or {}).get("ftm")
        if ftm is None:
            return
        if ftm.state not in (DOWN, GONE):
            ended = ftm.ended()
            ftm.kill()
            await ended
        lifecycle.retire(ftm, "the mechanism has ended")

    def retired(self, cell: Cell) -> None:
        if self._starting is not None and not self._starting.done():
            self._starting.cancel()
        ftm = (cell.children or {}).get("ftm")
        if ftm is not None and ftm.state is not GONE:
            if self.group is not None:
                self.group.is_over = True
                self.group.hold.give_back()
                if self.group.change is not None:
                    self.group.change.close("it has stopped")
            ftm.kill()
        if self.probation is not None:
            self.probation.end(is_kept=True)
        for task in self.left(cell):
            cell.node.end_after(task, cell.path)

    # -- what else a host does --------------------------------------------------------------------------------------

    def control(self, cell: Cell, call: Call) -> None:
        give_order(self.group if cell.host.is_up(cell) else None, cell, call)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """Links and monitors are the home's; a binding is that of the actor in each replica."""
        if verb == "bind" and self.group is not None:
            for name in self.group.names:
                bind(self.group, name, data)

    def is_up(self, cell: Cell) -> bool:
        return self.group is not None and not self.group.is_over

    def running(self, cell: Cell) -> int:
        return -1 if self.group is None else self.group.only_suspect_input()


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
