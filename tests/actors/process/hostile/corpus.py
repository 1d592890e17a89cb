"""The frames of real traffic: each shape once, kept in `corpus.txt`; of whoever has sent them `HOME` is the address.

`HOLDFAST_CORPUS=1 python -m pytest ...` adds what the processes of these tests send, and drops verbs that are gone.
"""

from __future__ import annotations

import fcntl
import os
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec

from holdfast.actors.process.wire import frames
from holdfast.actors.process.wire.connection import Connection
from holdfast.actors.process.wire.worker_gate import COMMANDS

FILE = Path(__file__).with_name("corpus.txt")
HOME = "/app/plain"
LONGEST = 2048
MOST_SHAPES = 12
"""Of one kind of frame, and of one verb or event."""
COMMAND, NOTE = frames.Command.__struct_config__.tag, frames.Note.__struct_config__.tag


def corpus() -> list[bytes]:
    """All frames that are kept."""
    return [bytes.fromhex(line) for line in FILE.read_text().splitlines()]


def verb(data: bytes) -> tuple[int, str]:
    """What kind of frame it is, and which command or event."""
    whole = msgspec.msgpack.decode(data)
    return whole[0], {COMMAND: whole[2], NOTE: whole[1]}.get(whole[0], "") if len(whole) > 2 else ""


def shape(data: bytes) -> str:
    """What two frames have in common that differ in their values only."""

    def of(value: Any) -> str:
        if isinstance(value, list):
            return f"[{' '.join(map(of, value[:8]))}]"
        if isinstance(value, dict):
            return f"{{{' '.join(f'{key}:{of(one)}' for key, one in sorted(value.items(), key=str))}}}"
        return type(value).__name__

    return f"{verb(data)} {of(msgspec.msgpack.decode(data))}"


def readdressed(data: bytes, was: str, now: str) -> bytes:
    """The frame as one would have sent it who lives elsewhere."""

    def of(value: Any) -> Any:
        if isinstance(value, list):
            return [of(one) for one in value]
        if isinstance(value, dict):
            return {of(key): of(one) for key, one in value.items()}
        if isinstance(value, str) and f"{value}/".startswith(f"{was}/"):
            return now + value[len(was) :]
        return value

    return msgspec.msgpack.encode(of(msgspec.msgpack.decode(data)))


class Listener:
    """Hears what processes say to this one, from when it is made."""

    def __init__(self) -> None:
        self.heard: dict[str, bytes] = {}
        take_frames = Connection._take_frames

        def listening(connection: Connection, left: int) -> None:
            if connection._guarded and "hostile" not in os.environ.get("PYTEST_CURRENT_TEST", ""):
                self._hear(connection)
            take_frames(connection, left)

        Connection._take_frames = listening  # type: ignore[method-assign, assignment]

    def _hear(self, connection: Connection) -> None:
        buffer, worker = connection._buffer, connection._on_frame.__self__  # type: ignore[attr-defined]
        at, end = buffer.begin, buffer.end
        while end - at >= 4:
            size = int.from_bytes(buffer.data[at : at + 4], "little")
            if end - at - 4 < size:
                return
            if size <= LONGEST and worker.cell is not None:
                self._take(bytes(buffer.data[at + 4 : at + 4 + size]), worker.cell.path)
            at += 4 + size

    def _take(self, data: bytes, home: str) -> None:
        try:
            moved = readdressed(data, home, HOME)
            self.heard.setdefault(shape(moved), moved)
        except (msgspec.MsgspecError, TypeError, ValueError, IndexError):
            return  # Some of the tests write what is no frame.

    def save(self) -> None:
        """Add what is new to what is kept; other test processes may do so at the same time."""
        with FILE.open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            known = {shape(data): data for data in map(bytes.fromhex, file.read().splitlines())}
            counts: Counter[tuple[int, str]] = Counter()
            kept: list[bytes] = []
            for data in (known | {one: data for one, data in self.heard.items() if one not in known}).values():
                kind = verb(data)
                counts[kind] += 1
                if counts[kind] <= MOST_SHAPES and (kind[0] != COMMAND or kind[1] in COMMANDS):
                    kept.append(data)
            file.seek(0)
            file.truncate()
            file.write("".join(f"{data.hex()}\n" for data in sorted(kept)))
