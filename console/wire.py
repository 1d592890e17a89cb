"""The protocol between an operator's command and a running system, over the control endpoint.

A frame is a length, as between processes, and MessagePack. Requests are typed and bounded; what has to be rebuilt with
its classes (child specs, functions, states) travels as packed bytes and is opened only when the request is carried out.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from types import NoneType
from typing import Any, Literal, NamedTuple

import msgspec

from ..actors.control.orders import pack_function, unpack_function
from ..actors.errors import HoldfastError, RemoteCrash, SpecError, error_text, rebuild_error, type_name
from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.codec import MAX_BYTES
from ..actors.process.wire.frame_buffer import LENGTH
from ..actors.process.wire.start_codec import pack_data, pack_recipe, unpack_data, unpack_recipe
from ..actors.values import decode_value, encode_value
from ..supervision.spec import ChildSpec
from ..system.history.pages import HistoryQuestion
from ..system.last_lines.line_page import LogQuestion

CREDENTIALS = struct.Struct("3i")


class BadRequest(HoldfastError, text="this is no request: {problem}"):
    """What came over the control endpoint is no request: the connection is closed."""

    problem: str


class NotServed(HoldfastError, text="the system cannot watch another connection now: {why}"):
    """The kernel watches no more descriptors for the system: connect again when it has room."""

    why: str


class NotDiagnosed(HoldfastError, text="{problem}"):
    """No diagnosis of the system runs, or it has no component at the address that was asked about."""

    problem: str


class NotRunningHere(HoldfastError, text="process {pid} does not run {system}: {why}"):
    """The program waits to lead its system, or is being started: it says which it is, and nothing else."""

    pid: int
    system: str
    why: str


class NotEnded(
    HoldfastError,
    text="{path} has not ended within {seconds:g} s{turn}; it has been told to, and is restarted when it gets to that; "
    "`holdfast restart --kill` ends it at once",
):
    """A life was told to end in good order, and has not ended so far."""

    path: str
    seconds: float
    turn: str


class NotUpYet(
    HoldfastError,
    text="{path} has ended ({reason}), and its next life is not up within {seconds:g} s: it waits for {above}, "
    "and comes when that gets to it",
):
    """A life was ended by order, and its supervisor has not brought up the next one so far."""

    path: str
    reason: str
    seconds: float
    above: str


class WrongUser(HoldfastError, text="the other end runs as the user with uid {uid}, and only uid {expected} is served"):
    """The other end of the control endpoint belongs to another user."""

    uid: int
    expected: int


class PeerProcess(NamedTuple):
    """Who is at the other end of a Unix socket: the process that has connected, or listens there, and its user."""

    pid: int
    uid: int


def peer_of(sock: socket.socket) -> PeerProcess:
    """Who is at the other end of a Unix socket, as the kernel says."""
    pid, uid, _ = CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    return PeerProcess(pid, uid)


def check_user(uid: int, expected: int) -> None:
    """Raises WrongUser unless both are the same."""
    if uid != expected:
        raise WrongUser(uid, expected)


# -- arguments of operations ------------------------------------------------------------------------------------------


class Arg(msgspec.Struct, array_like=True, frozen=True, tag_field="kind"):
    """Base of the arguments of an order that goes over the control endpoint."""


class PlainArg(Arg, tag="plain", array_like=True, frozen=True):
    """Text, a number, a truth, None, or a list of texts."""

    value: str | bool | int | float | list[str] | None


class PackedArg(Arg, tag="packed", array_like=True, frozen=True):
    """What has to be rebuilt: a child spec, recipe or options, a function, the recipe of a class, or mechanisms."""

    of: Literal["spec", "function", "code", "mechanism"]
    data: bytes


AnyArg = PlainArg | PackedArg


def pack_arg(value: Any, where: str) -> AnyArg:
    """An argument for the wire.

    Raises:
        SpecError, UnsavableValue: it cannot be sent.
    """
    if isinstance(value, (ChildSpec, Start, dict)):
        return PackedArg("spec", pack_data(value, where))
    if isinstance(value, type) and issubclass(value, Actor):
        return PackedArg("code", pack_recipe(Start(value), where))
    if is_mechanism(value):
        return PackedArg("mechanism", encode_value(pack_mechanism(value), where=where))
    if callable(value):
        return PackedArg("function", encode_value(pack_function(value, where, where)))
    plain: Any = list(value) if isinstance(value, (list, tuple)) else value
    is_text = isinstance(plain, list) and all(isinstance(one, str) for one in plain)
    if not is_text and not isinstance(plain, (str, int, float, NoneType)):
        raise SpecError(where, f"{value!r} cannot be sent to the running system")
    return PlainArg(plain)


def open_arg(arg: AnyArg) -> Any:
    """The argument again. Imports the modules it needs."""
    if isinstance(arg, PlainArg):
        return arg.value
    if arg.of == "spec":
        return unpack_data(arg.data)
    if arg.of == "code":
        return unpack_recipe(arg.data).kind
    if arg.of == "mechanism":
        data: Any = decode_value(arg.data)
        return open_mechanism(data)
    return unpack_function(decode_value(arg.data))


def is_mechanism(value: Any) -> bool:
    """Whether these are mechanisms: one or several, each an instance, or a class of them."""
    from ..ftm.model.mechanism import Mechanism

    layers: Any = value if isinstance(value, (tuple, list)) and value else (value,)
    found = [isinstance(one, Mechanism) or (isinstance(one, type) and issubclass(one, Mechanism)) for one in layers]
    named = [isinstance(one, str) for one in layers]
    return any(found) and all(map(max, found, named))


def pack_mechanism(value: Any) -> list[Any]:
    """Mechanisms as plain data: each its name or file, or how it is described; whether they are several."""
    from ..ftm.model.mechanism import Mechanism

    layers: Any = value if isinstance(value, (tuple, list)) else (value,)
    made = [one() if isinstance(one, type) else one for one in layers]
    said = [msgspec.msgpack.encode(one.describe()) if isinstance(one, Mechanism) else str(one) for one in made]
    return [isinstance(value, (tuple, list)), *said]


def open_mechanism(data: list[Any]) -> Any:
    """The mechanisms again. Imports the modules, or reads the files, that define them."""
    from ..ftm.model.mechanism import Description, revive

    several, *said = data
    made = [one if isinstance(one, str) else revive(msgspec.msgpack.decode(one, type=Description)) for one in said]
    return tuple(made) if several else made[0]


# -- requests ---------------------------------------------------------------------------------------------------------


class ControlRequest(msgspec.Struct, tag_field="ask", forbid_unknown_fields=True, frozen=True):
    """Base of all requests to a running system."""


class About(ControlRequest, tag="about", frozen=True):
    """Which system this is: its name, its process, since when it is served, and how many actors it has."""


class Overview(ControlRequest, tag="overview", frozen=True):
    """How all actors are; with `parts` those of the runtime itself too; with `paths` only those at these addresses."""

    parts: bool = False
    paths: tuple[str, ...] | None = None


class InspectActor(ControlRequest, tag="inspect", frozen=True):
    """All that can be said of one actor."""

    path: str
    timeout: float = 5.0


class RestartActor(ControlRequest, tag="restart", frozen=True):
    """End a life in good order, or `at_once`, so that its supervisor begins the next one."""

    path: str
    timeout: float = 5.0
    at_once: bool = False


class SendMessage(ControlRequest, tag="send", frozen=True):
    """Send one actor a message of a class that it handles, with `fields` as a JSON object; `asks`: for its reply."""

    path: str
    message: str
    fields: str
    asks: bool
    timeout: float = 5.0


class FollowActor(ControlRequest, tag="follow", frozen=True):
    """Follow the messages of one actor, for as long as this connection lasts."""

    path: str


class NextEvents(ControlRequest, tag="next", frozen=True):
    """What the actor that is followed has done since the last time; at most so many seconds are waited for it."""

    seconds: float


class CountTurns(ControlRequest, tag="count", frozen=True):
    """Count the turns of just these actors, for as long as this connection lasts, and say how many there were."""

    paths: list[str]


class Tree(ControlRequest, tag="tree", frozen=True):
    """All addresses that live now."""


class Whereis(ControlRequest, tag="whereis", frozen=True):
    """The address of the actor with this name."""

    name: str


class ControlActor(ControlRequest, tag="control", frozen=True):
    """An operator's order to one actor."""

    verb: Literal[
        "suspend",
        "resume",
        "get_state",
        "outline",
        "get_status",
        "protection",
        "statistics",
        "checkpoint",
        "terminate",
        "replace_state",
        "replace_code",
    ]
    path: str
    args: list[AnyArg]
    timeout: float
    script: tuple[str, str] | None = None


class Transact(ControlRequest, tag="transaction", frozen=True):
    """A whole transaction; `script` is the file that its classes may be defined in, and its sha256."""

    operations: list[tuple[str, list[AnyArg]]]
    dry_run: bool
    timeout: float
    script: tuple[str, str] | None = None


class AskHistory(ControlRequest, tag="history", frozen=True):
    """Past events, as `ActorSystem.history` takes the question; with `wait`, until there is one, or for so long."""

    question: HistoryQuestion
    wait: float = 0.0


class AskLogs(ControlRequest, tag="logs", frozen=True):
    """Last lines, as `ActorSystem.logs` takes the question; with `wait`, until there is one, or for so long."""

    question: LogQuestion
    wait: float = 0.0


class AskLives(ControlRequest, tag="lives", frozen=True):
    """The newest lives at an address."""

    path: str


class AskWhy(ControlRequest, tag="why", frozen=True):
    """Why an actor is as it is, in sentences."""

    path: str
    timeout: float


class AskCauses(ControlRequest, tag="causes", frozen=True):
    """What is wrong at addresses: of each the sentences of `AskWhy`, every one with the name of its cause."""

    paths: tuple[str, ...]
    timeout: float


class AskQuarantined(ControlRequest, tag="quarantined", frozen=True):
    """The messages in quarantine, of one address or of all."""

    path: str | None


class SettleQuarantined(ControlRequest, tag="settle", frozen=True):
    """Have messages in quarantine handled again, or dropped: one by its id, or all of an address."""

    verb: Literal["retry", "drop"]
    path: str
    id: int | None


class AskConnections(ControlRequest, tag="connections", frozen=True):
    """Which programs are connected, and what is kept for which system."""


class DropKept(ControlRequest, tag="drop-kept", frozen=True):
    """Drop what is kept for another system, and forget that system."""

    system: str


class AskDiagnosis(ControlRequest, tag="diagnosis", frozen=True):
    """What diagnosis says now, of all or of what is at an address and below it."""

    path: str | None
    timeout: float


RepairVerb = Literal["status", "approve", "deny", "retry", "set"]
"""What can be ordered of repair."""


class OrderRepair(ControlRequest, tag="repair", frozen=True):
    """Ask how repair stands, after an order to it: approve or deny a case, retry components, set how far it goes."""

    verb: RepairVerb
    words: tuple[str, ...]
    timeout: float


class DeclareTree(ControlRequest, tag="declare", frozen=True):
    """Have the tree be as a file says; `name` is what it is called in errors."""

    text: str
    name: str
    dry_run: bool
    timeout: float


AnyRequest = (
    About
    | Overview
    | InspectActor
    | RestartActor
    | SendMessage
    | FollowActor
    | NextEvents
    | CountTurns
    | DeclareTree
    | AskHistory
    | AskLogs
    | AskLives
    | AskWhy
    | AskCauses
    | AskQuarantined
    | SettleQuarantined
    | AskConnections
    | DropKept
    | AskDiagnosis
    | OrderRepair
    | Tree
    | Whereis
    | ControlActor
    | Transact
)
REQUEST: msgspec.msgpack.Decoder[AnyRequest] = msgspec.msgpack.Decoder(AnyRequest)


class ControlResponse(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The outcome of one request: a value, or an error."""

    value: bytes = b""
    error: str = ""  # the error's class
    args: bytes = b""  # its arguments, if they can be sent
    text: str = ""


RESPONSE: msgspec.msgpack.Decoder[ControlResponse] = msgspec.msgpack.Decoder(ControlResponse)


def frame(value: ControlRequest | ControlResponse) -> bytes:
    """Head and body. Raises BadRequest: too large, or with a number that is."""
    try:
        body = msgspec.msgpack.encode(value)
    except OverflowError as error:
        raise BadRequest("a number in it has more than 64 bits") from error
    head = LENGTH.pack(len(body))
    body_size(head)
    return head + body


def body_size(head: bytes) -> int:
    """The bytes that follow the head of a frame. Raises BadRequest: too many."""
    (size,) = LENGTH.unpack(head)
    if size > MAX_BYTES:
        raise BadRequest(f"it has {size} bytes, and {MAX_BYTES} are allowed")
    return int(size)


def failure(error: BaseException) -> ControlResponse:
    """An error as a response; if its arguments cannot be sent it arrives as a RemoteCrash."""
    args = b""
    if isinstance(error, HoldfastError):
        try:
            args = encode_value(tuple(error.args))
        except HoldfastError:
            pass  # A refusal with a lock in it, say: its text has to do.
    return ControlResponse(error=type_name(type(error)), args=args, text=error_text(error))


def outcome(response: ControlResponse, read: Callable[[bytes], Any] = decode_value) -> Any:
    """The value in a response, as `read` makes it of its bytes.

    Raises:
        HoldfastError: the error in it, as its class if that is known here.
    """
    if not response.error:
        return read(response.value)
    error: HoldfastError | None = None
    if response.args:
        try:
            args: Any = decode_value(response.args)
            error = rebuild_error(response.error, args)
        except Exception:
            error = None  # Whatever is wrong with the arguments, its text says what happened.
    raise error or RemoteCrash(response.error, response.text)
