"""`ActorSystem`: a tree of actors inside a running asyncio program."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Sequence
from importlib.util import find_spec
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar, cast, get_args, overload

from ..actors.control.drain import drain as drain_queue
from ..actors.control.wait_watch import WaitWatch
from ..actors.errors import ActorStopped, HoldfastError, NoSuchActor, SpecError, StoreError, TreeFailed, WrongLoop
from ..actors.events import EventStream, LeadershipTaken, RecoveryTableUnused, ServersAnswer, ServersSilent, StandingBy
from ..actors.exit_reasons import SHUTDOWN, ExitReason, Shutdown, check_reason, pack_exit, raised_in
from ..actors.kernel import lifecycle
from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.address_host import AddressHost
from ..actors.kernel.cell import GONE, Cell, Host, Scope
from ..actors.kernel.lifecycle import LOCAL, NEAR
from ..actors.kernel.mailbox import Bounded
from ..actors.kernel.message import Message
from ..actors.kernel.node import Node, Ports, cell_kind
from ..actors.kernel.ref import ActorRef, Target, current
from ..actors.kernel.topics import publish
from ..actors.loop_watchdog import LoopWatch
from ..actors.process.fork.launch import check_is_program
from ..actors.process.process_host import WorkerPlace, in_process, on_frame
from ..actors.process.worker_pool import Workers
from ..actors.values.path_parts import check_beside, check_topic
from ..checkpoint.engine_calls import Called
from ..checkpoint.home.homes import Homes
from ..checkpoint.home.journal_home import JournalHome
from ..checkpoint.home.next_lives import RuntimeAsks
from ..checkpoint.journal import Journal, StaleEpoch, StoreEngine, StoreFailed
from ..checkpoint.method import Durability
from ..checkpoint.places.far_parent import FarParent
from ..checkpoint.places.life_here import recorded_here
from ..checkpoint.places.subtree_place import subtree
from ..checkpoint.protocol import Wanted
from ..checkpoint.recovery_file import RecoveryFile
from ..checkpoint.recovery_settings import RecoveryHooks
from ..checkpoint.store_key import StoreKey
from ..checkpoint.store_opening import check_system, open_journal
from ..cluster.joining import is_replicated, join
from ..cluster.leadership import LeadershipLost, Standby
from ..cluster.lines.inflow import DEFAULT_LIMITS, ConnectionLimits
from ..cluster.lines.lines import Lines, Transport, new_boot
from ..cluster.log_writer import Deposed
from ..cluster.servers import Servers, ServersSeen
from ..cluster.silence import SilenceOfServers
from ..supervision.admin import NoSuchChild, RemoveChild, StartChild
from ..supervision.children import tell_stopped
from ..supervision.patience import end_within, told_if_held
from ..supervision.respec import respec, to_come
from ..supervision.services.repeatable import bears_repetition
from ..supervision.spec import ChildSpec, Flags
from ..supervision.supervisor import Supervisor, kill_starting
from .controls import Controls
from .full_collections import seldom_collected
from .history.calls import HistoryCalls
from .history.recorder import HistoryRecorder, expect_end
from .last_lines.line_calls import LineCalls
from .last_lines.line_memory import LineMemory
from .live_moves import Moves
from .log.log_sink import LogSink
from .mechanism_notes import MechanismNotes, check_no_part
from .options import ProgramRole, SystemOptions
from .portal import ThreadPortal
from .recorded import Recorded
from .recovery import RecoveryTree
from .script import load_script
from .specification import Specifications
from .system_connection import serve
from .transaction.transaction import Transaction, Transactions

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

A = TypeVar("A", bound=Actor)

MADE_WITH_NODE = ("_homes", "_lines", "_specifications", "_mechanism_notes")
"""Parts that a system has once it is entered."""

ENTRY = f"{__package__}.worker_main:main"
BASE = (f"{__package__}.worker_main",)

REPLICA = f"{__name__.rpartition('.')[0].rpartition('.')[0]}.ftm.replica"
"""What the processes of replicas import beforehand."""
PATIENCE = 10.0
"""Seconds after which a table of the recovery file should have found somebody whom it is for."""

SETTLE_SECONDS = 5.0
"""Seconds that a shutdown waits until a store on other machines has what was written last."""

LONG = 365 * 86_400.0
"""Seconds `start` and `stop` wait: no limit of their own, the child specs say how long a start or an end may take."""


class ActorSystem(Recorded, Controls, HistoryCalls, LineCalls):
    """A tree of actors: an async context manager that lives in whatever loop it is entered in.

    Args:
        name: the first part of all addresses.
        store: where journals and snapshots go: None (memory: survives any process but this one), or
            "sqlite:PATH", or "nats://HOST,HOST/NAME": on several machines (docs/many-machines.md), or an engine of your
            own: anything that keeps to `Journal` (see holdfast.testing.stores); or "configured": what `holdfast.toml`
            and the environment say; or the servers of a simulated fleet (see holdfast.testing.fleet).
        store_key: encrypts the store, "sqlite:PATH" or "nats://...", from its making on: 32 bytes, the path of a file
            that has them and that only its owner may read, or a function that returns them
            (docs/recovery/encryption.md).
        durability: what an admission outlives when it is told of (send returns, an ask is fed, a reply leaves):
            "memory" (without a store) any process but this one, "os" (with one) this one too, "fsync" the machine.
            Each child may say otherwise: `hybrid(durability=...)`.
        standby: with a store on several machines: wait while another program leads the system, until this one does:
            "warm" with what is stored in memory, "cold" without. None: StoreInUse names who leads.
        reachable: "nats://HOST,HOST/NAME": where `hf.connect` of other programs finds this system. A store on several
            machines is that place by itself.
        connection_limits: how much each program that is connected may have outstanding here.
        intensity, period: how many restarts of its direct children the root allows before the tree fails.
        preload: modules the fork server imports beforehand, besides those of the actors it starts.
        log: write crashes, dead letters, output of processes and the like to structlog or standard logging, whichever
            the program has set up (docs/operating.md).
        log_payloads: write what was in the message that an actor has crashed in; else only its type is written.
        history: keep what has happened, in memory and in the store, for `history`, `lives` and `why` (docs/history.md).
        seed: for `ctx.random` of actors without a journal; random if left out.
        watch_lag: tell (LoopLagged) when this process's event loop comes later than this many seconds.
        watch_turns: tell (TurnSlow) of turns in this process that occupy the loop for longer than this many seconds.
            For actors in processes see `Limits(hung_after=...)`.
        watch_waits: tell (TurnWaits) of turns, wherever they run, that take longer than this many seconds with all that
            they wait for, and (StopWaits) of stops. Nothing is ended.
        recovery_hooks: `recovery_hooks(...)`: what is called before and after the phases of every recovery.
        recovery: a recovery file (its path, or from `load_recovery`): how actors are recovered whose child specs do
            not say, and their key variables.

    Leaving the context stops all actors, newest first. If the root supervisor gives up, the body is cancelled and
    TreeFailed is raised; LeadershipLost, if another program has come to lead the system; StoreFailed, if what it had
    recorded was removed from its servers.
    """

    def __init__(
        self,
        name: str = "app",
        *,
        store: str | Journal | Servers | None = None,
        store_key: StoreKey | None = None,
        durability: Durability | None = None,
        standby: Standby | None = None,
        reachable: str | Servers | None = None,
        connection_limits: ConnectionLimits = DEFAULT_LIMITS,
        intensity: int = 3,
        period: float = 5.0,
        preload: Sequence[str] = (),
        log: bool = True,
        log_payloads: bool = False,
        history: bool = True,
        seed: int | None = None,
        takeover: bool = False,
        watch_lag: float | None = None,
        watch_turns: float | None = None,
        watch_waits: float | None = None,
        recovery_hooks: RecoveryHooks | None = None,
        recovery: str | os.PathLike[str] | RecoveryFile | None = None,
    ) -> None:
        store, standby, durability, nats = SystemOptions.configured(store, standby, durability)
        self._options = SystemOptions(
            name=name,
            nats=nats,
            store=store,
            store_key=store_key,
            durability=durability,
            standby=standby,
            reachable=reachable,
            connection_limits=connection_limits,
            flags=Flags("one_for_one", intensity, period),
            preload=tuple(preload),
            log=log,
            log_payloads=log_payloads,
            history=history,
            seed=seed,
            takeover=takeover,
            watch_lag=watch_lag,
            watch_turns=watch_turns,
            watch_waits=watch_waits,
            recovery_hooks=recovery_hooks,
            recovery=recovery,
        )
        self._servers = ServersSeen()
        self._sink: LogSink | None = None
        self._history: HistoryRecorder | None = None
        self._running: Node | None = None
        self._root: Cell | None = None
        self._body: asyncio.Task[Any] | None = None
        self._closing: asyncio.Task[None] | None = None
        self._failure: TreeFailed | LeadershipLost | StoreFailed | None = None
        self._stopping: set[asyncio.Task[None]] = set()
        self._transactions = Transactions()
        self._transport: Transport | None = None
        self._patience: asyncio.TimerHandle | None = None

    @property
    def name(self) -> str:
        """The first part of all addresses."""
        return self._options.name

    @property
    def role(self) -> ProgramRole:
        """Say what this program is to the system: "waiting", "standby", "leader" or "alone".

        It waits while it is being started, and for the servers of its store. It stands by while another program leads.
        The tree runs only in one that leads, or that is alone because its store is not on several machines.
        """
        if self._root is None:
            return "waiting" if self._servers.standing is None else "standby"
        store = self._options.store
        is_shared = isinstance(store, Servers) or (isinstance(store, str) and is_replicated(store))
        return "leader" if is_shared else "alone"

    @property
    def store_name(self) -> str:
        """Return where it keeps what it records, without what stands behind a question mark; empty: in memory."""
        store = self._options.store
        return store.partition("?")[0] if isinstance(store, str) else "" if store is None else type(store).__name__

    @property
    def leader(self) -> str:
        """The machine and process of the program that leads while this one stands by; an empty text otherwise."""
        standing = self._servers.standing
        return "" if standing is None or self._root is not None else standing.leader

    # -- life -------------------------------------------------------------------------------------------------------

    async def __aenter__(self) -> ActorSystem:
        if self._running is not None:
            raise HoldfastError(
                f"system {self.name!r} was entered already; make a new one (`served` and `Service` enter it themselves)"
            )
        check_is_program("ActorSystem")
        options = self._options
        file = options.read_recovery_file()
        node = self._running = Node(self.name, asyncio.get_running_loop(), seed=options.seed)
        lines = LineMemory(node.clock.wall) if options.history else None
        if options.log:
            self._sink = LogSink(self.name, node.loop, log_payloads=options.log_payloads, lines=lines)
            node.events.add_sink(self._sink)
        try:
            engine = await self._open_store(node)
        except BaseException:
            if self._sink is not None:
                self._sink.close()
            raise
        try:
            check_system(engine, self.name)
            self._homes = Homes(
                node,
                engine,
                durability=options.durability,
                file=file,
                hooks=options.recovery_hooks,
                runtime=RuntimeAsks(bears_repetition, to_come),
            )
            self._specifications = Specifications(self._homes, is_kept=options.store is not None)
            self._mechanism_notes = MechanismNotes(self._homes)
            epoch = engine.epoch if engine.safe_at == "sync" else None
            self._lines = Lines(node, self.name, new_boot(epoch), self._homes, options.connection_limits)
            if options.history:
                store = self._homes if self._homes.journal.durable else None
                self._history = HistoryRecorder(node, store, log_payloads=options.log_payloads, lines=lines)
        except HoldfastError as error:
            with contextlib.suppress(HoldfastError):  # What it says now is only what follows from that.
                engine.close()
            if self._sink is not None:
                self._sink.close()
            self._refuse_deposed(error, engine)
            raise
        self._homes.erasures.notes += [self._mechanism_notes.forget_below, self._specifications.forget_below]
        if self._history is not None:
            self._homes.erasures.history = self._history.forget
        RecoveryTree(node, self._homes).begin_with_first_home()
        self._workers = self._make_pool(node)
        if file is not None:
            self._patience = node.loop.call_later(PATIENCE, self._tell_unused)
        self._moves = Moves(node)
        self._watches = (
            LoopWatch(node, options.watch_lag, options.watch_turns),
            WaitWatch(node, options.watch_waits, self._status),
        )
        for watch in self._watches:
            watch.open()
        node.connect(
            Ports(
                host_for=self._host_for,
                complete=self._complete,
                respec=respec,
                outside=self._outside,
                keeper=self._homes,
                run_in_process=self._workers.effects.run,
            )
        )
        self._body = asyncio.current_task()
        root = self._root = node.root = node.cell_below(None, f"/{self.name}")
        flags = self._specifications.root_in_force(root.path, options.flags)
        try:
            up = lifecycle.begin(root, Start(Supervisor, (flags, ())))
            if up is not None:
                await up
            root.ended().add_done_callback(self._root_ended)
            await self._specifications.start_added(
                lambda spec: root.ref.ask(StartChild(spec, unless_stopped=True), LONG)
            )
            if (at := options.reached_at) is not None:
                waits = options.standby is not None
                silence = SilenceOfServers(self._silent, self._answered)
                self._transport = await serve(self._lines, at, options.nats, waits=waits, silence=silence)
        except BaseException as error:  # Nobody is in the body yet who would hear of a failure, or end what has begun.
            await self.__aexit__(type(error), error, error.__traceback__)
            raise
        return self

    async def open(self) -> ActorSystem:
        """Start the system without `async with`, as in a notebook, whose cells are tasks of their own.

        End it with `shutdown`. If the tree fails nobody is cancelled: the log says so, `has_failed` is true, and asks
        end with ActorStopped.

        Raises:
            HoldfastError, StoreInUse, SpecError: as on entering it.
        """
        await self.__aenter__()
        self._body = None  # This task goes on with something else.
        return self

    @property
    def has_failed(self) -> bool:
        """Tell whether the root supervisor gave up, another program leads in its place, or its log is gone."""
        return self._failure is not None

    def store_problem(self, *, for_good: bool = False) -> str:
        """Say why the store takes nothing at the moment; an empty text if it does.

        Args:
            for_good: only what does not pass, so that a new program is needed; a full disk is not.
        """
        journal = self._homes.journal
        error = journal.stopped if for_good else journal.stopped or journal.blocked
        if error is not None:
            return f"the store takes nothing: {error}"
        silent = None if for_good else self._servers.silent
        return f"the store takes nothing: its servers do not answer: {silent.reason}" if silent is not None else ""

    async def _open_store(self, node: Node) -> StoreEngine:
        """The journal of the store; of one on several machines, once this program leads the system."""
        options = self._options
        store = options.store
        if not isinstance(store, Servers) and not (isinstance(store, str) and is_replicated(store)):
            return open_journal(store, takeover=options.takeover, key=options.store_key)
        where = f"/{self.name}"
        journal = await join(
            store,
            self.name,
            options.standby,
            options.nats.told(),
            waits=self._stands_by,
            silent=self._silent,
            answered=self._answered,
            deposed=self._deposed,
            gone=self._gone,
            key=options.store_key,
        )
        node.emit(LeadershipTaken(where, journal.epoch))
        return Called(journal)

    def _stands_by(self, leader: str) -> None:
        """Another program leads, and the start waits until this one does."""
        self._servers.standing = StandingBy(f"/{self.name}", leader)
        self._node.emit(self._servers.standing)

    def _refuse_deposed(self, error: BaseException | None, engine: StoreEngine) -> None:
        """Raise LeadershipLost, if the store has refused something because another program leads."""
        if isinstance(error, StaleEpoch) and engine.safe_at == "sync":
            raise LeadershipLost(self.name, "another program", error.current) from error

    def _silent(self, reason: str) -> None:
        """The servers do not answer."""
        self._servers.silent = ServersSilent(f"/{self.name}", reason)
        self._node.emit(self._servers.silent)

    def _answered(self, seconds: float) -> None:
        """The servers answer again, after so many seconds."""
        self._servers.silent = None
        self._node.emit(ServersAnswer(f"/{self.name}", seconds))

    def _gone(self, failure: StoreFailed) -> None:
        """What was recorded is not on the servers any more: the tree ends, and the body hears of it."""
        if self._closing is None:
            self._fail(failure)

    def _deposed(self, by: Deposed) -> None:
        """Another program leads: the tree ends, and the body hears of it."""
        if self._closing is None:
            self._fail(LeadershipLost(self.name, by.leader, by.current))

    def _fail(self, failure: TreeFailed | LeadershipLost | StoreFailed) -> None:
        self._failure = failure
        if self._body is not None:
            self._body.cancel()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        body = self._body
        try:
            await self.shutdown()
        except StoreError as store_error:  # JournalStopped has told of it: who cancelled the body sees it cancelled.
            if self._failure is None and not isinstance(error, asyncio.CancelledError):
                self._refuse_deposed(store_error, self._homes.journal.engine)
                raise
        if self._failure is not None:
            failure, self._failure = self._failure, None
            if body is not None:  # The cancel was ours: whoever catches TreeFailed must not look cancelled.
                body.uncancel()
            raise failure from (failure.__cause__ if isinstance(error, asyncio.CancelledError) else error)
        self._refuse_deposed(error, self._homes.journal.engine)

    async def shutdown(self) -> None:
        """Stop every actor, newest first, and what belongs to the system. A second call changes nothing.

        Raises:
            WrongThread, WrongLoop: it was opened in another thread, or in another event loop, which has to end it.
        """
        root, node = self._root, self._running
        if root is None or node is None:
            return
        node.check_caller(root.path)
        self._body = None
        if self._closing is None:
            self._closing = node.loop.create_task(self._close(root, node), name=f"shutdown of {self.name}")
        cancelled: asyncio.CancelledError | None = None
        while (
            not self._closing.done()
        ):  # A second SIGTERM must not leave actors behind: first the end, then the cancel.
            try:
                await asyncio.shield(self._closing)
            except asyncio.CancelledError as error:
                cancelled = error
                kill_starting(root)  # But those that are not even there yet are not waited for.
        self._closing.result()
        if cancelled is not None:
            raise cancelled

    async def _close(self, root: Cell, node: Node) -> None:
        self._lines.closing()
        gone = lifecycle.stop_and_wait(root)
        end_within(root, gone)
        await gone
        if self._patience is not None:
            self._patience.cancel()
            self._tell_unused()
        await self._moves.close()
        while node.remains:
            await asyncio.wait(set(node.remains))
        for watch in self._watches:
            watch.close()
        if node.cell_kinds.watcher is not None:
            self.trace_with(None)
        await self._workers.close()
        await node.close()
        with contextlib.suppress(TimeoutError):  # Who keeps the store elsewhere may be away.
            async with asyncio.timeout(SETTLE_SECONDS if self._homes.journal.engine.safe_at == "sync" else None):
                await self._homes.settled()
        self._lines.close()
        if self._transport is not None:
            await self._transport.close()
        if self._history is not None:
            self._history.close()
        try:
            self._homes.close()
        finally:
            node.deadlines.close()
            node.events.close()
            if self._sink is not None:
                self._sink.close()

    def _outside(self, path: str) -> Cell | None:
        """Whoever is reached at an address that is not of a cell of the tree: recorded here, or another system's."""
        return self._homes.addresses.find(path) or self._lines.find(path)

    @property
    def lines(self) -> Lines:
        """The lines to other systems."""
        assert self._node is self._running
        return self._lines

    def _make_pool(self, node: Node) -> Workers:
        """The processes of this system."""
        return Workers(node, ENTRY, (*BASE, *self._options.preload), on_frame)

    def _complete(self, spec: ChildSpec, path: str) -> ChildSpec:
        """A child spec with what the recovery file and earlier roots say of its address."""
        file = self._homes.file
        return self._mechanism_notes.completed(spec if file is None else file.complete(spec, path), path)

    def _host_for(self, spec: ChildSpec) -> AddressHost:
        """Where a child's lives are lived."""
        problem = "" if spec.recovery is None else self._homes.refuses(spec.recovery)
        if problem:
            raise SpecError(spec.id, problem)
        if spec.mechanism is not None:
            return self._group_host(spec)
        if spec.isolation == "process":
            self._workers.want(spec.start.kind.__module__)
            if spec.recovery is not None and spec.recovery.records:
                home = JournalHome(self._homes, spec.recovery, NEAR)
                return AddressHost(home, WorkerPlace(home, NEAR, self._workers, spec.limits), NEAR)
            if spec.is_supervisor:
                return subtree(self._workers, spec.limits, self._homes, self._lives_at_root)
            return in_process(self._workers, spec.limits)
        if spec.recovery is not None and spec.recovery.records:
            return recorded_here(self._homes, spec.recovery)
        return LOCAL

    def _group_host(self, spec: ChildSpec) -> AddressHost:
        """Where the lives of a protected child are lived.

        Raises:
            MechanismRefused: its mechanisms do not go together, or not in this order.
        """
        from ..ftm.group.group_place import protected_host
        from ..ftm.model.composition import check_stack  # Most systems protect nobody.
        from ..ftm.model.mechanism import COMMON, compose

        check_stack(compose(spec.mechanism), spec.start.kind, spec.id)
        self._workers.want(spec.start.kind.__module__)
        self._workers.want(REPLICA)
        for name in COMMON:  # A replica that changes over must not import, and perhaps compile, while requests wait.
            self._workers.want(name)
        recovery = spec.recovery
        method = recovery if recovery is not None and recovery.records else None
        return protected_host(self._homes, method, spec.mechanism)

    def _lives_at_root(self, parent: FarParent, cell: Cell, wanted: Wanted, before: Host) -> AddressHost:
        """The host of a child that is lived at the root, and whose supervisor is in another process.

        Raises:
            MechanismRefused: its mechanisms cannot be had here, or do not go together.
        """
        from ..ftm.migration.subtree_groups import life_at_root
        from ..ftm.model.mechanism import COMMON

        group = life_at_root(parent, cell, wanted, before)
        for name in (REPLICA, *COMMON):
            self._workers.want(name)
        return group

    def _tell_unused(self) -> None:
        """Tell of tables of the recovery file that are for nobody so far: perhaps their names are misspelt."""
        file = self._homes.file
        for table, where in file.take_unmet() if file is not None else ():
            self._node.emit(RecoveryTableUnused(f"/{self.name}", table, where))

    def _root_ended(self, done: asyncio.Future[ExitReason]) -> None:
        """The root supervisor is gone: if nobody asked for that, the body must hear of it."""
        if self._closing is not None or done.cancelled():
            return
        reason, known = done.result(), self._node.supervised
        last, crashed = known.gave_up, known.crashed
        if isinstance(reason, Shutdown) and reason.detail:
            why = reason.detail
        else:
            why = f"its root has ended, {reason}"
            if last is not None:
                why += f"; the last to end was {last.address}/{last.child}: {last.reason}"
        failure, own = TreeFailed(self.name, why), raised_in(reason)
        failure.__cause__ = own if own is not None or crashed is None else raised_in(crashed.reason)
        self._fail(failure)

    # -- starting and finding actors --------------------------------------------------------------------------------

    @property
    def _node(self) -> Node:
        """The node that hosts this process's actors.

        Raises:
            WrongLoop: another loop of its thread runs; some of it, as its numbers, may be read from other threads.
        """
        if self._running is None:
            raise self._not_running()
        if self._running.is_other_loop():
            raise WrongLoop(f"/{self.name}")
        return self._running

    def _not_running(self) -> HoldfastError:
        return HoldfastError(f"system {self.name!r} is not running: use it in `async with`")

    if not TYPE_CHECKING:  # It would hide misspelt names.

        def __getattr__(self, name: str) -> Any:
            """Of the parts that come when the system is entered, say that it was not."""
            if name in MADE_WITH_NODE:
                raise self._not_running()
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)

    def from_thread(self) -> ThreadPortal:
        """Return a handle for other threads, such as those in which a web framework runs its plain `def` endpoints."""
        return ThreadPortal(self._node)

    async def start(self, spec: ChildSpec[A], *, fresh: bool = False) -> ActorRef[A]:
        """Start a child of the root, and wait until it is up; None instead of a ref if it raised `Ignore`.

        One that a transaction has stopped or removed in an earlier program stays so, and the ref is that of its
        address; one that a transaction has moved lives where it was moved, and the ref is that of its new address. With
        `fresh` nothing comes back that was recorded at its address, or below it, before. While the root is
        suspended the start waits: the event `OrderHeld` says so after 5 seconds, and `resume` lets it go on.

        Raises:
            StartFailed: naming the actor and why. AlreadyStarted, AlreadyPresent: the id is in use.
        """
        if not isinstance(spec, ChildSpec):
            raise SpecError("start", f"takes child(...) or supervisor(...), not {spec!r}")
        root = self._root_ref()
        address, known = f"{root.path}/{spec.id}", self._specifications
        if address in known.brought:  # The program says so itself now.
            known.brought.discard(address)
            await root.ask(RemoveChild(spec.id), LONG)
        if (lives_at := known.elsewhere(address, spec, fresh=fresh)) is not None:
            return self._node.ref_at(lives_at)
        wanted: ChildSpec = known.in_force(address, spec, fresh=fresh)
        with seldom_collected(), told_if_held(root._cell.living, "start", address):
            stays = not wanted.autostart and spec.autostart
            order = StartChild(wanted, fresh=fresh, unless_stopped=stays)
            ref = cast("ActorRef[A]", await root.ask(order, LONG))
        for back in known.started(address, spec, wanted, fresh=fresh):
            await root.ask(StartChild(back), LONG)
        await known.start_added(lambda one: root.ask(StartChild(one, unless_stopped=True), LONG))
        await self._homes.journal.safe()
        return self._node.ref_at(address) if stays else ref

    def spawn(self, start: Start[A], name: str | None = None, *, mailbox: Bounded | None = None) -> ActorRef[A]:
        """Start an actor that nobody restarts, in this process, at once (its `on_start` is its first turn).

        Raises:
            NameTaken: the name is in use. StartFailed: `__init__` raised.
        """
        return cast("ActorRef[A]", self._node.spawn(start, name, mailbox=mailbox).ref)

    async def stop(
        self, target: Target, reason: ExitReason = SHUTDOWN, *, drain: bool = False, deadline: float = 5.0
    ) -> None:
        """Stop an actor for good; returns when its children have ended, then its hook has run. Twice is no error.

        What was recorded of it stays: started again under the same id, it is restored.

        Args:
            target: the actor: a ref, or its address.
            reason: what `on_stop` is told.
            drain: let it handle what is queued first, and refuse what is new (an ask fails with ActorStopped, a tell
                is a dead letter). What is left at the deadline goes to `on_undelivered`, as without draining.
            deadline: seconds that draining may take.

        Called by the actor itself, or by one below it, this returns at once: the end comes after the turn.

        Raises:
            SpecError: the reason is none of the library's; or the actor is a part of a mechanism, which would go on
                without it: `terminate` ends its life alone.
        """
        check_reason("stop", reason)
        cell = self._node.meant(target)
        check_no_part(cell)
        expect_end(self._history, cell.path, "it was stopped")
        caller = current.get(None)
        if caller is None or not is_below(caller._cell, cell):
            await self._stop(cell, reason, deadline if drain else None)
            await self._homes.journal.safe()
            return
        node = self._node  # In nobody's name: it has to go on when the caller's life is over.
        task = node.loop.create_task(
            self._stop(cell, reason, deadline if drain else None),
            name=f"stop of {cell.path}",
            context=node.base_context.copy(),
        )
        self._stopping.add(task)
        task.add_done_callback(self._stopping.discard)

    async def _stop(self, cell: Cell, reason: ExitReason, draining: float | None) -> None:
        if draining is not None and not cell.is_dead:
            await drain_queue(cell, draining)
        parent = cell.parent
        if parent is not None and is_supervised(cell, parent):
            supervisor = ActorRef[Supervisor](parent)
            try:
                with told_if_held(parent, "stop", cell.path):
                    await supervisor.ask(RemoveChild(cell.name, pack_exit(reason)), LONG)
            except (NoSuchChild, ActorStopped):  # It has stopped already, or was temporary: its spec went with it.
                pass
        elif not cell.is_dead:
            await lifecycle.stop_in_time(cell, reason)
            tell_stopped(cell, "", "it was stopped")

    @overload
    def ref(self, path: str) -> ActorRef[Any]: ...
    @overload
    def ref(self, path: str, kind: type[A]) -> ActorRef[A]: ...
    def ref(self, path: str, kind: type[Actor] = Actor) -> ActorRef[Any]:
        """Return a ref to the actor at an address; `kind` is its class, or a base of it, if you want the ref typed.

        Between two lives of a child the address is there, and what is sent waits; so it is before the first life of one
        that comes back with its dynamic supervisor.

        Raises:
            NoSuchActor: nobody lives there nor is about to, or its supervisor is between two lives itself.
            WrongActor: another class does.
        """
        return self._node.find_ref(path, kind)

    def _root_ref(self) -> ActorRef[Supervisor]:
        root = self._root
        if root is None:
            raise HoldfastError(f"system {self.name!r} is not running: use it in `async with`")
        return ActorRef(root)

    # -- several changes as one -------------------------------------------------------------------------------------

    def roll_back(self, target: Target) -> None:
        """Have a recorded actor that is stopped begin its next life with its snapshot before the newest.

        What its turns since did to its state is undone (`RolledBack`); what has left stays out.

        Raises:
            ControlFailed: it is not recorded, it runs, or it has no older snapshot.
        """
        self._homes.roll_back(target.path if isinstance(target, ActorRef) else target, "it was asked for")

    def transaction(self, *, dry_run: bool = False, timeout: float = 10.0) -> Transaction:
        """Make several changes of the tree as one: `async with system.transaction() as change: change.add(...)`.

        The body collects; when it ends, all is checked, then done. If the body raises, nothing is done.

        Args:
            dry_run: check only; `change.describe()` then tells what would be done.
            timeout: seconds from the end of the body until all is in force. (What has to follow then has its own time.)

        Raises (at the end of the body):
            TransactionRefused: a check has failed; nothing was done. TransactionFailed: a step has; all was undone.
        """
        self._root_ref()
        return Transaction(self, self._transactions, dry_run=dry_run, timeout=timeout)

    async def apply(self, path: str) -> Any:
        """Run the reconfiguration script at `path`: its `async def reconfigure(system)`, with this system.

        Raises:
            UntrustedFile: somebody else could have written it. SpecError: it is no such script.
        """
        return await load_script(path, self._node).reconfigure(self)

    # -- names, topics, bindings ------------------------------------------------------------------------------------

    def register(self, name: str, target: Target, *, scope: Scope = "system") -> None:
        """Give an actor a name beside its address, for the life that it has.

        Args:
            name: the name.
            target: the actor: a ref, or its address.
            scope: who finds it by the name: "system", or "fleet": other systems and clients that are connected, too.

        Raises:
            NameTaken: somebody else has the name. SpecError: the name or the scope is not valid.
        """
        if scope not in get_args(Scope):
            raise SpecError("register", f"scope must be 'system' or 'fleet', not {scope!r}")
        self._node.register(name, self._node.meant(target), scope=scope)

    def unregister(self, name: str) -> None:
        """Free a name; unknown ones are fine."""
        check_beside("unregister", name)
        self._node.unregister(name)

    def whereis(self, name: str) -> ActorRef[Any]:
        """Return a ref to the actor with this name. Raises NoSuchActor."""
        check_beside("whereis", name)
        cell = self._node.names.get(name)
        if cell is None:
            raise NoSuchActor(name)
        return cell.ref

    async def publish(self, topic: str, message: Message[Any]) -> None:
        """Send to every subscriber of a topic, and return when each has accepted; it waits for room at bounded ones."""
        check_topic("publish", topic)
        await publish(self._node, topic, message, lambda cell: cell.ref.send(message))

    def bind(self, owner: Target, port: str, target: Target) -> None:
        """Point a binding elsewhere; the owner sees it from its next turn on. Raises SpecError, or NoSuchActor.

        It lasts until the supervisor of the owner is restarted. `change.bind`, in a transaction, is for good.
        """
        self._node.bind(self._node.meant(owner), port, self._node.meant(target))

    # -- looking at it ----------------------------------------------------------------------------------------------

    def events(self) -> EventStream:
        """Return a new stream of events from here on: `async for event in stream`; close it when done."""
        return self._node.events.listen()

    def trace_with(self, tracer: Tracer | None, *, one_in: float = 100, baggage: bool = False) -> None:
        """Make spans of OpenTelemetry from now on: of asks, tells and turns, of restarts and recoveries.

        What is sent inside of a span that is sampled continues its trace, and the turns that follow from it are in it.
        Of what is sent from outside of any, one message in so many begins a trace. It needs the extra `traces`.

        Args:
            tracer: makes the spans in this process; None ends it. (In actors' processes: the global tracer provider.)
            one_in: so many messages from no trace begin one; `math.inf`: none does.
            baggage: what is in the sender's baggage goes along with every message, sampled or not.

        Raises:
            SpecError: `one_in` is less than 1, or the extra is not installed.
        """
        if not one_in >= 1:
            raise SpecError("trace_with", f"one_in must be a number from 1 on, not {one_in!r}")
        if find_spec("opentelemetry") is None:
            raise SpecError("trace_with", "needs the package opentelemetry-api: pip install 'holdfast[traces]'")
        from .traced_events import trace_system  # Most systems are not traced, and need no OpenTelemetry.

        trace_system(self._node, tracer, 1 / one_in, baggage=baggage)

    @property
    def dead_letters(self) -> int:
        """Messages that nobody handled, so far."""
        return self._node.numbers.dead_letters

    def pid_of(self, target: Target) -> int:
        """Return the pid of the OS process that an actor lives in now: its own, or this one.

        A protected actor lives in the process of the replica that leads.

        Raises:
            NoSuchActor: it lives nowhere at the moment.
        """
        meant = self._node.meant(target)
        cell: Cell | None = meant
        if meant.state is GONE:
            raise NoSuchActor(meant.path)
        while cell is not None:
            place = cell.host.place
            worker = place.process(cell)
            if worker is not None:
                return int(worker.pid)
            if place.owns_processes:
                raise NoSuchActor(meant.path)
            cell = cell.parent
        return os.getpid()

    @property
    def late_replies(self) -> int:
        """Replies that came when nobody waited any more, so far."""
        return self._node.numbers.late_replies

    def tree(self) -> list[str]:
        """List the addresses that live now, parents before children."""
        found: list[str] = []
        waiting = [self._root] if self._root is not None else []
        while waiting:
            cell = waiting.pop()
            found.append(cell.path)
            waiting.extend(reversed(list((cell.children or {}).values())))
        return found


def is_below(cell: Cell, top: Cell) -> bool:
    """Whether an actor is another, or below it."""
    at: Cell | None = cell
    while at is not None and at is not top:
        at = at.parent
    return at is not None


def is_supervised(cell: Cell, parent: Cell) -> bool:
    """Whether a supervisor looks after the actor; in another process that is known by the supervisor's class only."""
    if parent.actor is not None:
        return cell.spec is not None and isinstance(parent.actor, Supervisor)
    kind = cell_kind(parent)
    return kind is not None and issubclass(kind, Supervisor)
