"""The outputs of a recorded actor: how each takes effect, when the append that numbers it is safe."""

from __future__ import annotations

import asyncio
import functools
from collections import deque
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from ...actors.control.trace_tail import ask_of_turn, enveloped, follow, with_tail
from ...actors.errors import AskDeadlock, HoldfastError, MailboxFull
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Chain, waiters
from ..durable_links import UNDONE_BY, connect
from ..inputs import Batch
from ..life.recorded_inbox import STARTED
from ..protocol import MESSAGE, PIPE, Answer, Hooked, Out, PipeDone
from .admission import TurnRows
from .ask_recovery import origin_asked, origin_asked_by, origin_kept
from .held_messages import Inlet, inlet, is_unread
from .pending_asks import SwitchAsk, answer_ask, origin_of
from .present_life import LifePort
from .recorded_home import switch_of

if TYPE_CHECKING:
    from ...actors.kernel.envelope import Ask
    from .switch import Switch


OPPOSITES = (("subscribe", "unsubscribe"), *((one, other) for other, one in UNDONE_BY.items()))
"""What a turn can do to a topic or to another actor, and how it is undone."""


class Outputs:
    """Lets outputs out of one home.

    Attributes:
        rows: what the journal has of the ends of turns.
        kept: what outlives the life, and has not taken effect yet.
    """

    def __init__(self, home: Switch) -> None:
        self._home = home
        self.rows = TurnRows(home)
        self.kept: list[Out] = []
        self._lines: dict[Cell, deque[Callable[[], bool]]] = {}  # what waits for room at who keeps no journal

    def execute(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        """Let one output take effect, when the append is safe."""
        home = self._home
        node, cell = home.node, home.cell
        assert cell is not None
        match out.verb:
            case "tell":
                self._deliver(node.cell_at(out.to), turn, out, batch)
            case "send":
                target, sent = node.cell_at(out.to), functools.partial(home.calls.sent, turn, out.k)
                home.calls.sends.add((turn, out.k))
                if self._keeps(target, turn, out, batch, home.path):
                    batch.after.append(functools.partial(sent, None))
                else:
                    self._send(target, out, batch, sent)
            case "ask":
                self._ask(turn, key, out, batch)
            case "effect" | "sleep" | "wait":
                home.ledger.waits.lasts = True
                if out.verb != "effect":
                    home.calls.rests.fix(turn, out, batch)
                port = home.life.port
                batch.after.append(lambda: self._begin(turn, key, out, port))
            case "publish":
                self._publish(turn, out, batch)
            case "reply":
                ask = home.calls.later.pop(int(out.to), None)
                source = home.ledger.open.get(int(out.to))
                if source is not None:  # Answered before its own turn has ended.
                    ask, source.ask = source.ask, None
                kind, _, name = out.name.partition("|")
                if isinstance(ask, SwitchAsk):
                    home.note(turn, ("replied", turn, int(out.to)), batch)
                    ask.give(Answer(kind, name, out.body), batch)
                elif ask is not None:
                    batch.after.append(lambda: answer_ask(home, ask, Answer(kind, name, out.body)))
            case "forward":
                self._forward(turn, key, out, batch)
            case "timer" | "cancel":
                self._keep(turn, out, batch)
                if out.verb == "cancel":
                    home.timers.cancelled(turn, out.to)
                    home.timers.drop_ticks(out.to, key, batch)
                batch.after.append(lambda: self._operate(out))
            case "subscribe" | "unsubscribe":
                self._keep(turn, out, batch)
                batch.after.append(lambda: self._subscribe(out))
            case "monitor" | "watch" | "demonitor" | "unwatch" | "link" | "unlink":
                home.ties.turn(turn, out.verb, out.to)
                home.note(turn, ("tie", turn, out.verb, out.to), batch)
                batch.after.append(lambda: connect(cell, node.cell_at(out.to), out.verb))
            case "kill" | "stop" as order:
                batch.after.append(lambda: node.cell_at(out.to).obey(order, home.path))
            case "pipe":
                pass
            case verb:
                raise HoldfastError(f"{home.path}: unknown output {verb!r}")

    def _begin(self, turn: int, key: int, out: Out, port: LifePort | None) -> None:
        """What a turn waits for begins, if its life is still there: the next one's says for itself what it wants."""
        home = self._home
        if home.life.port is not port or (turn, out.k) in home.ledger.outcomes:
            return
        if turn <= home.ledger.turn:
            return  # It left with the end of its turn, which has not waited for it.
        if out.verb == "effect":
            home.calls.order(turn, out)
        else:
            home.calls.rests.begin(turn, key, out)

    def hooked(self, record: Hooked) -> None:
        """What a hook does that outlives it; it is done once, though a hook runs at each life."""
        home, out = self._home, record.out
        verbs = next((pair for pair in OPPOSITES if out.verb in pair), ())
        digests = {Out(0, verb, out.to).digest() for verb in verbs}
        if record.hook == STARTED and home.ledger.is_touched_since(digests):
            return  # The turns behind the snapshot have had the last word, and are handled again.
        if out.verb == "timer" and not home.timers.is_new(out):
            return
        if out.verb in ("monitor", "watch", "link") and home.ties.has(out.verb, out.to):
            return
        batch = Batch()
        self.execute(home.ledger.turn, -1, out, batch)
        batch.commit(home.journal)

    def work_done(self, record: PipeDone) -> None:
        """Background work has an outcome: an input, once."""
        home = self._home
        origin = f"{record.turn}.{record.k}" if record.k else ""
        if not record.k or home.ledger.admit_result(record.turn, record.k):
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
        if out.verb == "timer" and out.name not in self._home.shapes.noted:
            self._home.note_shape(out.name, batch)
        now = self._home.node.clock.wall()
        entry = ("op", turn, out.verb, out.to, out.name, out.body, out.seconds, out.interval, now)
        self._home.note(turn, entry, batch)

    def _deliver(self, target: Cell, turn: int, out: Out, batch: Batch, sender: str | None = None) -> None:
        """A message to another actor; to a recorded one, up or not, it is journaled in the same append."""
        home = self._home
        switch = switch_of(target)
        cell = home.cell if sender is None else home.node.cell_at(sender)
        assert cell is not None
        if switch is not None:
            if isinstance(target, Inlet):
                target.mark()
            try:
                bound = switch.intake.bound
                if bound is None or bound.makes_room(None, out.name, out.body, cell.path):
                    source = switch.record(MESSAGE, out.name, out.body, cell.path, batch)
                    source.chain = trace_of(out)
                    batch.after.append(lambda: switch.admitted(source))
            except MailboxFull as error:  # Its turn has gone on: there is nobody to raise this to.
                home.node.dead_letter(target, Parcel(out.name, out.body), str(error), cell)
            return
        if self._keeps(target, turn, out, batch, cell.path):
            return

        def send() -> None:
            there = target.living
            try:
                message = home.node.codec.message_in(there, out.name, out.body)
                there.admit(there, enveloped(message, cell, trace_of(out)))
            except HoldfastError as error:
                home.node.dead_letter(there, Parcel(out.name, out.body), str(error), cell)

        batch.after.append(send)

    def _keeps(self, target: Cell, turn: int, out: Out, batch: Batch, sender: str) -> bool:
        """Whether a message is kept for another system, or for a recorded actor that was not started here yet."""
        home, far = self._home, self._home.homes.far
        if far.lasts(out.to):
            far.keep(origin_kept(home, turn, out), out, sender, batch)
            return True
        return is_away(target) and home.homes.rejoin.keep(home, origin_kept(home, turn, out), out, sender, batch)

    def _publish(self, turn: int, out: Out, batch: Batch) -> None:
        """A message to each subscriber, when it has room; the publisher waits until the last one has accepted it."""
        home, topic = self._home, out.to
        home.calls.sends.add((turn, out.k))
        subscribers = home.node.topics.subscribers(topic)
        left = dict.fromkeys(subscribers)

        def over(target: Cell, error: HoldfastError | None) -> None:
            if error is not None:
                home.node.not_taken(target, Parcel(out.name, out.body), error, home.cell)
            left.pop(target, None)
            if not left:
                home.calls.sent(turn, out.k, None)

        for target in subscribers:
            if isinstance(target, Inlet):
                target.mark()
            wanted = functools.partial(home.node.topics.has, topic, target)
            self._send(target, out, batch, functools.partial(over, target), wanted)
        if not subscribers:
            batch.after.append(lambda: home.calls.sent(turn, out.k, None))

    def _send(
        self,
        target: Cell,
        out: Out,
        batch: Batch,
        over: Callable[[HoldfastError | None], None],
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """A message whose sender waits until it is accepted; then, or if it will not be, `over` is called."""
        home = self._home
        switch = switch_of(target)
        if switch is None:

            def line_up() -> None:
                there = target.living
                self._line_up(there, lambda: self._offer(there, out, over, wanted))

            batch.after.append(line_up)
            return
        bound = switch.intake.bound
        try:
            if bound is None or not target.has_room or bound.makes_room(None, out.name, out.body, home.path):
                # Even if there is no room: what is journaled in this append cannot be lost, and the sender waits.
                source = switch.record(MESSAGE, out.name, out.body, home.path, batch)
                source.chain = trace_of(out)
                batch.after.append(lambda: switch.admitted(source))
        except MailboxFull as full:
            error = full
            batch.after.append(lambda: over(error))
            return
        batch.after.append(lambda: self._wait(target, switch, over))

    def _wait(self, target: Cell, switch: Switch, over: Callable[[HoldfastError | None], None]) -> None:
        """Let the sender go on when its receiver, which has the message, has room; nobody waits for itself."""
        room = None
        is_there = switch.cell is not None and switch.cell.state is not GONE and switch.intake.between is None
        if switch is not self._home and is_there:
            room = target.room() if isinstance(target, Inlet) else switch.room()
        if room is None:
            over(None)
        else:
            room.add_done_callback(lambda _: self._wait(target, switch, over))

    def _line_up(self, target: Cell, offer: Callable[[], bool]) -> None:
        """Offer a message when all that was offered to its receiver before has been taken."""
        line = self._lines.get(target)
        if line is not None:
            line.append(offer)
        elif not offer():
            self._lines[target] = deque((offer,))

    def _room_came(self, target: Cell) -> None:
        line = self._lines[target]
        while line and line[0]():
            line.popleft()
        if not line:
            del self._lines[target]

    def _offer(
        self, target: Cell, out: Out, over: Callable[[HoldfastError | None], None], wanted: Callable[[], bool]
    ) -> bool:
        """Hand a message over if its receiver, which keeps no journal, has room. False: it has to wait for it."""
        home = self._home
        taken: Awaitable[None] | None = None
        try:
            if wanted():
                room = target.room()
                if room is not None:
                    room.add_done_callback(lambda _: self._room_came(target))
                    return False
                message = home.node.codec.message_in(target, out.name, out.body)
                taken = target.host.offer(target, enveloped(message, home.cell, trace_of(out)))
        except HoldfastError as error:
            over(error)
            return True
        if taken is None:
            over(None)
        else:  # It is in another process, which answers.
            asyncio.ensure_future(taken).add_done_callback(lambda done: over(_failure(done)))
        return True

    def _ask(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        home = self._home
        target, source = home.node.cell_at(out.to), home.ledger.open.get(key)
        if is_away(target) and switch_of(target) is None:
            origin = origin_asked(home, turn, out, source)
            if home.homes.rejoin.keep(home, origin, out, home.path, batch):
                # It is as if it had been asked before this program began.
                home.homes.rejoin.joins(home, turn, key, out)
                return
        ask = self._made(turn, key, out, target)
        switch = switch_of(target)
        if switch is None:
            batch.after.append(lambda: self.send_ask(key, target, ask))
        elif switch.waits(ask):
            ask.give(Answer(*home.node.codec.encode_error(AskDeadlock(out.to, waiters(ask.chain)))), batch)
        elif (bound := switch.intake.bound) is None or bound.makes_room(ask, out.name, out.body, home.path):
            self._record_ask(switch, ask, out, home.path, batch)
        if switch is not None and switch.intake.between is not None:
            batch.after.append(ask.strand)
        elif target.state is DOWN and ask.has_nobody:
            batch.after.append(ask.tell_stranded)

    def _made(self, turn: int, key: int, out: Out, target: Cell) -> SwitchAsk:
        """The ask that is an output of the turn in hand, which waits for it from now on."""
        home, source = self._home, self._home.ledger.open.get(key)
        chain = ((home.path, key), *(source.chain if source is not None else ()))
        hears = None
        if out.trace:
            tail, hears = ask_of_turn(home.node, target, out.name.replace(":", "."), out.trace)
            chain = with_tail(chain, tail)
        ask = SwitchAsk.made(home, turn, out, chain, target, source)
        ask.hears = hears
        home.calls.asks[turn, out.k] = ask
        home.node.deadlines.add(ask)
        return ask

    def ask_again(self, turn: int, key: int, out: Out) -> None:
        """Ask somebody who keeps no journal what was asked in an earlier program, and may be handled twice."""
        target = self._home.node.cell_at(out.to)
        self.send_ask(key, target, self._made(turn, key, out, target))

    def made_again(self, ask: SwitchAsk) -> SwitchAsk:
        """The same ask once more, with its whole time limit; the first one is over."""
        assert ask.out is not None
        ask.drop()
        again = SwitchAsk.made(self._home, ask.turn, ask.out, ask.chain, ask.target, None)
        again.since, again.doubt, again.hears = ask.since, ask.doubt, ask.hears
        self._home.calls.asks[ask.turn, ask.k] = again
        self._home.node.deadlines.add(again)
        return again

    def _record_ask(self, switch: Switch, ask: Ask, out: Out, sender: str | None, batch: Batch) -> None:
        """An ask to a recorded actor, up or not, is journaled in the same append."""
        origin = origin_of(ask) if isinstance(ask, SwitchAsk) else ""
        asked = switch.record(MESSAGE, out.name, out.body, sender, batch, origin)
        switch.awaits(asked, ask)
        batch.after.append(lambda: switch.admitted(asked))

    def send_ask(self, key: int, target: Cell, ask: SwitchAsk) -> None:
        """Ask somebody who keeps no journal, or have that wait until somebody lives there."""
        home, target = self._home, target.living
        if ask.is_over:
            return
        if target.state is GONE and (0 <= key < home.ledger.read or home.homes.rejoin.next_lives.is_to_come(target)):
            # The input is from before the restart: whom it leads to may be started later, as before.
            home.homes.rejoin.next_lives.wait(ask, target.path)
            return
        parcel: Any = ask.message
        if target.state is not DOWN:
            ask.unstrand()
        home.calls.note_unasked(ask, is_so=False)
        try:
            ctx = target.ctx
            if ctx is not None and ctx._turn_in(ask.chain):
                raise AskDeadlock(target.path, waiters(ask.chain))
            ask.message = home.node.codec.message_in(target, parcel.name, parcel.body)
            follow(ask)
            target.admit(target, ask)
        except HoldfastError as error:
            ask.fail(error)

    def _forward(self, turn: int, key: int, out: Out, batch: Batch) -> None:
        home = self._home
        source = home.ledger.open.get(key)
        ask = source.ask if source is not None else None
        target = home.node.cell_at(out.to)
        if source is None or ask is None:
            self._deliver(target, turn, out, batch, None if source is None else source.sender)
            return
        source.ask, ask.started = None, True  # From now on it is the receiver's to answer.
        if out.trace:
            ask.chain = with_tail(ask.chain, out.trace)
            follow(ask)
        switch, sender = switch_of(target), None if ask.sender is None else ask.sender.path
        if (
            switch is None
            and is_away(target)
            and isinstance(ask, SwitchAsk)
            and home.homes.rejoin.keep(home, origin_asked_by(ask), out, ask.asker, batch, ask)
        ):
            return  # It is as if its receiver had had it before this program began.
        if switch is not None and not switch.waits(ask) and switch.takes_now(ask, out, sender):
            self._record_ask(switch, ask, out, sender, batch)
            if switch.intake.between is not None and isinstance(ask, SwitchAsk):
                batch.after.append(ask.strand)
            return

        def send() -> None:
            there = target.living
            try:
                message: Any = ask.message
                if type(message) is Parcel:
                    ask.message = home.node.codec.message_in(there, out.name, out.body)
                there.admit(there, ask)
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
            if home.cell is not None and home.cell.state is not GONE:  # Else its next life will be subscribed.
                home.node.topics.subscribe(out.to, inlet(home, out.to))
        else:
            home.topics.pop(out.to, None)
            if home.cell is not None:
                home.node.topics.unsubscribe(out.to, inlet(home, out.to))


def is_away(target: Cell) -> bool:
    """Whether nobody has lived at an address since this program began."""
    return target.is_dead or is_unread(target)


def trace_of(out: Out) -> Chain:
    """The chain of what a turn sends and does not wait for: its trace, if the turn is in one."""
    return ((out.trace, 0),) if out.trace else ()


def _failure(done: asyncio.Future[None]) -> HoldfastError | None:
    """Why something was not accepted."""
    error = None if done.cancelled() else done.exception()
    return error if isinstance(error, HoldfastError) else None
