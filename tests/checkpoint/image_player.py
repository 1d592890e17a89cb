"""Actors with a large state, for tests of snapshots: whatever is done to it can be computed again by the test."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

import holdfast as hf

CELLS = 600_000
"""Of the smaller grid: 4.8 MB, enough for an image. The larger one is written by a forked process."""
MANY = 3_000_000


class Paint(hf.Message[int]):
    """Add `by` to the cells from `first` on, `count` of them."""

    first: int
    count: int
    by: int = 1


class Write(hf.Message[int]):
    """Put a word among the others; None takes the last one away."""

    word: str | None


class Digest(hf.Message[str]): ...


class Turns(hf.Message[int]): ...


class Spoil(hf.Message[int]):
    is_spoiled: bool


class Canvas(hf.Actor):
    """A grid that changes, one that does not, another name for a part, and small things."""

    def __init__(self, cells: int = CELLS) -> None:
        self.grid = np.zeros(cells)
        self.fixed = np.arange(cells // 4)
        self.same = self.fixed
        self.words: list[str] = []
        self.turns = 0
        self.spoiled: Any = None

    @hf.on(Paint)
    def paint(self, message: Paint) -> int:
        self.grid[message.first : message.first + message.count] += message.by
        self.turns += 1
        return self.turns

    @hf.on(Write)
    def write(self, message: Write) -> int:
        if message.word is None:
            del self.words[-1:]
        else:
            self.words.append(message.word)
        self.turns += 1
        return self.turns

    @hf.on(Spoil)
    def spoil(self, message: Spoil) -> int:
        self.spoiled = object() if message.is_spoiled else None
        self.turns += 1
        return self.turns

    @hf.on(Turns, readonly=True)
    def count(self, message: Turns) -> int:
        return self.turns

    @hf.on(Digest, readonly=True)
    def digest(self, message: Digest) -> str:
        assert self.same is self.fixed, "what was one object is one again"
        return digest_of(self)


def digest_of(canvas: Canvas) -> str:
    """All of its state, in short."""
    digest = hashlib.blake2b(canvas.grid.tobytes())
    digest.update(canvas.fixed.tobytes())
    digest.update(repr((canvas.words, canvas.turns)).encode())
    return digest.hexdigest()
