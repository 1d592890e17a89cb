"""The replica: a supervisor, in a process of its own, of the bricks and the protected actor.

It weaves the layers of a composition into bricks and bindings. When the layers or the role change, new bricks are
started beside the old ones, everything is bound anew, and the old ones end: only those that differ are touched.

Orders are carried out in tasks, one after the other, and never in the replica's turn: whatever a brick or the protected
actor waits for, the replica can be stopped, and an order to lead ends the preparation of another stack.
"""

from __future__ import annotations

import asyncio
import dataclasses
from contextlib import suppress
from typing import Any, ClassVar, NamedTuple

from ...actors.errors import HoldfastError, StartFailed, StartIgnored, remote_crash, type_name
from ...actors.events import ActorStarted
from ...actors.exit_reasons import SHUTDOWN, ExitReason, Shutdown
from ...actors.kernel.actor import Start, on, start
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, message_of
from ...actors.process.wire.start_codec import unpack_recipe
from ...checkpoint.life.recorded_life import FED
from ...checkpoint.method import Method
from ...supervision.children import STOPPED, UP, Child, new_cell
from ...supervision.spec import Flags, Plan, child
from ...supervision.supervisor import Supervisor
from ..bricks.brick_messages import FORWARDED, Work
from ..bricks.bricks import FOREVER, After, AwaitHandled, Before, Brick, Flush, Proceed
from ..bricks.replica_orders import Abort, Broken, Commit, PrepareStack, Setting
from ..bricks.request_protocol import InnerProtocol, RequestProtocol
from ..bricks.sealed_frames import Opened, Refused
from ..bricks.standing import Standing, protected_at
from ..bricks.state_transfer import Assume, Play
from ..model.mechanism import Description, Mechanism, MechanismRefused, detection_in, revive
from .heartbeat import Heart, HeartbeatDue
from .protected_actor import Server
from .state_manager import StateManager

SERVER, STATE, BEAT, PROTOCOL = "server", "state", "beat", "protocol"


class EndBricks(Message):
    """From the replica to itself: these are not needed any more."""

    names: list[str]


Order = Assume | PrepareStack | Commit | Abort | EndBricks | Play
ORDERS = (Assume, PrepareStack, Commit, Abort, Play)
"""What a replica obeys."""

STARTED_WITHIN = 10.0
"""Seconds that `__init__` and `on_start` of a brick may take."""
CAUGHT_UP_WITHIN = 4.0
"""Seconds that a follower may take to come to the end of what it was sent, when the mechanism is changed."""
SETTLED_WITHIN = 6.0
"""Seconds after which a brick that is not needed any more is ended, whatever is still in its mailbox."""


class PlacedBrick(NamedTuple):
    """A brick in the graph: its class, and the mechanism whose it is (None: it passes through)."""

    kind: type[Brick]
    mechanism: Mechanism | None
    name: str  # that it would like


PARTS: dict[str, type[Brick]] = {"before": Before, "proceed": Proceed, "after": After}


def nested(layers: tuple[Mechanism, ...]) -> tuple[Mechanism, ...]:
    """The same layers as they are woven: assertions stand inside replication, so that no state leaves unchecked.

    For whoever reads a composition they stand outside: what they check is what the replicas have come to.
    """
    replication = [one for one in layers if one.layer == "replication"]
    if not replication:
        return layers
    moved = [one for one in layers if one.layer == "assertion"]
    kept = [one for one in layers if one.layer != "assertion"]
    at = kept.index(replication[-1]) + 1
    return (*kept[:at], *moved, *kept[at:])


def weave(layers: tuple[Mechanism, ...], *, leads: bool) -> dict[str, PlacedBrick]:
    """The bricks of a composition, by slot, outermost layer first.

    Raises:
        MechanismRefused: a mechanism stands in it twice, or two want to compute.
    """
    places: dict[str, PlacedBrick] = {PROTOCOL: PlacedBrick(RequestProtocol, None, PROTOCOL)}
    proceed: tuple[type[Proceed], Mechanism | None] = (Proceed, None)
    for index, one in enumerate(layers):
        role, prefix = one.role(leads=leads), f"{one.name}." if index else ""
        if f"{one.name}.before" in places:
            raise MechanismRefused(one.name, "it stands in the composition twice")
        if index:
            places[f"{one.name}.protocol"] = PlacedBrick(InnerProtocol, None, f"{prefix}protocol")
            if one.secures:
                raise MechanismRefused(one.name, "it secures the links: it stands outermost, and once")
        for part, kind in PARTS.items():
            check_brick(one, part, getattr(role, part) or kind)
        before, after = role.before or Before, role.after or After
        places[f"{one.name}.before"] = PlacedBrick(before, one if role.before else None, f"{prefix}before")
        places[f"{one.name}.after"] = PlacedBrick(after, one if role.after else None, f"{prefix}after")
        if role.proceed is not None and role.proceed is not Proceed:
            if proceed[0] is not Proceed:
                raise MechanismRefused(one.name, f"{proceed[1] and proceed[1].name} wants a Proceed of its own too")
            proceed = role.proceed, one
    places["proceed"] = PlacedBrick(proceed[0], proceed[1], "proceed")
    return places


def check_brick(mechanism: Mechanism, part: str, kind: object) -> None:
    """Whether a class can stand there.

    Raises:
        MechanismRefused: it is no brick of that sort, or lacks a binding.
    """
    base = PARTS[part]
    if not isinstance(kind, type) or not issubclass(kind, base):
        raise MechanismRefused(mechanism.name, f"its {part} must be a {base.__name__}, not {kind!r}")
    missing = [port for port in base._bindings if port not in kind._bindings]
    if missing:
        raise MechanismRefused(mechanism.name, f"{type_name(kind)} has no binding {', '.join(missing)}")
    more = sorted(set(kind._bindings) - set(base._bindings))
    if more:
        raise MechanismRefused(mechanism.name, f"nothing would be bound to {', '.join(more)} of {type_name(kind)}")


@dataclasses.dataclass
class Woven:
    """A stack of mechanisms as it stands, or is prepared: which child plays which slot."""

    config: int
    layers: tuple[Mechanism, ...]
    places: dict[str, PlacedBrick]
    names: dict[str, str]  # slot to child
    new: list[str]


class Replica(Supervisor):
    """One of the lives of a protected actor, with the bricks around it. The crash of any brick is its end."""

    _is_part: ClassVar[bool] = True

    def __init__(
        self, setting: Setting, start: Start[Any] | bytes, layers: tuple[Mechanism | Description, ...]
    ) -> None:
        super().__init__(Flags("one_for_all", intensity=0), ())
        if isinstance(start, bytes):  # The root has not looked into it: it is from an actor process.
            start = unpack_recipe(start)
        self._setting, self._recipe = setting, start
        made = tuple(one if isinstance(one, Mechanism) else revive(one) for one in layers)
        for one in made:
            one.check(start.kind, protected_at(self.ctx.path))
        self._made = nested(made)
        self._one_order = asyncio.Lock()
        self._orders: set[asyncio.Task[None]] = set()
        self._preparing: asyncio.Task[None] | None = None

    @classmethod
    def _may_order(cls, start: Start[Any], path: str) -> tuple[str, ...]:
        return (path.rpartition("/")[0],)  # And what the protected actor is bound to, for which it speaks.

    @classmethod
    def _speaks_for(cls, path: str) -> tuple[str, ...]:
        return (protected_at(path),)

    def init(self) -> Plan:
        """The protected actor and its state manager; the bricks follow."""
        setting, cell = self._setting, self.ctx._cell
        self._standing = standing = Standing(cell, setting.config, self._made)
        self._server = standing.server = Server(standing, Method.of(setting.method))
        self._woven = Woven(setting.config, self._made, {}, {}, [])
        self._prepared: Woven | None = None
        return Plan(
            [child(SERVER, self._recipe, shutdown=5.0), child(STATE, start(StateManager, standing))],
            strategy="one_for_all",
            intensity=0,
        )

    async def _start_all(self) -> None:
        """Start the protected actor's address, then the bricks as one that does not lead, then the heartbeat."""
        await super()._start_all()
        setting, node = self._setting, self.ctx._cell.node
        self._bind(STATE, "server", self._cell(SERVER))
        for port, path in setting.bindings.items():
            node.bind(self._cell(SERVER), port, node.cell_at(path), is_claimed=port in setting.claimed)
        node.emit(ActorStarted(self._cell(SERVER).path, 1))  # Its lives come and go with the role: the address stays.
        woven = await self._start_bricks(self._woven.config, self._woven.layers, leads=False)
        await self._take_up(woven)
        one = Child(child(BEAT, start(Heart, self._standing, setting.name, setting.beat, setting.watch_turns)))
        one.cell = cell = new_cell(self.ctx._cell, one)
        for port in ("detector", "proxy"):
            node.bind(cell, port, self._standing.part(port))
        self._enlist(one)
        await self._start(one)

    def _launch(self, one: Child) -> asyncio.Future[None] | None:
        if one.spec.id != SERVER:
            return super()._launch(one)
        if one.cell is None:
            one.cell = new_cell(self.ctx._cell, one)
        here = one.cell.node.ports.here
        one.cell.host = AddressHost(FED, self._server, here.parent)
        self._server.start(one.cell)
        return None

    def child_exited(self, cell: Cell, life: int, reason: ExitReason) -> Any:
        """The lives of the protected actor begin and end as the bricks want it; the end of a brick is ours."""
        if cell.name == SERVER or isinstance(cell.host.place, Server):
            return None
        return super().child_exited(cell, life, reason)

    def _give_up(self, one: Child, reason: ExitReason, told: ExitReason) -> None:
        why, setting, cell = f"its {one.spec.id} has ended: {reason}", self._setting, self.ctx._cell
        super()._give_up(one, reason, Shutdown(why))
        with suppress(HoldfastError):  # It is between two lives: then it hears of our end.
            self.ctx._tell(self._standing.part("detector"), Broken(setting.name, cell.life, why))

    def _cell(self, name: str) -> Cell:
        cell = self._children[name].cell
        assert cell is not None
        return cell

    def _bind(self, name: str, port: str, target: Cell) -> None:
        self.ctx._cell.node.bind(self._cell(name), port, target)

    # -- weaving ----------------------------------------------------------------------------------------------------

    async def _start_bricks(self, config: int, layers: tuple[Mechanism, ...], *, leads: bool) -> Woven:
        """Start what a stack needs that is not there yet."""
        places, old = weave(layers, leads=leads), self._woven
        woven = Woven(config, layers, places, {}, [])
        free = {slot: name for slot, name in old.names.items() if slot not in places}
        try:
            for slot, place in places.items():
                name = self._known(slot, place, free)
                if name is None:
                    name = place.name if place.name not in self._children else f"{place.name}@{config}"
                    while name in self._children:
                        name += "'"
                    one = Child(child(name, start(place.kind, self._standing, place.mechanism, slot)))
                    self._enlist(one)
                    woven.new.append(name)
                    woven.names[slot] = name
                    await self._start_brick(one)
                woven.names[slot] = name
        except BaseException:
            await self._end_bricks(woven.new)
            raise
        return woven

    def _known(self, slot: str, place: PlacedBrick, free: dict[str, str]) -> str | None:
        """A brick that is there and does just this."""
        old = self._woven
        before = old.places.get(slot)
        if before is not None and before[:2] == place[:2]:
            return old.names[slot]
        if place.mechanism is None:
            for other, name in free.items():
                if old.places[other][:2] == place[:2]:
                    del free[other]
                    return name
        return None

    async def _start_brick(self, one: Child) -> None:
        """Start a brick, and wait until it is up, but not for ever.

        Raises:
            StartFailed: it has not come up, or not in time.
        """
        where = self._path_of(one)
        try:
            up = self._launch(one)
            if up is not None:
                done, _ = await asyncio.wait((up,), timeout=STARTED_WITHIN)
                if not done:
                    raise StartFailed(where, f"its on_start did not return within {STARTED_WITHIN:g} s")
                up.result()
        except StartIgnored as error:
            raise StartFailed(where, str(error)) from error
        except HoldfastError as error:
            self._start_failed(one, error)
            raise
        self._is_up(one)

    async def _end_bricks(self, names: list[str]) -> None:
        """End these; one that has not come up is not waited for."""
        for name in names:
            one = self._children.get(name)
            if one is None:
                continue
            if one.state != UP and one.cell is not None:
                one.ignored_life = one.cell.life
                one.cell.kill()
            await self._stop(one)
            self._give_up_address(one, SHUTDOWN)
            self._forget(one)

    async def _settled(self, names: list[str]) -> list[Work]:
        """Wait until bricks that are to end have handled what has come so far; one that does not is killed.

        What it still had is not lost: home sends again what it has no outcome of.

        Returns:
            What it had from the one that has led: home may have the outcome of that, and nobody sends it again.

        Raises:
            HoldfastError: one has crashed, which is the end of all of us.
        """
        asked = {name: self._cell(name).ref.ask(AwaitHandled(), timeout=FOREVER) for name in names}
        ended = {name: self._cell(name).ended() for name in names}
        end, held = self.ctx._cell.node.loop.time() + SETTLED_WITHIN, list[Work]()
        for name in names:
            left = max(0.0, end - self.ctx._cell.node.loop.time())
            await asyncio.wait((asked[name], ended[name]), timeout=left, return_when=asyncio.FIRST_COMPLETED)
            if asked[name].done():
                await asked[name]
            elif ended[name].done():
                raise HoldfastError(f"{self._cell(name).path} has crashed")
            else:
                asked[name].cancel()
                one, cell = self._children[name], self._cell(name)
                one.state = STOPPED  # Its end is no failure of ours.
                # The bricks behind it come behind it in `names`, and what they have came before.
                had = map(message_of, (cell.item, *(cell.queue or ())))
                held[:0] = [one for one in had if isinstance(one, Work) and one.number <= FORWARDED]
                cell.kill()
        return held

    def _pass_on(self, held: list[Work]) -> None:
        """What bricks had that were killed goes past them, in the order in which it came, and is computed."""
        for work in held:
            self._cell(self._woven.names["proceed"]).ref.tell(work)

    async def _take_up(self, woven: Woven, *, leads: bool | None = None, behind: bool = False) -> None:
        """Have this stack be the one: bind everything, end what is not needed (`behind`: when we have answered)."""
        old, self._woven, standing = self._woven, woven, self._standing
        kept = set(woven.names.values())
        left = [name for name in old.names.values() if name not in kept and name in self._children]
        held = await self._settled(left)  # What is in their mailboxes belongs to the time before.
        standing.config, standing.layers = woven.config, woven.layers
        if leads is not None:
            standing.leads = leads
        roles = [one.role(leads=standing.leads) for one in woven.layers]
        standing.computes = standing.leads or all(role.computes for role in roles)
        server = self._server
        server.state.is_lazy = not any("state_access" in one.needs for one in woven.layers)
        if not server.state.is_lazy and server.points.tail and server.life is not None and server.life.feed is None:
            server.capture()  # From here on, the last part is what was handled since the last point.
        standing.bricks = {slot: self._cell(name) for slot, name in woven.names.items()}
        standing.other.forget_bricks()
        self._bind_all(woven)
        self._pass_on(held)
        if BEAT in self._children and detection_in(old.layers) != detection_in(woven.layers):
            self._cell(BEAT).ref.tell(HeartbeatDue())  # Now: the next beat as it was may be later than is waited for.
        if behind:
            self._obey(EndBricks(left), None)
        else:
            self._secure()
            await self._end_bricks(left)
        if not standing.computes:
            await self._keep_state()
        elif standing.leads or standing.following.is_ready:
            await self._server.ensure()

    def _secure(self) -> None:
        """Have the link that the outermost mechanism wants, and its gate."""
        standing, woven = self._standing, self._woven
        for owner, port, target in self._wiring(woven):
            if port == "gate":
                self.ctx._cell.node.bind(owner, port, target)
        outermost = standing.layers[0] if standing.layers else None
        old = standing.link
        if old is not None and old.mechanism == outermost:
            return
        if old is not None:
            old.close()
        path, epoch = self.ctx.path, lambda: max(0, standing.epoch)
        standing.link = None if outermost is None else outermost.open_link(standing.node, standing.address, path, epoch)

    async def _keep_state(self) -> None:
        """The protected actor does not live here any more: its state stays, as bytes."""
        server = self._server
        if server.life is not None and server.life.feed is None and server.state.has_access:
            server.capture()
        await server.drop_life()

    def _bind_all(self, woven: Woven) -> None:
        node = self.ctx._cell.node
        for owner, port, target in self._wiring(woven):
            if port != "gate":
                node.bind(owner, port, target)
        proceed = self._cell(woven.names["proceed"]).actor
        assert isinstance(proceed, Proceed)
        proceed.take_over()

    def _check_wiring(self, woven: Woven) -> None:
        """Whether all bindings can be made, and nothing that is needed is left unbound.

        Raises:
            MechanismRefused: which one.
        """
        bound: dict[Cell, set[str]] = {}
        for owner, port, target in self._wiring(woven):
            kind: Any = owner.extra().start
            if port not in kind.kind._bindings:
                raise MechanismRefused(owner.path, f"{type_name(kind.kind)} has no binding {port!r}")
            if target.is_dead and owner.parent is target.parent:
                raise MechanismRefused(owner.path, f"its {port!r} would be bound to {target.path}, which has ended")
            bound.setdefault(owner, {"peer"}).add(port)
        for slot, name in woven.names.items():
            cell, kind = self._cell(name), woven.places[slot].kind
            left = sorted(set(kind._bindings) - bound.get(cell, set()))
            if left:
                raise MechanismRefused(cell.path, f"nothing would be bound to its {', '.join(left)}")

    def _wiring(self, woven: Woven) -> list[tuple[Cell, str, Cell]]:
        """All bindings of a stack: owner, port, target."""
        names, layers = woven.names, woven.layers
        found: list[tuple[Cell, str, Cell]] = []
        proxy = self._standing.part("proxy")
        state, server = self._cell(STATE), self._cell(SERVER)
        cell = {slot: self._cell(name) for slot, name in names.items()}
        # A mechanism that secures the links stands around the protocol, all others stand behind it.
        is_secured = bool(layers) and layers[0].secures
        gate = cell[f"{layers[0].name}.before"]
        outlet = cell[f"{layers[0].name}.after"] if is_secured else proxy
        entries = [cell[PROTOCOL if index == 0 else f"{one.name}.protocol"] for index, one in enumerate(layers)]
        exits = [
            entries[0] if is_secured and index == 0 else cell[f"{one.name}.after"] for index, one in enumerate(layers)
        ]
        found += [(entries[0], "gate", gate)]
        for index, one in enumerate(layers):
            protocol, before, after = entries[index], cell[f"{one.name}.before"], cell[f"{one.name}.after"]
            onward = entries[index + 1] if index + 1 < len(layers) else cell["proceed"]
            if is_secured and index == 0:
                found += [
                    (protocol, "before", onward),
                    (protocol, "next", after),
                    (before, "next", protocol),
                    (after, "next", proxy),
                ]
            else:
                found += [
                    (protocol, "before", before),
                    (protocol, "next", proxy if index == 0 else exits[index - 1]),
                    (before, "next", onward),
                    (after, "next", protocol),
                ]
            found += [(brick, "state", state) for brick in (protocol, before, after)]
        proceed = cell["proceed"]
        return [
            *found,
            (cell[PROTOCOL], "proceed", proceed),
            (proceed, "next", exits[-1]),
            (proceed, "server", server),
            (proceed, "state", state),
            (proceed, "out", outlet),
        ]

    # -- orders -----------------------------------------------------------------------------------------------------

    @on(Opened)
    def _ordered(self, message: Opened) -> Any:
        """From its own RequestProtocol, which has seen how it came; nobody else gives it orders."""
        order = self._standing.opened.take(message.key, ORDERS)
        if order is None:
            return self._fail(Refused(path=self.ctx.path, reason="forged"))
        handle: ReplyHandle[Any] = self.ctx.reply_handle()
        if isinstance(order, (Assume, Abort)) and self._preparing is not None:
            self._preparing.cancel()  # Nobody who has to lead waits for a change.
        task = self._obey(order, handle)  # type: ignore[arg-type]  # one of `ORDERS`
        if isinstance(order, PrepareStack):
            self._preparing = task
        return handle

    def _obey(self, order: Order, handle: ReplyHandle[Any] | None) -> asyncio.Task[None]:
        task = self.ctx.create_task(self._obeyed(order, handle))
        self._orders.add(task)
        task.add_done_callback(self._orders.discard)
        return task

    async def _obeyed(self, order: Order, handle: ReplyHandle[Any] | None) -> None:
        """Carry out an order behind those that came before it; one that fails is the end of the replica."""
        try:
            async with self._one_order:
                reply = await self._carry_out(order)
        except asyncio.CancelledError:
            if handle is not None:
                handle.fail(MechanismRefused(self.ctx.path, "it was given up"))
            raise
        except BaseException as error:
            if handle is not None:
                handle.fail(remote_crash(error))
            raise
        if handle is not None:
            if isinstance(reply, HoldfastError):
                handle.fail(reply)
            else:
                handle.reply(reply)

    async def _carry_out(self, order: Order) -> Any:
        match order:
            case Assume():
                return await self._assume(order)
            case PrepareStack():
                return await self._prepare(order)
            case Commit():
                return await self._commit(order)
            case Abort():
                return await self._abort(order)
            case Play():
                return await self._play(order)
            case EndBricks():
                return await self._end(order)

    async def _stop_children(self) -> None:
        """We end: whatever we were about to do is not waited for."""
        for task in list(self._orders):
            task.cancel()
        await super()._stop_children()

    async def _assume(self, message: Assume) -> None:
        old = self._woven
        places = weave(old.layers, leads=message.leads)
        left = [name for slot, name in old.names.items() if places[slot][:2] != old.places[slot][:2]]
        held = await self._settled(left)  # What is in their mailboxes belongs to the time before.
        await self._end_bricks(left)  # First: the new ones have their names.
        woven = await self._start_bricks(old.config, old.layers, leads=message.leads)
        await self._take_up(woven, leads=message.leads)
        self._pass_on(held)

    async def _play(self, message: Play) -> None:
        """Have the bricks of this role, without the protected actor: it is only to be seen how they do."""
        old, standing = self._woven, self._standing
        standing.leads = message.leads
        places = weave(old.layers, leads=message.leads)
        for slot, place in list(old.places.items()):
            if place[:2] != places[slot][:2] or (message.is_new and slot != PROTOCOL):
                await self._end_bricks([old.names.pop(slot)])
                del old.places[slot]
        woven = self._woven = await self._start_bricks(old.config, old.layers, leads=message.leads)
        standing.bricks = {slot: self._cell(name) for slot, name in woven.names.items()}
        self._bind_all(woven)

    async def _prepare(self, message: PrepareStack) -> Any:
        try:
            if self._prepared is not None:
                await self._drop_prepared()
            layers = nested(tuple(revive(one) for one in message.layers))
            for one in layers:
                one.check(self._recipe.kind, self._standing.address)
            leads = self._standing.leads
            self._prepared = await self._start_bricks(message.config, layers, leads=leads)
            self._check_wiring(self._prepared)
        except HoldfastError as error:
            await self._drop_prepared()
            return error
        except (
            Exception,
            SystemExit,
            KeyboardInterrupt,
        ) as error:  # Importing a module, and making a mechanism of its settings, raise anything.
            await self._drop_prepared()
            return MechanismRefused(self.ctx.path, f"{type_name(type(error))}: {error}")
        return None

    async def _commit(self, message: Commit) -> Any:
        if self._woven.config == message.config:
            return self._server.turn  # It was done already. Whoever asks: it changes nothing.
        woven, self._prepared = self._prepared, None
        if woven is None or woven.config != message.config:
            self._prepared = woven
            return MechanismRefused(self.ctx.path, f"configuration {message.config} was not prepared")
        try:
            async with asyncio.timeout(CAUGHT_UP_WITHIN):
                await self._catch_up()
        except TimeoutError:
            if message.insists:  # What is in the bricks that hang is asked for again.
                return await self._change_to(woven)
            self._prepared = woven
            return MechanismRefused(self.ctx.path, f"it had more to do than it could do in {CAUGHT_UP_WITHIN:g} s")
        return await self._change_to(woven)

    async def _change_to(self, woven: Woven) -> int:
        await self._take_up(woven, behind=True)
        self._standing.other.turn = -2  # What the other one has is not known to the new bricks.
        return self._server.turn

    async def _catch_up(self) -> None:
        """Nothing is inside the one that leads, but a follower may be behind it."""
        names = self._woven.names
        for slot in (*(slot for slot in names if slot.endswith(".before")), "proceed"):
            await self._cell(names[slot]).ref.ask(AwaitHandled(), timeout=FOREVER)
        await self._cell(names["proceed"]).ref.ask(Flush(), timeout=FOREVER)

    async def _end(self, message: EndBricks) -> None:
        for name in message.names:
            one = self._children.get(name)
            brick = None if one is None or one.cell is None else one.cell.actor
            if isinstance(brick, Brick):
                await brick.answered()  # Among others, the order that wants all this: it has come over the old link.
        self._secure()
        await self._end_bricks(message.names)

    async def _abort(self, message: Abort) -> None:
        if self._prepared is not None and self._prepared.config == message.config:
            await self._drop_prepared()

    async def _drop_prepared(self) -> None:
        woven, self._prepared = self._prepared, None
        if woven is not None:
            await self._end_bricks(woven.new)
