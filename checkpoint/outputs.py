"""The outputs of a recorded actor: how each takes effect, when the append that numbers it is safe."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import msgspec

from ..actors.cell import GONE, Cell
from ..actors.codec import Parcel
from ..actors.errors import AskDeadlock, HoldfastError, MailboxFull
from ..actors.mail import Envelope
from .asks import SwitchAsk, answer_ask, origin_of
from .inputs import Batch
from .records import MESSAGE, PIPE, Answer, Out, PipeDone
from .recovery.held import Inlet, inlet
from .ties import connect

if TYPE_CHECKING:
    from .switch import Switch


class Outputs:
    """Lets outputs out of one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self.kept: list[Out] = []  # what outlives the life, and has not taken effect yet

    def execute(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        """Let one output take effect, when the append is safe."""
        home = self._home
        node, cell = home.node, home.cell
        assert cell is not None
        match out.verb:
            case "tell":
                self._deliver(node.cell_at(out.to), out, batch)
            case "send":
                self._send(turn, out, batch)
            case "ask":
                self._ask(turn, key, out, batch)
            case "publish":
                for target in node.topics.subscribers(out.to):
                    self._deliver(target, out, batch)
            case "reply":
                ask = home.later.pop(int(out.to), None)
                source = home.open.get(int(out.to))
                if source is not None:  # Answered before its own turn has ended.
                    ask, source.ask = source.ask, None
                kind, _, name = out.name.partition("|")
                if isinstance(ask, SwitchAsk):
                    if home.journal.durable:
                        batch.add(home.path, ("replied", turn, int(out.to)), home.positions_of(turn))
                    ask.give(Answer(kind, name, out.body), batch)
                elif ask is not None:
                    batch.after.append(lambda: answer_ask(home, ask, Answer(kind, name, out.body)))
            case "forward":
                self._forward(key, out, batch)
            case "timer" | "cancel":
                self._keep(turn, out, batch)
                if out.verb == "cancel":
                    home.timers.drop_ticks(out.to, key, batch)
                batch.after.append(lambda: self._operate(out))
            case "subscribe" | "unsubscribe":
                self._keep(turn, out, batch)
                batch.after.append(lambda: self._subscribe(out))
            case "monitor" | "watch" | "demonitor" | "unwatch" | "link" | "unlink":
                home.ties.turn(out.verb, out.to)
                if home.journal.durable:
                    batch.add(home.path, ("tie", turn, out.verb, out.to), home.positions_of(turn))
                batch.after.append(lambda: connect(cell, node.cell_at(out.to), out.verb))
            case "pipe":
                pass
            case verb:
                raise HoldfastError(f"{home.path}: unknown output {verb!r}")

    def work_done(self, record: PipeDone) -> None:
        """Background work has an outcome: an input, once."""
        home = self._home
        done = home.pipes_done.setdefault(record.turn, set())
        if record.k not in done:
            done.add(record.k)
            origin = f"{record.turn}.{record.k}"
            home.forward(home.record(PIPE, record.name, record.body, home.path, origin=origin))

    def _operate(self, out: Out) -> None:
        if self._stands(out):
            self._home.timers.operate(out)

    def _stands(self, out: Out) -> bool:
        """Whether what outlives the life takes effect now; else its turn was undone meanwhile."""
        if out in self.kept:
            self.kept.remove(out)
            return True
        return not self._home.journal.durable

    def _keep(self, turn: int, out: Out, batch: Batch) -> None:
        """What outlives the life is journaled."""
        if not self._home.journal.durable:
            return
        self.kept.append(out)
        entry = ("op", turn, out.verb, out.to, out.name, out.body, out.seconds, out.interval, self._home.node.wall())
        batch.add(self._home.path, entry, self._home.positions_of(turn))

    def _deliver(self, target: Cell, out: Out, batch: Batch, sender: str | None = None) -> None:
        """A message to another actor; to a recorded one it is journaled in the same append."""
        home = self._home
        switch = switch_of(target)
        cell = home.cell if sender is None else home.node.cell_at(sender)
        assert cell is not None
        if switch is not None:
            if isinstance(target, Inlet):
                target.mark()
            try:
                if switch.bound is None or switch.bound.makes_room(None, out.name, out.body, cell.path):
                    source = switch.record(MESSAGE, out.name, out.body, cell.path, batch)
                    batch.after.append(lambda: switch.admitted(source))
            except MailboxFull as error:  # Its turn has gone on: there is nobody to raise this to.
                home.node.dead_letter(target, Parcel(out.name, out.body), str(error))
            return

        def send() -> None:
            try:
                target.admit(target, Envelope(home.node.codec.message_in(target, out.name, out.body), cell))
            except HoldfastError as error:
                home.node.dead_letter(target, Parcel(out.name, out.body), str(error))

        batch.after.append(send)

    def _send(self, turn: int, out: Out, batch: Batch) -> None:
        """A message whose sender waits until it is accepted."""
        home = self._home
        target = home.node.cell_at(out.to)
        switch = switch_of(target)
        home.calls.sends.add((turn, out.k))
        if switch is None:
            batch.after.append(lambda: self._offer(target, turn, out))
            return
        bound = switch.bound
        try:
            if bound is None or bound.overflow == "block" or bound.makes_room(None, out.name, out.body, home.path):
                # Even if there is no room: what is journaled in this append cannot be lost, and the sender waits.
                source = switch.record(MESSAGE, out.name, out.body, home.path, batch)
                batch.after.append(lambda: switch.admitted(source))
        except MailboxFull as error:
            home.calls.refused(turn, out.k, error, batch)
            return
        batch.after.append(lambda: self._wait(switch, turn, out.k))

    def _wait(self, switch: Switch, turn: int, k: int) -> None:
        """Let the sender go on when its receiver has room."""
        room = switch.room() if switch.cell is not None and switch.cell.state is not GONE else None
        if room is None:
            self._home.calls.accepted(turn, k)
        else:
            room.add_done_callback(lambda _: self._wait(switch, turn, k))

    def _offer(self, target: Cell, turn: int, out: Out) -> None:
        """Hand a message over when its receiver, which keeps no journal, has room."""
        home = self._home
        try:
            room = target.room()
            if room is not None:
                room.add_done_callback(lambda _: self._offer(target, turn, out))
                return
            message = home.node.codec.message_in(target, out.name, out.body)
            taken = target.host.offer(target, Envelope(message, home.cell))
        except HoldfastError as error:
            home.calls.refused(turn, out.k, error)
            return
        if taken is None:
            home.calls.accepted(turn, out.k)
        else:  # It is in another process, which answers.
            asyncio.ensure_future(taken).add_done_callback(lambda done: self._offered(turn, out.k, done))

    def _offered(self, turn: int, k: int, done: asyncio.Future[None]) -> None:
        error = None if done.cancelled() else done.exception()
        if isinstance(error, HoldfastError):
            self._home.calls.refused(turn, k, error)
        else:
            self._home.calls.accepted(turn, k)

    def _ask(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        home = self._home
        target = home.node.cell_at(out.to)
        source = home.open.get(key)
        chain = ((home.path, key), *(source.chain if source is not None else ()))
        ask = SwitchAsk.made(home, turn, out, chain, target)
        home.calls.asks[turn, out.k] = ask
        home.node.deadlines.add(ask)
        switch = switch_of(target)
        if switch is None:
            batch.after.append(lambda: self._send_ask(target, ask))
        elif switch.waits(ask):
            ask.give(Answer(*home.node.codec.encode_error(AskDeadlock(out.to, tuple(p for p, _ in chain)))), batch)
        elif switch.bound is None or switch.bound.makes_room(ask, out.name, out.body, home.path):
            asked = switch.record(MESSAGE, out.name, out.body, home.path, batch, origin_of(ask))
            asked.ask, asked.chain = ask, chain
            ask.started = True
            batch.after.append(lambda: switch.admitted(asked))

    def _send_ask(self, target: Cell, ask: SwitchAsk) -> None:
        home = self._home
        parcel: Any = ask.message
        try:
            ctx = target.ctx
            if ctx is not None and ctx.turn_in(ask.chain):
                raise AskDeadlock(target.path, tuple(path for path, _ in ask.chain))
            ask.message = home.node.codec.message_in(target, parcel.name, parcel.body)
            target.admit(target, ask)
        except HoldfastError as error:
            ask.fail(error)

    def _forward(self, key: int, out: Out, batch: Batch) -> None:
        home = self._home
        source = home.open.get(key)
        ask = source.ask if source is not None else None
        target = home.node.cell_at(out.to)
        if source is None or ask is None:
            self._deliver(target, out, batch, None if source is None else source.sender)
            return
        source.ask = None  # From now on it is the receiver's to answer.

        def send() -> None:
            try:
                message: Any = ask.message
                if type(message) is Parcel:
                    ask.message = home.node.codec.message_in(target, out.name, out.body)
                target.admit(target, ask)
            except HoldfastError as error:
                ask.fail(error)

        batch.after.append(send)

    def _subscribe(self, out: Out) -> None:
        """Subscriptions belong to the address and outlive its lives."""
        home = self._home
        if not self._stands(out):
            return
        if out.verb == "subscribe":
            home.topics[out.to] = None
            if home.cell is not None:
                home.node.topics.subscribe(out.to, inlet(home, out.to))
        else:
            home.topics.pop(out.to, None)
            if home.cell is not None:
                home.node.topics.unsubscribe(out.to, inlet(home, out.to))


def switch_of(cell: Cell) -> Switch | None:
    """The switch of a recorded actor's cell."""
    return getattr(cell.host, "switch", None)


def went_elsewhere(home: Switch, out: Out, digest: int) -> bool:
    """Whether a replayed output is the same but for its receiver, for its binding was changed since."""
    others = home.node.led.get(home.path, {}).get(out.to, ())
    return any(msgspec.structs.replace(out, to=path).digest() == digest for path in others)
