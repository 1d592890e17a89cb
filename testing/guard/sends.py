"""Checks of what actors hand to each other, in tests only: declared types, and that nobody changes it afterwards.

A message is shared by its sender and its receivers, and in process nothing copies it: a list in it that is changed
after the send changes under the receiver's hands (and not for one in another process). A reply is shared in the same
way by the actor that gave it and by whoever asked. So the bytes of both are kept from the moment they are handed on,
and compared when a turn of one of the two is over, and at the end.
"""

from __future__ import annotations

import asyncio
import functools
import weakref
from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any

import msgspec

from ...actors.errors import BadMessage, type_name
from ...actors.kernel.cell import Cell
from ...actors.kernel.context import ActorContext
from ...actors.kernel.envelope import Ask, ReplyHandle
from ...actors.kernel.message import Message, message_of, reply_type
from ...actors.kernel.node import Node
from ...actors.kernel.ref import ActorRef, current
from ...actors.values.declared_types import lost_class
from ..library_code import is_module_of_library
from ..probes import ProbeActor
from ..swaps import Swaps
from ..turns import Turns, TurnWatcher, watch_turns
from .changes import ValueBytes, changes
from .declared import PLAIN, is_all_looked_at, is_fixed, may_change, plain_look, wrong_field
from .holders import holders

MOST = 10_000
"""Values that are kept for the comparison; of more, the oldest are compared a last time and forgotten."""
MOST_BYTES = 32 * 1024 * 1024
"""Of all values together."""
NEAR = 8
"""Values that an actor has given or taken last: they are compared after each of its turns."""
SMALL = 4096
"""Bytes of a value up to which that is done; larger ones are compared at the end of their own turn, and of the test."""
SHOWN = 20
"""Problems of one kind that are told in full."""
TEST = "the test"


class Handed:
    """A value that was handed on, and is to stay as it was then."""

    __slots__ = ("about", "body", "giver", "is_over", "taker", "turns", "value")

    def __init__(self, value: Any, body: bytes, giver: Cell | None, taker: str, about: Message[Any] | None) -> None:
        self.value, self.body, self.giver, self.taker, self.about = value, body, giver, taker, about
        self.turns = 0  # that are still to come, of a message
        self.is_over = False

    @property
    def source(self) -> str:
        """Who has given it."""
        return TEST if self.giver is None else self.giver.path


Reads = Callable[[str, bytes], None]
"""Is told what is sent or replied, as words and as bytes."""


class SendChecks(TurnWatcher):
    """The checks of one node, from here to `close`.

    Attributes:
        reads: is told of each message and reply; None: nobody is.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        self.is_expected = self.are_replies_expected = self.are_types_expected = False
        self.reads: Reads | None = None
        # By references, each of which takes itself out: a WeakKeyDictionary takes twice as long.
        self._asks: dict[weakref.ref[asyncio.Future[Any]], tuple[Cell, object]] = {}
        self._images = ValueBytes()
        self._kept: dict[int, Handed] = {}
        self._bytes = 0
        self._near: defaultdict[Cell, deque[Handed]] = defaultdict(_few)
        self._mutated: list[str] = []
        self._aliased: list[str] = []
        self._doors = Doors.opened()
        self._doors.checks[node] = self
        self._unwatch: Callable[[], None] = watch_turns(node, self)

    # -- messages ---------------------------------------------------------------------------------------------------

    def expect_as(self, other: SendChecks) -> None:
        """Complain of no more than another does."""
        self.is_expected, self.are_replies_expected = other.is_expected, other.are_replies_expected
        self.are_types_expected = other.are_types_expected

    def check(self, cell: Cell, message: object) -> None:
        """Look at a message at the moment it is sent.

        Raises:
            BadMessage: a field has another type than it declares, or one of which the receiver would get less if it had
                a process of its own.
        """
        kind = type(message)
        if self.reads is not None and not is_of_library(kind):
            self._read(f"{kind.__qualname__} to {cell.path}", message)
        if plain_look(kind)(message) or not isinstance(message, Message) or is_of_library(kind):
            return
        if not self.are_types_expected and (problem := wrong_field(message) or lost_class(message)):
            raise BadMessage(cell.path, type_name(kind), problem)
        if is_fixed(kind):
            return
        body = self._images.of(message)
        if body is None:
            return
        if not is_all_looked_at(kind) and self._images.is_whole and not self.are_types_expected:
            try:
                self.node.codec.decode(kind, body)
            except msgspec.ValidationError as error:
                raise BadMessage(cell.path, type_name(kind), str(error)) from error
        if not may_change(message):
            return
        sent = self._kept.get(id(message))
        giver = current.get(None)
        if sent is None or sent.is_over or not sent.turns:
            if sent is not None:
                self._compare(sent, "when it was sent again")
                self._forget(sent)
            sent = self._keep(Handed(message, body, None if giver is None else giver._cell, cell.path, None))
            if cell.actor is None:  # Its turns are elsewhere: an answer from there says that they are over.
                self._near[cell].append(sent)
        sent.turns += 1

    def ended(self, cell: Cell, item: Any) -> None:
        """A turn is over: what it handled must be what was sent, and what it has at hand what was handed on."""
        if not self._kept:
            return
        message = message_of(item)
        sent = self._kept.get(id(message))
        if sent is not None and sent.turns:
            sent.turns -= 1
            self._require_same(sent, cell)
            self._near[cell].append(sent)
            if sent.giver is not None:
                self._near[sent.giver].append(sent)
        near = self._near.get(cell)
        if near:
            for one in near:
                if not one.turns and len(one.body) <= SMALL:
                    self._compare(one, "after the turn of ", cell, item)

    def _require_same(self, sent: Handed, cell: Cell) -> None:
        """Up to the end of its turn nobody may change a message, whoever holds it."""
        if not sent.is_over and self._images.of(sent.value) != sent.body and not self._is_reordered(sent):
            sent.is_over = True
            self._mutated.append(
                f"  from {sent.source} to {cell.path}: sent {self._was(sent)}, after its turn it was {sent.value!r}"
            )

    # -- replies ----------------------------------------------------------------------------------------------------

    def asked(self, future: Any, cell: Cell, message: object) -> None:
        """Somebody holds the future of an ask."""
        if isinstance(future, asyncio.Future):
            self._asks[weakref.ref(future, self._asks.pop)] = cell, message

    @property
    def asks(self) -> dict[asyncio.Future[Any], tuple[str, object]]:
        """What was asked, and of whom, by the futures that somebody still holds."""
        held = [(ref(), *asked) for ref, asked in self._asks.copy().items()]  # A collection may take some out.
        return {future: (cell.path, message) for future, cell, message in held if future is not None}

    def replied(self, ask: Ask, reply: object) -> None:
        """An actor answers, or a test in the name of its probe."""
        if ask.to is None or type(reply) is ReplyHandle or ask.future.done():
            return
        if self.reads is not None and not is_of_library(type(ask.message)):
            self._read(f"the reply of {ask.to.path} to {type(ask.message).__qualname__}", reply)
        if ask.to.actor is None:  # It comes from another process: nobody else has it.
            for sent in self._near.get(ask.to, ()):
                if sent.turns:
                    sent.turns = 0
                    self._require_same(sent, ask.to)
            return
        if type(reply) in PLAIN:
            return
        ctx = current.get(None)
        giver: Cell = ask.to if ctx is None else ctx._cell
        if giver.actor is None or not may_change(reply) or is_of_library(type(ask.message)):
            return
        body = self._images.of(reply)
        if body is None or id(reply) in self._kept:
            return
        taker = TEST if ask.sender is None else ask.sender.path
        by_test = ctx is None and isinstance(giver.actor, ProbeActor)
        given = self._keep(Handed(reply, body, None if by_test else giver, taker, ask.message))
        self._near[giver].append(given)
        if ask.sender is not None:
            self._near[ask.sender].append(given)

    def _read(self, what: str, value: object) -> None:
        body = self._images.of(value)
        if body is not None and self.reads is not None:
            self.reads(what, body)

    # -- what is kept -----------------------------------------------------------------------------------------------

    def _keep(self, handed: Handed) -> Handed:
        self._kept[id(handed.value)] = handed
        self._bytes += len(handed.body)
        while len(self._kept) > MOST or (self._bytes > MOST_BYTES and len(self._kept) > 1):
            oldest = next(iter(self._kept.values()))
            if not oldest.turns:
                self._compare(oldest, "later")
            self._forget(oldest)
        return handed

    def _forget(self, handed: Handed) -> None:
        if self._kept.pop(id(handed.value), None) is not None:
            self._bytes -= len(handed.body)
        handed.is_over = True

    def _compare(self, handed: Handed, when: str, cell: Cell | None = None, item: Any = None) -> None:
        """Tell of a value that is another than it was, if somebody else holds what has changed.

        What a sender changes of its own harms nobody, unless a receiver has kept it; what an asker changes harms
        nobody, unless it is the replier's state.
        """
        if handed.is_over:
            return
        now = self._images.of(handed.value)
        if now == handed.body or self._is_reordered(handed):
            return
        changed = changes(handed.value, handed.body, now) if now is not None else {"": handed.value}
        held = holders(self.node, changed.values())
        if handed.about is None or handed.giver is None:
            others = {one: name for one, name in held.items() if one is not handed.giver}
        else:
            others = held if handed.giver in held or len(held) > 1 else {}
        if not others:
            return
        handed.is_over = True
        if cell is not None:
            message = message_of(item)
            when += f"{type(item).__name__ if message is None else repr(message)} at {cell.path}"
        keeper, attribute = next(iter(others.items()))
        path = next(iter(changes_path for changes_path in changed)).removeprefix(".")
        where = f" (in {path})" if path else ""
        holds = f"which {keeper.path} holds as `{attribute}`"
        if handed.about is None:
            self._mutated.append(
                f"  from {handed.source} to {handed.taker}: sent {self._was(handed)}, changed since{where}, {holds}: "
                f"{when} it was {handed.value!r}"
            )
        else:
            self._aliased.append(
                f"  from {handed.source} to {handed.taker}, for {handed.about!r}: replied {self._was(handed)}, changed "
                f"since{where}, {holds}: {when} it was {handed.value!r}"
            )

    def _is_reordered(self, handed: Handed) -> bool:
        """Whether merely a set in the value has another order now."""
        try:
            return bool(self._decoded(handed) == handed.value)
        except (msgspec.MsgspecError, BadMessage, ValueError, TypeError):
            return False

    def _decoded(self, handed: Handed) -> Any:
        declared = type(handed.value) if handed.about is None else reply_type(type(handed.about))
        return self.node.codec.decode(declared, handed.body)

    def _was(self, handed: Handed) -> str:
        try:
            return repr(self._decoded(handed))
        except (msgspec.MsgspecError, BadMessage, ValueError, TypeError):
            return f"{type(handed.value).__name__} {msgspec.msgpack.decode(handed.body)!r}"

    # -- the end ----------------------------------------------------------------------------------------------------

    def last_look(self) -> None:
        """Compare everything, while the actors still are."""
        for handed in list(self._kept.values()):
            if not handed.turns:
                self._compare(handed, "at the end of the test")

    def problems(self) -> list[str]:
        """The messages and replies that were changed, as texts."""
        found: list[str] = []
        if self._mutated and not self.is_expected:
            head = (
                f"{len(self._mutated)} messages were mutated after they were sent; send a copy, and copy what is kept "
                "and changed (if it is meant to be: actor_system.expect_sends())"
            )
            found.append(_listed(head, self._mutated))
        if self._aliased and not self.are_replies_expected:
            head = (
                f"{len(self._aliased)} replies share an object with the state of the actor that gave them; reply "
                "with a copy (if it is meant to be: actor_system.expect_replies())"
            )
            found.append(_listed(head, self._aliased))
        return found

    def close(self) -> None:
        """No more checks."""
        self._unwatch()
        self._unwatch = _nothing  # What it holds need not wait for the garbage collector.
        self._doors.close(self.node)
        self._kept.clear()
        self._near.clear()


def _nothing() -> None:
    """There is nothing more to end."""


def _few() -> deque[Handed]:
    """What an actor has given or taken last."""
    return deque(maxlen=NEAR)


def _is_of_library(kind: type) -> bool:
    """Whether messages of this class are the runtime's own orders: these are no business of the test's."""
    return is_module_of_library(kind.__module__)


is_of_library: Callable[[type], bool] = functools.cache(_is_of_library)


def _listed(head: str, lines: list[str]) -> str:
    more = [f"  ... and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
    return "\n".join([head, *lines[:SHOWN], *more])


def stay_ready() -> Callable[[], None]:
    """Leave what the checks exchange in its place between one test and the next. Returns what ends that.

    Nobody is checked by that. To exchange it anew for each test has the interpreter forget, twice, what it knows of the
    classes of refs and contexts, which takes as long as the checks themselves.
    """
    doors, turns = Doors.opened(), Turns.installed()
    doors.hold(1)
    turns.hold(1)

    def end() -> None:
        doors.hold(-1)
        turns.hold(-1)

    return end


class Doors:
    """The ways in which values are handed on, exchanged for ones that check, while any node wants that."""

    def __init__(self) -> None:
        self.checks: dict[Node, SendChecks] = {}
        self._holds = 0
        self._swaps = Swaps()
        for name in ("tell", "send"):
            self._swaps.put(ActorRef, name, self._through_ref(getattr(ActorRef, name)))
        self._swaps.put(ActorRef, "ask", self._through_ask(ActorRef.ask))
        self._swaps.put(ActorContext, "_send", self._through_context(ActorContext._send))
        self._swaps.put(Ask, "answer", self._through_answer(Ask.answer))

    @staticmethod
    def opened() -> Doors:
        """Those that stand open, or new ones."""
        standing = getattr(ActorRef.tell, "doors", None)
        return standing if isinstance(standing, Doors) else Doors()

    def close(self, node: Node) -> None:
        """This node needs them no more."""
        self.checks.pop(node, None)
        self.hold(0)

    def hold(self, change: int) -> None:
        """Stay open while anybody holds this, also where no node wants it."""
        self._holds += change
        if not self.checks and not self._holds:
            self._swaps.undo()

    def _through_ref(self, send: Any) -> Any:
        @functools.wraps(send)
        def checked(ref: ActorRef[Any], message: Message[Any], *rest: Any, **options: Any) -> Any:
            self._check(ref._cell, message)
            return send(ref, message, *rest, **options)

        checked.doors = self  # type: ignore[attr-defined]  # so that another system finds them
        return checked

    def _through_ask(self, ask: Any) -> Any:
        @functools.wraps(ask)
        def checked(ref: ActorRef[Any], message: Message[Any], *rest: Any, **options: Any) -> Any:
            cell = ref._cell
            checks = self.checks.get(cell.node)
            if checks is None:
                return ask(ref, message, *rest, **options)
            checks.check(cell, message)
            future = ask(ref, message, *rest, **options)
            checks.asked(future, cell, message)
            return future

        return checked

    def _through_context(self, send: Any) -> Any:
        @functools.wraps(send)
        def checked(ctx: ActorContext, cell: Cell, message: Message[Any]) -> Any:
            self._check(cell, message)
            return send(ctx, cell, message)

        return checked

    def _through_answer(self, answer: Any) -> Any:
        @functools.wraps(answer)
        def checked(ask: Ask, reply: object) -> None:
            checks = self.checks.get(ask.to.node) if ask.to is not None else None
            if checks is not None:
                checks.replied(ask, reply)
            answer(ask, reply)

        return checked

    def _check(self, cell: Cell, message: Message[Any]) -> None:
        checks = self.checks.get(cell.node)
        if checks is not None:
            checks.check(cell, message)
