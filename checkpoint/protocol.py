"""The records that a home and a recorded life exchange, in one process or across the border of one.

The home (`home/switch.py`) numbers and journals inputs and feeds them; the life (`life/recorded_life.py`) runs one turn
per input and reports each turn's outputs and outcome. Payloads stay encoded in between.

What there is many of is not seen by the garbage collector (`gc=False`): nothing in it refers back.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterator
from typing import Annotated, Any, Final, TypeAlias

import msgspec

from ..actors.effects import FailedAttempt
from ..actors.exit_reasons import ExitReason, recorded_exit
from ..actors.kernel.cell import GivenName
from ..actors.kernel.mailbox import Bounded
from .method import Method

# Kinds of inputs: every call into user code that may change state.
MESSAGE, START, TICK, EXIT, DOWN, PIPE = "message", "start", "tick", "exit", "down", "pipe"
# Outputs whose turn waits for what becomes of them.
AWAITED = ("ask", "send", "publish", "effect", "sleep", "wait")
# Outputs that lead to no address: where somebody lives is nothing to a replay of them.
NOWHERE = ("effect", "sleep", "wait")
LEADS_NOWHERE = 1 << 32
"""Marks digests of such outputs. The rest of a digest is a checksum of 32 bits; stores of before have only that."""
# How a turn can end.
OK, FAILED, DROPPED, STASHED = "ok", "failed", "dropped", "stashed"
# How an ask can be answered; LATER keeps it open, NOTHING means that nobody asked.
REPLY, REFUSAL, ERROR, CRASH, LATER, NOTHING = "reply", "refusal", "error", "crash", "later", ""
# What else a turn can wait for: a moment, or (MESSAGE) a message. If it may have waited for long, the kind of the
# outcome begins with TIMED, and its body has the Unix time at which it came in front.
MOMENT, TIMED = "moment", "timed "
# The turn has cancelled what it waited for: nothing is taken for it or done any more.
GIVEN_UP = "given up"
# In place of a receiver, of a wait whose `seconds` begin with it; else they are Unix time.
SINCE_THEN = "since then"


Finite: TypeAlias = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
"""A number of seconds as a process may say it: neither infinite nor no number at all."""


class Out(msgspec.Struct, array_like=True, gc=False):
    """One output of a turn; `k` counts them in program order from 1. `trace` is that of its turn, and no part of it."""

    k: int
    verb: str
    to: str
    name: str = ""
    body: bytes = b""
    seconds: Finite = 0.0
    interval: Finite = 0.0
    trace: str = ""

    def digest(self) -> int:
        """A checksum by which a replayed output is compared with the one released before."""
        head = f"{self.verb}|{self.to}|{self.name}|{self.seconds}|{self.interval}".encode()
        checksum = zlib.crc32(self.body, zlib.crc32(head))
        return checksum | LEADS_NOWHERE if self.verb in NOWHERE else checksum


def shortened(body: bytes) -> Iterator[bytes]:
    """A body as it was coded when its class had fewer fields: none of the last ones, one after another.

    >>> [msgspec.msgpack.decode(one) for one in shortened(msgspec.msgpack.encode([1, "a"]))]
    [[1], []]
    """
    fields = msgspec.msgpack.decode(body) if body else None
    while isinstance(fields, list | dict) and fields:
        if isinstance(fields, list):
            fields.pop()
        else:
            fields.popitem()  # The last one.
        yield msgspec.msgpack.encode(fields)


class Answer(msgspec.Struct, array_like=True, gc=False):
    """The outcome of an ask: a reply or an error, encoded."""

    kind: str = NOTHING
    name: str = ""
    body: bytes = b""


TOO_LATE, AT_ITS_END = -1, -2
"""In place of the number of an outcome: its turn was over; it comes after all others, as nobody knows those here."""


class Came(Answer, array_like=True, gc=False):
    """What came of an output, and when: the turn had heard `nth - 1` outcomes, and had let `after` outputs out.

    A replay hears it there again; where `nth` is 0, as soon as it asks for it.
    """

    nth: int = 0
    after: int = 0


STEPS: Final = 4
"""Steps of the event loop in which a handler acts on an outcome. `asyncio.wait` and `asyncio.gather` take two, and an
`asyncio.shield`, a task or a further `gather` around what was awaited takes one more, or two."""


def came(answer: Answer, nth: int = 0, after: int = 0) -> Came:
    """The same outcome, and its place among those of its turn."""
    return Came(answer.kind, answer.name, answer.body, nth, after)


NO_ANSWER = Answer()
"""Of a turn that nobody has asked for."""


def timed(answer: Answer, when: float) -> Answer:
    """The same outcome, with the time at which it came."""
    return Answer(TIMED + answer.kind, answer.name, msgspec.msgpack.encode((when, answer.body)))


def untimed(answer: Answer) -> tuple[Answer, float]:
    """The outcome itself, and when it came; 0.0 if that is not known.

    >>> untimed(timed(Answer("reply", "", b"x"), 3.0))
    (Answer(kind='reply', name='', body=b'x'), 3.0)
    """
    if not answer.kind.startswith(TIMED):
        return answer, 0.0
    when, body = msgspec.msgpack.decode(answer.body, type=tuple[float, bytes])
    return Answer(answer.kind.removeprefix(TIMED), answer.name, body), when


def answer_digest(answer: Answer) -> int:
    """A checksum by which the reply of a replayed turn is compared; 0 if there is none."""
    if answer.kind == NOTHING:
        return 0
    return zlib.crc32(answer.body, zlib.crc32(f"{answer.kind}|{answer.name}".encode())) or 1


Clock = tuple[str, bytes, Finite]
"""What a timer says: type name and body of its message, and its interval (0: it comes once)."""


class EndWanted(msgspec.Struct, array_like=True, gc=False):
    """An actor is to end behind `turn`, because that has called `ctx.stop`; the `reason` is encoded.

    `is_cut_off`: it is an EXIT that is not trapped, and no `on_stop` is called.
    """

    turn: int
    reason: bytes
    is_cut_off: bool = False

    @property
    def exit_reason(self) -> ExitReason:
        """Why the actor ends, as its supervisor is told."""
        return recorded_exit(msgspec.msgpack.decode(self.reason))


# -- home to life ----------------------------------------------------------------------------------------------------


class Feed(msgspec.Struct, array_like=True, tag=1, gc=False):
    """An input.

    `turn` is the number it had before the crash, -1 if it never ended; `pipes` have their result already; from
    `deadline` on (on the loop's clock, 0: never) it is not begun any more, unless it `has_begun`, that is: its turn has
    sent something, and has no end; `origin` is the timer or the background work that it comes from. `spent`: timers
    whose messages came in turns before this one that are not handled again.
    """

    id: int
    turn: int
    kind: str
    name: str
    body: bytes
    time: float
    sender: str | None = None
    is_ask: bool = False
    chain: tuple[tuple[str, int], ...] = ()
    pipes: tuple[int, ...] = ()
    deadline: float = 0.0
    origin: str = ""
    has_begun: bool = False
    spent: tuple[str, ...] = ()


class Outcome(msgspec.Struct, array_like=True, tag=2):
    """The outcome of what was output (turn, k), whose digest is `asked` (0: not known).

    The input `taken` is the message that it waited for, and is not fed.
    """

    turn: int
    k: int
    answer: Came
    taken: int = -1
    asked: int = 0


class Perform(msgspec.Struct, array_like=True, tag=22):
    """The effect that was output (turn, k) has no outcome, and all that precedes it is safe: perform it.

    `token` is the fencing token of whoever is ordered to; `alone`: its process has died in this turn again and again,
    perhaps of another one's thread.
    """

    turn: int
    k: int
    token: int
    alone: bool = False


class Go(msgspec.Struct, array_like=True, tag=3):
    """Replay is over: call `on_recovered` (if anything was recovered), report, then go on after turn `turn`.

    Inputs in `gone` were stashed under replay and have ended since, in turns that are not replayed. `timers` run now.
    The input `begun` has sent something in a turn without an end: it comes first, before what a hook has put back.
    `ends`: the life is to end instead of going on, as a turn has said and no life has done yet. What turns up to
    `ended` have said of that is done. `spent`: as of a `Feed`.
    """

    recovered: bool
    turn: int
    gone: tuple[int, ...] = ()
    timers: dict[str, Clock] = {}
    begun: int = -1
    ends: EndWanted | None = None
    ended: int = -1
    spent: tuple[str, ...] = ()


class SnapshotNow(msgspec.Struct, array_like=True, tag=4):
    """Take a snapshot after the inputs that have been fed, or (`urgent`) in front of them.

    Not `at_once`: the last one could not be kept, and the next that is asked for is not superfluous.
    """

    at_once: bool = True
    urgent: bool = False


class Lent(msgspec.Struct, array_like=True):
    """An image in memory that a life may map: `segments` are (number, descriptor, inode) in process `pid`.

    `places`: where its blocks are (segment, offset, length).
    """

    pid: int
    segments: list[tuple[int, int, int]]
    places: list[tuple[int, int, int]]


class Restore(msgspec.Struct, array_like=True, tag=5):
    """A piece of the state to begin with, or (`image`) where all of it is; the launch comes behind the last one.

    The first one also says which timers ran when that state was saved, whether the actor trapped exits, and which
    `variables` its class had.
    """

    data: bytes
    timers: dict[str, Clock] = {}
    traps: bool = False
    variables: list[str] = []
    image: Lent | None = None


class Begin(msgspec.Struct, array_like=True, tag=6):
    """The life that was wanted as `number` begins now, as the `life`th at its address, with the state that came before.

    `slot` is its place on the page that outlives the process.
    """

    number: int
    life: int
    turn: int
    stash: list[int]
    slot: int


class Started(msgspec.Struct, array_like=True, tag=7):
    """The start that was wanted as `number` has come to its end: a good one, or (`problem`) not.

    `is_ignored`: it does not want to be started.
    """

    number: int
    problem: str = ""
    is_ignored: bool = False


class Kept(msgspec.Struct, array_like=True, tag=8):
    """The home has the image that was written into this segment: what follows may refer to it. Or (not `is_safe`) not.

    `is_full`: the next image should be written anew. `digests`: of those blocks of the image that a store has, and that
    need no memory any more; by their place in the order of the image.
    """

    segment: int
    is_safe: bool
    is_full: bool = False
    digests: dict[int, bytes] = {}


class Over(msgspec.Struct, array_like=True, tag=9):
    """The life that was wanted as `number` is over, if it was lived at the root; else it has to end, for this reason.

    `Closed` is the answer.
    """

    number: int
    reason: dict[str, Any]


class Respec(msgspec.Struct, array_like=True, tag=10):
    """The child has other mechanisms from now on, also in its next lives: layers as data, none if there are none.

    `isolation` and `limits`: where it lives without a mechanism. `start`: the recipe of its next lives, if that is not
    as before.
    """

    layers: list[Any]
    isolation: str = "task"
    limits: dict[str, Any] = {}
    start: bytes = b""


class Glance(msgspec.Struct, array_like=True, tag=24):
    """An ask that changes nothing, and has been fed or will be: answer it beside the turn in hand while that rests."""

    feed: Feed


class Stranded(msgspec.Struct, array_like=True, tag=28):
    """Who is to answer what was asked as output (turn, k) has been stopped, and does so in its next life.

    A life that is to end does not wait for that: it leaves the turn to its own next life.
    `is_over`: who is to answer lives again.
    """

    turn: int
    k: int
    is_over: bool = False


PastInputs = Outcome | Perform | SnapshotNow
"""What a home says to a life beside its inputs: it overtakes those that wait."""

ToLife = (
    Feed | Outcome | Perform | Go | SnapshotNow | Restore | Begin | Started | Kept | Over | Respec | Glance | Stranded
)


# -- life to home ----------------------------------------------------------------------------------------------------


class Released(msgspec.Struct, array_like=True, tag=11):
    """Outputs that leave before their turn ends: an ask, a send or a flush wants them out."""

    turn: int
    id: int
    outs: list[Out]


class TurnEnd(msgspec.Struct, array_like=True, tag=12, gc=False):
    """A turn has ended; `outs` are those not released yet. `ends`: the life ends behind it, as it has said itself."""

    turn: int
    id: int
    status: str
    outs: list[Out]
    answer: Answer
    state: int = 0  # digest of the state it has left, if that is checked
    ends: EndWanted | None = None


class Hooked(msgspec.Struct, array_like=True, tag=21):
    """What a hook does that outlives it; it takes effect at once. `hook` is "start", "recovered" or "stop"."""

    hook: str
    out: Out


class Live(msgspec.Struct, array_like=True, tag=13):
    """`Go` was reached: the actor takes new inputs. `restore_seconds` is what putting the state back took.

    `promises`: inputs whose asks it can answer later, for it was given, or has made, a handle; None: that is not known.
    """

    restore_seconds: Finite
    promises: list[int] | None = None


class Shared(msgspec.Struct, array_like=True):
    """An image in memory that its home can open: segment `number` is descriptor `file` of process `pid`.

    `places`: where its blocks are, in this segment and earlier ones (segment, offset, length). `is_idle`: a copy of the
    process will compare the next one, which may take its time for that.
    """

    number: int
    pid: int
    file: int
    inode: int
    size: int
    places: list[tuple[int, int, int]]
    is_idle: bool = False


class Snapshot(msgspec.Struct, array_like=True, tag=14):
    """A piece of the state after `turn`; `is_last` completes it.

    `is_replaced`: it was put in place from outside, so no replay leads to it. `image`: where it is, if not in `data`.
    `kind`: the actor's class, and `variables` those that it had when `__init__` had run.
    """

    turn: int
    data: bytes
    is_last: bool
    stash: list[int]
    pause: Finite
    is_replaced: bool = False
    image: Shared | None = None
    traps: bool = False  # `ctx.trap_exits`
    kind: str = ""
    variables: list[str] = []


class Marked(msgspec.Struct, array_like=True, tag=20):
    """An image of the state after `turn` is being written, while the actor goes on."""

    turn: int


class PipeDone(msgspec.Struct, array_like=True, tag=15):
    """Background work that was output (turn, k) has its result: a message to the actor itself; no name: an error.

    `k` is 0 for what a hook has begun: no turn is replayed to begin it again.
    """

    turn: int
    k: int
    name: str
    body: bytes


class Performed(msgspec.Struct, array_like=True, tag=23):
    """The effect that was output (turn, k) has this outcome."""

    turn: int
    k: int
    answer: Answer


class Retried(msgspec.Struct, array_like=True, tag=29):
    """An attempt of the effect that was output (turn, k) has failed, and is followed by another one."""

    turn: int
    k: int
    attempt: FailedAttempt


class GivenUp(msgspec.Struct, array_like=True, tag=27):
    """The turn does not wait any more for what comes of its output (turn, k), and has not got it."""

    turn: int
    k: int


class Unreadable(msgspec.Struct, array_like=True, tag=31):
    """The life cannot read what has come of its output (turn, k), and an earlier one could: its code is another."""

    turn: int
    k: int
    problem: str


MidTurn = Released | Performed | Retried | GivenUp | Unreadable
"""What a life says in the middle of a turn."""


class Glanced(msgspec.Struct, array_like=True, tag=25):
    """The input `id`, an ask that changes nothing, has this answer, and is not handled in a turn."""

    id: int
    answer: Answer


class Waits(msgspec.Struct, array_like=True, tag=26):
    """The turn that had begun in an earlier life waits now, and this life has heard so many outcomes so far."""

    heard: int


class LeavesTurn(msgspec.Struct, array_like=True, tag=30):
    """The life is to end behind the turn in hand: whose answers cannot come before that, it does not wait for."""


class Unsaved(msgspec.Struct, array_like=True, tag=16):
    """The state could not be saved: no snapshot came of it."""

    problem: str


class AtRoot(msgspec.Struct, array_like=True):
    """What a wanted child is made of that is lived at the root: its recipe, and the layers of its mechanisms as data.

    Without layers it has a process of its own, with these limits.
    """

    recipe: bytes
    layers: list[Any]
    limits: dict[str, Any] = {}


class Wanted(msgspec.Struct, array_like=True, tag=17):
    """A supervisor in another process wants to start a child whose home is at the root, or that is lived there.

    `bindings` says where those of the child lead, port to address; `register` is the name that its spec gives it;
    `made_up` whether its id was, `comes_back` whether it is started again when its supervisor has been.
    """

    number: int
    kind: str
    topics: list[str]
    method: Method
    bound: Bounded | None
    at_root: AtRoot | None = None
    bindings: dict[str, str] = {}
    register: GivenName | None = None
    made_up: bool = False
    goes_on: bool = True
    """Whether the end of its last life is followed by one that goes on where it was; the root takes it down."""
    comes_back: bool = True

    def restarts(self, reason: ExitReason) -> bool:
        """Whether another life follows, as its supervisor has said."""
        return self.goes_on


class Closed(msgspec.Struct, array_like=True, tag=18):
    """The life that was wanted as `number` is over, or its start is given up."""

    number: int
    reason: dict[str, Any]
    recovers: bool = False


class Ignored(msgspec.Struct, array_like=True, tag=19):
    """The actor does not want to be started."""

    why: str


ToHome = (
    Ignored
    | Released
    | TurnEnd
    | Hooked
    | Live
    | Snapshot
    | PipeDone
    | Performed
    | Retried
    | GivenUp
    | Unreadable
    | Glanced
    | Unsaved
    | Wanted
    | Closed
    | Marked
    | Waits
    | LeavesTurn
)


PIECE = 4 * 1024 * 1024
"""Bytes of state per record, so that a large state does not hold up everything else."""


def pieces(data: bytes) -> list[bytes]:
    """`data` in pieces, at least one."""
    return [data[at : at + PIECE] for at in range(0, len(data), PIECE)] or [b""]
