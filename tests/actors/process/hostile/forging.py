"""Frames that a compromised worker might write: malformed, forged, huge."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import msgspec

from holdfast.actors.kernel.message import message_name
from holdfast.actors.process.wire import frames as f
from tests.actors.process.hostile.players import LENGTH, Add, Anything

VICTIM, OTHER, EVIL, SUP = "/app/sup/victim", "/app/sup/other", "/app/sup/evil", "/app/sup"
ADD, ANYTHING = message_name(Add), message_name(Anything)
_ENCODER = msgspec.msgpack.Encoder()
NORMAL = {"exit": "Normal"}
MEBIBYTE = 1 << 20


def framed(body: bytes) -> bytes:
    return LENGTH.pack(len(body)) + body


def frame(*made: Any) -> bytes:
    return b"".join(framed(_ENCODER.encode(one)) for one in made)


def raw(value: Any) -> msgspec.Raw:
    return msgspec.Raw(_ENCODER.encode(value))


def array(dtype: Any, shape: tuple[int, ...], data: bytes = b"") -> msgspec.msgpack.Ext:
    head = msgspec.msgpack.encode((dtype, shape))
    return msgspec.msgpack.Ext(2, len(head).to_bytes(4, "little") + head + data)


def command(to: str, verb: str, **data: Any) -> bytes:
    return frame(f.Command(to, verb, data))


def born(bindings: Any) -> bytes:
    """A child of its own, and where its bindings lead."""
    return command(EVIL, "born", path=f"{EVIL}/x", kind="a:B", life=1, bindings=bindings)


def named(path: str, by: str = EVIL, **other: Any) -> bytes:
    """A name for a child that is about to begin."""
    told = {"path": path, "kind": "a:B", "name": "bank", "scope": "fleet", "answer": 1}
    return command(by, "name", **{**told, **other})


def note(kind: str, **data: Any) -> bytes:
    return frame(f.Note(kind, data))


def tell(body: Any, name: str = ANYTHING, to: str = VICTIM, sender: str | None = None) -> bytes:
    return frame(f.Tell(to, name, raw(body), 0, sender))


def head(kind: type[f.Frame], *first: Any) -> bytes:
    """The beginning of a frame of a kind, by hand."""
    return f.tagged(kind) + b"".join(map(_ENCODER.encode, first))


def bomb(opening: bytes, inner: bytes, count: int) -> bytes:
    """An array of very many very small things."""
    return framed(opening + b"\xdd" + struct.pack(">I", count) + inner * count)


START_CHILD = "holdfast.supervision.admin:StartChild"
TERMINATE = "holdfast.supervision.admin:TerminateChild"

BREACHES: dict[str, Callable[[], bytes]] = {
    # no frames at all
    "garbage": lambda: bytes(range(256)) * 4,
    "a length without end": lambda: b"\xff\xff\xff\xff" + b"A" * 100,
    "nothing": lambda: framed(b""),
    "an unknown kind": lambda: framed(b"\x91\x7f"),
    "no array": lambda: framed(b"\x81\xa1a\x01"),
    "too few fields": lambda: framed(head(f.Tell, VICTIM)),
    "nesting without end": lambda: framed(head(f.Command, SUP, "kill") + b"\x81\xa1x" + b"\x91" * 300_000 + b"\xc0"),
    "text that is no UTF-8": lambda: framed(b"\x94\x08\xa2\xff\xfe\xa4kill\x80"),
    # frames that only the root sends
    "Launch": lambda: frame(f.Launch(1, EVIL, 1, b"", {})),
    "TellRun": lambda: frame(f.TellRun(0, 0, 1, raw([]))),
    # senders and addresses
    "a message of another": lambda: tell([1000], ADD, sender=OTHER),
    "an ask of another": lambda: frame(f.Ask(1, VICTIM, ADD, raw([1000]), 1e18, 0, OTHER)),
    "an offer of another": lambda: frame(f.Offer(1, VICTIM, ADD, raw([1000]), OTHER)),
    "a publication of another": lambda: frame(f.Publish(1, "/t", ADD, raw([1]), OTHER)),
    "an ask until no time": lambda: frame(f.Ask(1, VICTIM, ADD, raw([0]), float("nan"))),
    "an ask until the end of time": lambda: frame(f.Ask(1, VICTIM, ADD, raw([0]), float("inf"))),
    "an ask until before all time": lambda: frame(f.Ask(1, VICTIM, ADD, raw([0]), float("-inf"))),
    "a chain without end": lambda: frame(f.Ask(1, VICTIM, ADD, raw([0]), 1e18, 0, None, (("/a", 1),) * 5000)),
    "a name never given": lambda: frame(f.Tell(99, ADD, raw([0]))),
    "a name below zero": lambda: frame(f.Tell(-1, ADD, raw([0]))),
    "a sender never given": lambda: frame(f.Tell(VICTIM, ADD, raw([0]), 0, 7777)),
    "names without end": lambda: b"".join(frame(f.Tell(f"/n{at}", "x:Y", raw([]))) for at in range(70_000)),
    "a part of the runtime": lambda: tell([], to="/app/recovery/controller"),
    # orders
    "kill another": lambda: command(VICTIM, "kill"),
    "stop another": lambda: command(VICTIM, "stop", reason=NORMAL),
    "kill the supervisor": lambda: command(SUP, "kill"),
    "a kill in the name of another": lambda: command(EVIL, "faulted", by=OTHER),
    "a kill in no name": lambda: command(EVIL, "faulted"),
    "kill the root": lambda: command("/app", "kill"),
    "start a child": lambda: tell([], START_CHILD, SUP),
    "ask to terminate a child": lambda: frame(f.Ask(1, SUP, TERMINATE, raw(["victim"]), 1e18)),
    "offer to terminate a child": lambda: frame(f.Offer(1, SUP, TERMINATE, raw(["victim"]))),
    "publish an order": lambda: frame(f.Publish(1, "/t", TERMINATE, raw(["victim"]))),
    # claims
    "a child below the supervisor": lambda: command(SUP, "born", path="/app/sup/planted", kind="a:B", life=1),
    "the address of another": lambda: command(EVIL, "born", path=VICTIM, kind="a:B", life=1),
    "a life that is no number": lambda: command(EVIL, "born", path=f"{EVIL}/x", kind="a:B", life="zz"),
    "a life of any number": lambda: command(EVIL, "born", path=f"{EVIL}/x", kind="a:B", life=1 << 62),
    "an address without a name": lambda: command(EVIL, "born", path=f"{EVIL}//x", kind="a:B", life=1),
    "below what is not there": lambda: command(EVIL, "born", path=f"{EVIL}/x/y", kind="a:B", life=1),
    "bindings that are none": lambda: born(5),
    "a binding to no address": lambda: born({"port": 5}),
    "a port without a name": lambda: born({5: VICTIM}),
    "an order by a binding that it claims": lambda: born({"port": VICTIM}) + command(VICTIM, "kill"),
    "an order above what it claims": lambda: born({"port": SUP}) + tell([], START_CHILD, SUP),
    "the end of another's life": lambda: command(SUP, "undone", path=VICTIM),
    "a name for another": lambda: named(VICTIM),
    "a name where there is no supervisor": lambda: named(f"{EVIL}/x"),
    "the end of another's child": lambda: command(SUP, "gone", path=VICTIM, reason=NORMAL),
    "the end of another": lambda: frame(f.Ended(VICTIM, 1, NORMAL)),
    "an end without a reason": lambda: frame(f.Ended(EVIL, 1, {"exit": "Nothing"})),
    "an end for no reason": lambda: command(VICTIM, "down", source=VICTIM, reason=NORMAL),
    "an exit of another": lambda: command(VICTIM, "exit", source=OTHER, reason=NORMAL),
    "a reason that is none": lambda: command(VICTIM, "exit", source=EVIL, reason={"exit": "Signal", "number": "x"}),
    "a watch of another": lambda: command(VICTIM, "monitor", watcher=OTHER),
    "no watch of another": lambda: command(VICTIM, "demonitor", watcher=OTHER),
    "a link of others": lambda: command(VICTIM, "link", peer=OTHER),
    "no link of others": lambda: command(VICTIM, "unlink", peer=OTHER),
    "an address that it was never told": lambda: command(EVIL, "readdressed"),
    "a subscription of another": lambda: command(VICTIM, "subscribe", topic="/t"),
    "no subscription of another": lambda: command(VICTIM, "unsubscribe", topic="/t"),
    "a topic that is none": lambda: command(EVIL, "subscribe", topic=5),
    "erase what another has": lambda: command(EVIL, "keep", what="erase", path=VICTIM, below=True),
    "keep for nothing": lambda: command(EVIL, "keep", what="nothing", path=f"{EVIL}/x"),
    "an order from below": lambda: command(VICTIM, "control", id=1, order="suspend", data=b"", left=1.0),
    "a binding of another": lambda: command(VICTIM, "bind", port="x", target=EVIL),
    "a word of the migration of another": lambda: frame(f.Migrate(VICTIM, 1, "taken", b"x", True)),
    "luggage of another": lambda: frame(f.Migrate(VICTIM, 1, "packed", b"x", False)),
    "a record of another": lambda: frame(f.Record(VICTIM, raw({"x": 1}))),
    "a record without a home": lambda: frame(f.Record(EVIL, raw([1, 2, 3]))),
    "an event of another": lambda: note("SupervisorGaveUp", address=SUP, child="victim", reason=NORMAL),
    "an event of nobody": lambda: note("ActorStarted", address=5, life="x"),
    # huge
    "a command that is a bomb": lambda: bomb(head(f.Command, SUP, "x") + b"\x81\xa1x", b"\x90", 15 * MEBIBYTE),
    "an end that is a bomb": lambda: bomb(head(f.Ended, EVIL, 1) + b"\x81\xa1x", b"\x90", 15 * MEBIBYTE),
    "a message that is a bomb": lambda: framed(
        head(f.Tell, VICTIM, ANYTHING)
        + b"\x91\xdd"
        + struct.pack(">I", 15 * MEBIBYTE)
        + b"\x80" * (15 * MEBIBYTE)
        + b"\x00\xc0"
    ),
}
"""Each of these ends the process that writes it, and nothing else."""

HARMLESS: dict[str, Callable[[], bytes]] = {
    "a reply to nobody": lambda: frame(*(f.Reply(key, raw(1)) for key in range(10_000, 10_100))),
    "a failure for nobody": lambda: frame(*(f.Failure(key, "error", "x", raw([])) for key in range(10_000, 10_100))),
    "a start of nobody": lambda: frame(f.Launched(4711, "no")),
    "beats": lambda: frame(*[f.Beat()] * 5000),
    "moves of nothing": lambda: frame(*[f.PageChanged()] * 5000),
    "an event of an unknown kind": lambda: note("NoSuchEvent", address=EVIL),
    "an event whose fields do not fit": lambda: note("ActorStarted", address=EVIL, life="x"),
    "a message to nobody": lambda: tell([], to="//") + tell([], to="") + tell([], to="/app/../..") + tell([], to="\0"),
    "a message of an unknown type": lambda: tell([], "os:system"),
    "a message that does not fit": lambda: tell(["x", "y"], ADD),
    "a unit that divides by zero": lambda: tell([array("M8[s/0]", (1,), bytes(8))]),
    "a dtype that is none": lambda: tell([array("nonsense", (1,), bytes(8))]),
    "an array with less than no elements": lambda: tell([array("<f8", (-1,), bytes(8))]),
    "an array of addresses": lambda: tell([array("|O", (1,), bytes(8))]),
    "fields that divide by zero": lambda: tell([array([["a", "M8[s/0]"]], (1,), bytes(8))]),
    "an extension that is none": lambda: tell([msgspec.msgpack.Ext(99, b"")]),
    "a ref without an address": lambda: tell([msgspec.msgpack.Ext(1, b"")]),
    "bindings to whomever": lambda: (
        born({"port": VICTIM, "none": "//"}) + command(EVIL, "gone", path=f"{EVIL}/x", reason=NORMAL)
    ),
    "a forgotten name": lambda: frame(f.Forget(), f.Tell(VICTIM, ANYTHING, raw([0]))),
}
"""Each of these is refused, or comes to nothing: its writer has harmed nobody."""
