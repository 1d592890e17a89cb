"""Frames of real traffic, a little wrong: whatever comes of it, the root and all others go on."""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest

from holdfast.actors.process.wire import frames as f
from holdfast.actors.process.wire.worker_gate import COMMANDS
from tests.actors.process.hostile.conftest import World
from tests.actors.process.hostile.corpus import COMMAND, HOME, corpus, readdressed, verb
from tests.actors.process.hostile.forging import EVIL, framed
from tests.actors.process.hostile.players import Ping

SESSIONS = int(os.environ.get("HOLDFAST_FUZZ", "25"))
"""What one worker tries, for each seed; more in a campaign."""
FIRST = int(os.environ.get("HOLDFAST_SEED", "0"))

ODD = (b"\0", b"\x7f", b"\xc0", b"\xc3", b"\xff", b"\x90", b"\x80", b"\xcf" + b"\xff" * 8, b"\xcb\x7f\xf8" + bytes(6))


def flip(draw: random.Random, data: bytearray) -> None:
    data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)


def cut(draw: random.Random, data: bytearray) -> None:
    del data[draw.randrange(1, len(data) + 1) :]


def put(draw: random.Random, data: bytearray) -> None:
    at = draw.randrange(len(data))
    data[at : at + draw.randrange(2)] = draw.choice(ODD)


def splice(draw: random.Random, data: bytearray) -> None:
    other = draw.choice(corpus())
    data[draw.randrange(len(data)) :] = other[draw.randrange(len(other)) :]


CHANGES: tuple[Callable[[random.Random, bytearray], None], ...] = (flip, flip, cut, put, put, splice)


def of_evil(data: bytes) -> bytes:
    """The frame as if our worker had written it: with its own address, where there is one."""
    return readdressed(data, HOME, EVIL)


def session(draw: random.Random) -> bytes:
    """What a compromised worker writes until it is ended: real frames, of its own world, and some that are not."""
    parts: list[bytes] = []
    for data in draw.choices(corpus(), k=draw.randrange(1, 12)):
        changed = bytearray(of_evil(data))
        for change in draw.choices(CHANGES, k=draw.randrange(4)):
            if changed:
                change(draw, changed)
        parts.append(framed(bytes(changed)))
    return b"".join(parts)


def test_the_corpus_has_every_kind_that_a_worker_sends() -> None:
    kinds = {data[1] for data in corpus()}
    sent = (f.Tell, f.Ask, f.Reply, f.Failure, f.Launched, f.Command, f.Note, f.Record, f.Publish, f.Offer)
    for kind in sent:
        assert f.tagged(kind)[1] in kinds, kind.__name__


def test_the_corpus_has_every_verb_that_the_gate_knows_and_no_other() -> None:
    """`HOLDFAST_CORPUS=1` adds what a new one looks like, from the tests of it."""
    assert {name for kind, name in map(verb, corpus()) if kind == COMMAND} == set(COMMANDS)


@pytest.mark.parametrize("seed", range(4))
async def test_frames_that_are_a_little_wrong_hurt_nobody(world: World, seed: int) -> None:
    draw = random.Random(seed + FIRST)
    for number in range(SESSIONS):
        world.trying(f"seed {seed + FIRST}, session {number}")
        await world.write(session(draw))
        try:
            await world.evil.ask(Ping(), timeout=60)
        except Exception as error:
            print(error)
        await world.work()
    await world.judge()
