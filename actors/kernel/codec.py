"""The wire codec: typed payloads as MessagePack by msgspec, with refs and numpy arrays as extensions. No pickle.

A payload is decoded only into a type that the receiver itself names: a handler's message class, or the reply type of
what was asked. Nothing that comes over a wire makes this process import or construct anything else.
"""

from __future__ import annotations

import copy
import functools
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from ..errors import (
    AskFailed,
    BadMessage,
    BadReply,
    DamagedValue,
    HoldfastError,
    RemoteCrash,
    UnknownMessage,
    error_text,
    rebuild_error,
    remote_crash,
    shown,
    type_name,
)
from ..values.arrays import described_dtype
from ..values.declared_types import class_fields, holds_set, lost_from
from .cell import GONE
from .envelope import ReplyHandle, refuse
from .message import Message, Refusal, RuntimeCall, UnknownRefusal, find_refusal, message_name, reply_type
from .ref import ActorRef

if TYPE_CHECKING:
    from .actor import Actor
    from .cell import Cell

MAX_BYTES = 16 * 1024 * 1024
"""The largest message, in bytes of payload."""

REF, ARRAY, PACKED, EXTENSIONS = 1, 2, 3, (1, 2, 3)

LONGEST_HEAD = 64 * 1024
"""Bytes that dtype and shape of an array may take."""

Raw = msgspec.Raw


class Parcel:
    """A message that is still encoded: what a router passes on and a journal keeps."""

    __slots__ = ("body", "name")

    def __init__(self, name: str, body: bytes) -> None:
        self.name, self.body = name, body

    def __repr__(self) -> str:
        return f"<Parcel {self.name} {len(self.body)} bytes>"


class Packable(ABC):
    """A value that makes its own bytes; they come out as `Packed`, which nobody opens by accident."""

    __slots__ = ()

    @abstractmethod
    def packed(self) -> bytes:
        """The bytes; raises HoldfastError if it cannot be sent."""


class Packed(Packable):
    """A value that came packed. Whoever it is for decides whether its sender may have it opened."""

    __slots__ = ("data",)

    def __init__(self, data: bytes) -> None:
        self.data = data

    def packed(self) -> bytes:
        """The bytes as they came."""
        return self.data


class Codec:
    """Encodes and decodes for one node: refs in payloads are refs of that node."""

    def __init__(self, cell_at: Callable[[str], Cell]) -> None:
        self._cell_at = cell_at
        self.encoder = msgspec.msgpack.Encoder(enc_hook=encode_special)
        self._decoders: dict[Any, Callable[[Any], Any]] = {}
        self._reply_decoders: dict[type[Message[Any]], Callable[[Any], Any]] = {}

    def encode(self, value: object, actor: str, declared: Any = None) -> bytes:
        """The payload's bytes.

        Args:
            value: what is sent.
            actor: for whom it is.
            declared: the type that it was declared with; that of the value if left out.

        Raises:
            BadMessage: naming the type and what in it cannot be coded or would get lost, or that it is too large.
        """
        try:
            # Most messages declare no class; this is done for each.
            if (declared is not None or class_fields(type(value))) and (lost := lost_from(declared, value)):
                raise TypeError(lost)
            body = self.encoder.encode(value)
        except Exception as error:  # msgspec raises what a hook or a field's own code raises: all means "not codable".
            raise BadMessage(actor, type_name(type(value)), unencodable(value, error)) from error
        if len(body) > MAX_BYTES:
            raise BadMessage(actor, type_name(type(value)), too_large(value, len(body)))
        return body

    def encode_alike(self, value: object, actor: str, declared: Any = None) -> bytes:
        """As `encode`, and the same bytes in each process: a set's are in the order of its members' own bytes.

        Args:
            value: what is sent. A set counts where a type declares one, not where it says Any or nothing.
            actor: for whom it is.
            declared: the type that it was declared with; that of the value if left out.

        Raises:
            BadMessage: as `encode`.
        """
        if not holds_set(type(value) if declared is None else declared):
            return self.encode(value, actor, declared)
        try:
            same = alike(value)
        except Exception as error:  # As in `encode`.
            raise BadMessage(actor, type_name(type(value)), unencodable(value, error)) from error
        return self.encode(same, actor, declared)

    def parcel(self, message: Message[Any], actor: str) -> Parcel:
        """Encode a message, with the name of its type beside the bytes."""
        return Parcel(message_name(type(message)), self.encode(message, actor))

    def decode(self, kind: Any, body: Any) -> Any:
        """A payload as `kind`; copies what it keeps.

        Raises:
            msgspec.DecodeError: the bytes are no such value; the text names the field.
        """
        decode = self._decoders.get(kind) or self.decoder(kind)
        try:
            return decode(body)
        except msgspec.MsgspecError:
            raise
        except Exception as error:
            raise decode_error(error) from error

    def decoder(self, kind: Any) -> Callable[[Any], Any]:
        """What decodes one kind, made once; it may raise more than `decode` does."""
        decode = self._decoders.get(kind)
        if decode is None:
            decode = self._decoders[kind] = msgspec.msgpack.Decoder(
                kind, dec_hook=check_special, ext_hook=self._decode_special
            ).decode
        return decode

    def message_in(self, cell: Cell, name: str, body: Any) -> Any:
        """A message that came encoded, for a cell: decoded if its actor is here, else as it came.

        Where nobody lives any more nobody says what is handled there, and whoever has sent it hears just that.

        Raises:
            UnknownMessage: its class has no handler for this name. BadMessage: the payload does not fit the type.
        """
        if cell.state is GONE or (cell.host.takes_parcels and cell.actor is None):
            return Parcel(name, bytes(body))
        return self.message_for(cell, name, body)

    def message_for(self, cell: Cell, name: str, body: Any) -> Any:
        """A message that came encoded, for an actor of this process: decoded as what that handles by this name.

        Raises:
            UnknownMessage: its class has no handler for this name. BadMessage: the payload does not fit the type.
        """
        kind = cell.table.named.get(name)
        if kind is None:
            try:
                kind = cell.table.kind_named(name)
            except UnknownMessage as error:
                raise UnknownMessage(known_at(cell), error.message) from None
        try:
            return (self._decoders.get(kind) or self.decoder(kind))(body)
        except Exception as error:  # Of a class whose fields nothing can be decoded as, too.
            raise BadMessage(known_at(cell), name.replace(":", "."), misfit(kind, decode_error(error))) from error

    def opened(self, cell: Cell, message: object) -> object:
        """A message for a cell, decoded if it is still packed; as it is if the cell's class does not know its type."""
        if type(message) is not Parcel:
            return message
        try:
            return self.decode(cell.table.kind_named(message.name), message.body)
        except (UnknownMessage, msgspec.DecodeError):
            return message

    def reply_decoder(self, message: type[Message[Any]]) -> Callable[[Any], Any]:
        """What decodes the reply to one message type, made once; it may raise more than `decode_reply` does."""
        decode = self._reply_decoders.get(message)
        if decode is None:
            decode = self._reply_decoders[message] = self.decoder(reply_type(message))
        return decode

    def decode_reply(self, message: type[Message[Any]], body: Any) -> Any:
        """A reply, as the type that the message declares."""
        return self.decode(reply_type(message), body)

    def _decode_special(self, code: int, data: memoryview) -> object:
        if code == REF:
            return ActorRef[Any](self._cell_at(str(data, "utf-8")))
        if code == ARRAY:
            return decode_array(data)
        if code == PACKED:
            return Packed(bytes(data))
        raise msgspec.ValidationError(f"unknown extension {code}")

    # -- errors -----------------------------------------------------------------------------------------------------

    def encode_error(
        self, error: BaseException, actor: str = "another process", asked: str = "what it was asked"
    ) -> tuple[str, str, bytes]:
        """An error as (kind, class name, payload): a Refusal or HoldfastError stays its class, all else is a crash.

        One with a field that cannot be sent is a reply of `actor`, to a message of type `asked`, that cannot.
        """
        try:
            return self.encode_own_error(error)
        except BadMessage as bad:
            return self.encode_own_error(BadReply(actor, asked, f"{type_name(type(error))}: {bad.problem}"))

    def encode_own_error(self, error: BaseException) -> tuple[str, str, bytes]:
        """As `encode_error`, of one that is no answer to anybody. Raises BadMessage if it has such a field."""
        if isinstance(error, Refusal):
            schema = type(error).schema()
            fields = schema(*(getattr(error, name) for name in schema.__struct_fields__))
            return "refusal", message_name(type(error)), self.encode_alike(fields, "", schema)
        if isinstance(error, HoldfastError) and not isinstance(error, RemoteCrash):
            return "error", type_name(type(error)), self.encode(error.args, "")
        crash = remote_crash(error)
        return "crash", "", self.encode((crash.type_name, crash.text, crash.traceback), "")

    def decode_error(
        self, kind: str, name: str, body: Any, actor: str = "another process", message: str = "what it was asked"
    ) -> HoldfastError:
        """The error by which `actor` has answered `message`; if it is none that can be made here, that is said."""
        try:
            made = self._decode_error(kind, name, body)
            if made is not None:
                return made
            args = self.decode(list[Any], body)
        except Exception as error:  # It is made of what another process says: the parameters need not fit.
            return BadReply(actor, message, f"an error ({name or kind}) that cannot be made: {error_text(error)}")
        if kind == "refusal":
            return UnknownRefusal(type_name=name, fields=args)
        return AskFailed(name, ", ".join(map(str, args)))

    def decode_own_error(self, kind: str, name: str, body: bytes) -> HoldfastError:
        """The error that `encode_own_error` was given, and no other. What it raises says why that cannot be made."""
        made = self._decode_error(kind, name, body)
        if made is None:
            raise LookupError(f"{name} is not loaded")
        return made

    def _decode_error(self, kind: str, name: str, body: Any) -> HoldfastError | None:
        """The error, or None if its class is not loaded here."""
        if kind == "refusal":
            found = find_refusal(name)
            if found is None:
                return None
            fields = self.decode(found.schema(), body)
            return found(*(getattr(fields, field) for field in fields.__struct_fields__))
        args: tuple[Any, ...] = tuple(tuple(a) if type(a) is list else a for a in self.decode(list[Any], body))
        if kind == "crash":
            return RemoteCrash(*args)
        return rebuild_error(name, args)


def known_at(cell: Cell) -> str:
    """Where others know the actor of a cell to be: a protected one does not live there itself."""
    return cell.path if cell.actor is None else cell.actor.ctx.path


def decode_error(error: Exception) -> msgspec.MsgspecError:
    """What a decoder has raised, as an error of the codec.

    It may be another one: for text that is no UTF-8, nesting without end, or an array of no known type.
    """
    if isinstance(error, msgspec.MsgspecError):
        return error
    return msgspec.DecodeError(f"{type_name(type(error))}: {error}")


def encode_special(value: Any) -> Any:
    """Refs and arrays as extensions; anything else is refused by name."""
    if isinstance(value, ActorRef):
        return msgspec.msgpack.Ext(REF, value.path.encode())
    if isinstance(value, Packable):
        return msgspec.msgpack.Ext(PACKED, value.packed())
    numpy = sys.modules.get("numpy")
    if numpy is not None:
        if isinstance(value, numpy.ndarray):
            return msgspec.msgpack.Ext(ARRAY, encode_array(value))
        if isinstance(value, numpy.generic):
            return value.item()
    if isinstance(value, ReplyHandle):
        raise TypeError("a reply handle cannot be sent; have another actor answer with ctx.forward()")
    raise TypeError(f"a value of type {type_name(type(value))} cannot be sent")


def alike(value: Any) -> Any:
    """The value with each set as a list in the order of its members' bytes; what holds none may be the same object."""
    if isinstance(value, (set, frozenset)):
        members = [alike(member) for member in value]
        return sorted(members, key=lambda member: msgspec.msgpack.encode(member, enc_hook=encode_special))
    if isinstance(value, (list, tuple)):
        return [alike(part) for part in value]
    if isinstance(value, dict):
        return {key: alike(part) for key, part in value.items()}
    kind = type(value)
    if not holds_set(kind):
        return value
    made = copy.copy(value)
    put = msgspec.structs.force_setattr if isinstance(value, msgspec.Struct) else object.__setattr__
    for field in msgspec.inspect.type_info(kind).fields:  # type: ignore[attr-defined]
        put(made, field.name, alike(getattr(value, field.name)))
    return made


def check_array(array: Any) -> None:
    """See whether an array arrives as what it is.

    Raises:
        TypeError: it has objects in it, or is of a class of its own; one on a file arrives as what is in it.
    """
    import numpy as np

    if array.dtype.hasobject:
        raise TypeError("a numpy array of objects cannot be sent")
    kind = type(array)
    if kind is np.ndarray or kind is np.memmap:
        return
    if issubclass(kind, np.ma.MaskedArray):
        raise TypeError("a masked array would arrive without its mask; send its data and its mask, as two arrays")
    raise TypeError(f"a {type_name(kind)} would arrive as a plain array; send numpy.asarray(...) of it")


def encode_array(array: Any) -> bytes:
    """dtype, shape and the elements in C order, in one copy."""
    check_array(array)
    elements = array.reshape(-1).view("u1") if array.flags.c_contiguous else array.tobytes()
    return b"".join((array_head(array), elements))


def array_head(array: Any) -> bytes:
    """What stands before the elements."""
    head = msgspec.msgpack.encode((array.dtype.str if array.dtype.names is None else array.dtype.descr, array.shape))
    return len(head).to_bytes(4, "little") + head


def decode_array(data: memoryview) -> Any:
    """The array, owning its memory and writable."""
    import numpy as np

    length = int.from_bytes(data[:4], "little")
    if length > LONGEST_HEAD:
        raise msgspec.ValidationError(f"the head of an array has {length} bytes")
    kind, shape = msgspec.msgpack.decode(data[4 : 4 + length], type=tuple[Any, tuple[int, ...]])
    try:
        dtype = described_dtype(kind)
    except DamagedValue as error:
        raise msgspec.ValidationError(error.problem) from error
    if dtype.hasobject:
        raise msgspec.ValidationError("an array of objects is not accepted")
    if min(shape, default=0) < 0:
        raise msgspec.ValidationError(f"an array cannot have the shape {shape}")
    count = 1
    for extent in shape:
        count *= extent
    if len(data) - 4 - length != count * dtype.itemsize:
        raise msgspec.ValidationError(f"array of {shape} {dtype} does not have {len(data) - 4 - length} bytes")
    return np.frombuffer(data, dtype=dtype, offset=4 + length, count=count).reshape(shape).copy()


def check_special(kind: Any, value: Any) -> Any:
    """Fields typed as refs or arrays: accept what the extension gave, refuse anything else."""
    origin = getattr(kind, "__origin__", kind)
    if isinstance(origin, type) and isinstance(value, origin):
        return value
    raise TypeError(f"expected {getattr(origin, '__name__', origin)}, got {type(value).__name__}")


def unencodable(value: object, error: BaseException) -> str:
    """Which field cannot be coded, and why."""
    for name in getattr(value, "__struct_fields__", ()):
        field = getattr(value, name)
        try:
            msgspec.msgpack.encode(field, enc_hook=encode_special)
        except Exception as inner:
            return f"field {name!r}: {inner}"
    return str(error)


def misfit(kind: type[msgspec.Struct], error: msgspec.MsgspecError) -> str:
    """Why a payload is no such message; its fields, which are sent by place, are named.

    >>> class Deposit(Message):
    ...     euros: int
    ...     notes: list[str] = []
    >>> misfit(Deposit, msgspec.ValidationError("Expected `str`, got `int` - at `$[1][...]`"))
    'Expected `str`, got `int` - at `notes[...]`'
    """
    text = str(error)
    for place, name in enumerate(kind.__struct_fields__):
        text = text.replace(f"`$[{place}]", f"`{name}")
    return text


def misfit_of(message: RuntimeCall[Any]) -> str:
    r"""Why a message could not come from another process as it is; "" if it could, or holds what is never sent there.

    >>> class Pick(RuntimeCall[None]):
    ...     id: str
    >>> misfit_of(Pick("a")), misfit_of(Pick(["a"])), misfit_of(Pick("half: \ud800"))
    ('', 'Expected `str`, got `array` - at `id`', "Expected text that can be written, got 'half: \\ud800' - at `id`")
    """
    kind = type(message)
    values = msgspec.structs.astuple(message)
    for name, value in zip(kind.__struct_fields__, values, strict=True):
        if isinstance(value, str) and not value.isascii():
            try:
                value.encode()
            except UnicodeEncodeError:
                return f"Expected text that can be written, got {shown(value)} - at `{name}`"
    try:
        msgspec.convert(values, kind, builtin_types=(bytes,))
    except Exception as error:  # What a field holds may raise what it likes while it is looked at.
        return misfit(kind, decode_error(error))
    return ""


def checking(handler: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The handler of a call, which refuses one whose fields are not what its class declares."""

    @functools.wraps(handler)
    def turn(actor: Actor, message: RuntimeCall[Any]) -> Any:
        if problem := misfit_of(message):
            return refuse(actor.ctx, BadMessage(actor.ctx.path, type_name(type(message)), problem))
        return handler(actor, message)

    return turn


def too_large(value: object, size: int) -> str:
    """Which field makes it too large."""
    sizes = {
        name: len(msgspec.msgpack.encode(getattr(value, name), enc_hook=encode_special))
        for name in getattr(value, "__struct_fields__", ())
    }
    largest = max(sizes, key=lambda name: sizes[name], default="")
    return f"field {largest!r}: the message has {size} bytes, the limit is {MAX_BYTES}; send it in parts"
