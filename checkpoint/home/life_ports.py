"""The port between a home and a life in another process, and what such a life may say."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from ...actors.kernel.cell import ORDERS
from ...actors.process.wire import frames
from ...actors.process.wire.frames import BadFrame
from ..protocol import Hooked, Out, Released, Snapshot, ToHome, ToLife, TurnEnd, Wanted

if TYPE_CHECKING:
    from ...actors.process.wire.worker_gate import WorkerGate
    from ...actors.process.worker_pool import Worker
    from ..inputs import Input
    from .switch import Switch

FROM_LIFE: msgspec.msgpack.Decoder[ToHome] = msgspec.msgpack.Decoder(ToHome)
SENT = frozenset(("tell", "send", "ask", "forward", "publish"))
"""Outputs that are messages to somebody."""


def own_records(worker: Worker, switch: Switch, path: str) -> frames.TakeRecord:
    """Who takes the records of a process with one recorded actor."""
    return records_of(worker, switch.from_life)


def records_of(worker: Worker, take: Callable[[ToHome], None]) -> frames.TakeRecord:
    """Hand the records of a life in a process on, as far as it may say such a thing.

    Raises (when one comes):
        BadFrame: it sends what it may not send, or names the memory of another process.
    """
    decode, gate = FROM_LIFE.decode, worker.gate

    def taken(frame: frames.Record) -> None:
        record = decode(frame.body)
        if isinstance(record, (TurnEnd, Released, Hooked)):
            require_outputs(gate, record)
        elif isinstance(record, Wanted):
            gate.claims(record.bindings)
            if record.register is not None:
                gate.require_name(record.register.text, record.register.scope)
        elif isinstance(record, Snapshot) and record.image is not None:
            pid = record.image.pid
            if not worker.forked.owns(pid):
                raise BadFrame(f"an image in the memory of process {pid}")
        take(record)

    return taken


def outputs_of(record: object) -> list[Out]:
    """What a record of a life lets out."""
    if isinstance(record, Hooked):
        return [record.out]
    return record.outs if isinstance(record, (TurnEnd, Released)) else []


def require_outputs(gate: WorkerGate, record: object) -> None:
    """See whether a process may let all of this out.

    Raises:
        BadFrame: it may not.
    """
    for out in outputs_of(record):
        if out.verb in SENT:
            gate.output(out.to, out.name)
        elif out.verb in ORDERS and not gate.speaks_for(out.to):
            gate.order(out.to, out.verb)


class RemoteLife:
    """From a home to its life, in another process."""

    begins = True
    is_far = True

    def __init__(self, path: str, worker: Worker) -> None:
        self._worker, self._connection = worker, worker.connection
        self._below = path[len(worker.home) :]  # of a child of the process's own actor

    def take(self, source: Input) -> None:
        self.to_life(source.feed())

    def to_life(self, record: ToLife) -> None:
        path = self._worker.home + self._below
        self._connection.send(frames.Record(self._connection.names.to_wire(path), record), path)  # type: ignore[arg-type]  # encoded in place
