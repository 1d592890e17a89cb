"""The process that runs functions of effects, one after another: the other end of `effect_processes.py`."""

from __future__ import annotations

import os
import signal
import socket
import sys
from multiprocessing.spawn import prepare
from typing import Any

import msgspec

from ..effects import begin_effect
from ..errors import HoldfastError, error_text, type_name
from ..kernel.codec import Codec
from ..values import decode_value, encode_value
from .fork.boot import PR_SET_PDEATHSIG, bind_prctl
from .wire.start_codec import imported


def answered(codec: Codec, request: bytes) -> tuple[Any, ...]:
    """What a function has returned or raised, as it is sent back."""
    name, args, named, token = msgspec.msgpack.decode(request)
    begin_effect(token)
    try:
        values: Any = decode_value(args)
        options: Any = decode_value(named)
        return "value", encode_value(imported(name)(*values, **options), where=f"the result of {name}")
    except HoldfastError as error:
        try:
            return "error", *codec.encode_error(error)
        except Exception as problem:  # It has fields of the user's own, of whatever types.
            text = f"what it has raised cannot be sent: {error_text(problem)}"
            return "raised", type_name(type(error)), text, []
    except BaseException as error:  # Whatever a function can raise.
        return "raised", type_name(type(error)), error_text(error), [type_name(one) for one in type(error).__mro__]


def received(sock: socket.socket, count: int) -> bytes:
    """So many bytes; fewer if whoever sends them has ended."""
    read = bytearray()
    while len(read) < count and (piece := sock.recv(min(count - len(read), 1 << 20))):
        read += piece
    return bytes(read)


def next_message(sock: socket.socket) -> bytes:
    """The next message; empty if there is none any more."""
    return received(sock, int.from_bytes(received(sock, 8), "little"))


def main() -> None:
    """Answer requests until there are none any more. Killed with the thread that has begun us, whatever we do then."""
    sock, parent = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is for the program, which ends us.
    bind_prctl()(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        return
    prepare(msgspec.msgpack.decode(next_message(sock)))
    codec = Codec(lambda path: None)  # type: ignore[arg-type, return-value]  # no ref comes here
    while request := next_message(sock):
        answer = msgspec.msgpack.encode(answered(codec, request))
        sock.sendall(len(answer).to_bytes(8, "little") + answer)


if __name__ == "__main__":
    main()
