"""The words of a migration: in pieces, with the number of their attempt, and read with care."""

from __future__ import annotations

from typing import Any

import pytest

from holdfast.actors.migration import words
from holdfast.actors.migration.words import Incoming, say
from holdfast.actors.process.wire.frames import BadFrame, Migrate
from holdfast.actors.process.worker_pool import Worker
from holdfast.actors.values import encode_value


class Wire:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Migrate] = []
        self.names = self

    def to_wire(self, path: str) -> str:
        return path

    def send(self, frame: Migrate, where: str) -> None:
        assert where == frame.to
        self.sent.append(frame)


def test_a_word_comes_as_it_was_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(words, "PIECE", 10)
    wire: Any = Wire()
    told = {"state": b"x" * 35, "links": ["/a", "/b"], "left": 1.5}
    say(wire, "/app/a", 7, "packed", **told)
    assert [frame.is_last for frame in wire.sent] == [False] * (len(wire.sent) - 1) + [True]
    assert {(frame.to, frame.attempt, frame.step) for frame in wire.sent} == {("/app/a", 7, "packed")}
    incoming = Incoming(imports=False)
    assert [incoming.take(frame) for frame in wire.sent] == [None] * (len(wire.sent) - 1) + [told]
    assert incoming.take(Migrate("/app/a", 7, "back", encode_value({}, where=""), True)) == {}


@pytest.mark.parametrize("part", [b"", b"\xc1", encode_value([1], where=""), encode_value("x", where="")])
def test_what_cannot_be_told_is_refused(part: bytes) -> None:
    with pytest.raises(BadFrame, match="what is told with 'taken'"):
        Incoming(imports=False).take(Migrate("/app/a", 1, "taken", part, True))


def test_a_word_without_an_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else whoever sends it fills the memory of the other side."""
    monkeypatch.setattr(words, "MOST", 25)
    incoming, piece = Incoming(imports=False), Migrate("/app/a", 1, "packed", b"x" * 10, False)
    assert [incoming.take(piece) for _ in range(2)] == [None, None]
    with pytest.raises(BadFrame, match="more than 25 bytes"):
        incoming.take(piece)


def test_a_word_of_an_earlier_attempt_is_void() -> None:
    """A worker that has been slow says that it has come to rest, and another attempt is under way."""
    heard: list[str] = []
    worker: Any = Worker.__new__(Worker)
    worker.movers = {2: lambda frame: heard.append(frame.step)}
    worker.on_migrate(Migrate("/app/a", 1, "taken", b"", True))
    worker.on_migrate(Migrate("/app/a", 2, "refused", b"", True))
    assert heard == ["refused"]
