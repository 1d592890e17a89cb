"""Wrong values, the calls of the runtime that they are put into, and the actors that make them, also in processes."""

import math
from collections.abc import Iterator
from typing import Any

import msgspec

import holdfast as hf
from holdfast.actors.kernel.message import RuntimeCall
from holdfast.supervision.admin import RemoveChild
from holdfast.supervision.services.partition import Route
from holdfast.supervision.services.registrar import (
    DeleteMeta,
    DropEntries,
    Find,
    GetMeta,
    Lock,
    PutMeta,
    Register,
    ReplaceValue,
    Unlock,
)
from holdfast.supervision.supervisor_changes import TakeOver

HALF = "a\ud800b"
WRONG: tuple[Any, ...] = (
    None, True, -1, 2**70, math.nan, "", HALF, "x" * 5000, b"\xc1", ["x"], {"x": 1}, ("x",), {1}, object, ...,
)  # fmt: skip
REASONS: tuple[Any, ...] = (
    "bad credentials",
    None,
    7,
    ValueError("no"),
    hf.Shutdown,
    hf.Shutdown(42),  # type: ignore[arg-type]
    hf.Shutdown(HALF),
    hf.Shutdown("x" * 2_000_000),
    hf.Signal("nine"),  # type: ignore[arg-type]
    hf.Crash(1, 2),  # type: ignore[arg-type]
    hf.Crash("E", "text", "", "no error"),  # type: ignore[arg-type]
)


class OwnReason(hf.Shutdown, frozen=True):
    """A user's own kind of reason."""


CALLS: dict[str, tuple[RuntimeCall[Any], ...]] = {
    "some": (
        hf.StartChild(args=(1, 2, 3)),
        hf.TerminateChild("nobody"),
        hf.RestartChild("nobody"),
        hf.DeleteChild("nobody"),
        RemoveChild("nobody"),
        hf.supervision.GetChildSpec("nobody"),
        hf.supervision.ChangeSupervisor(),
        TakeOver(None),  # type: ignore[arg-type]
    ),
    "copies": (hf.supervision.ResizePartitions(2), Route("key"), hf.StartChild(args=(1, 2, 3)), RemoveChild("nobody")),
    "crew": (hf.supervision.ResizePool(1), hf.TerminateChild("nobody")),
    "names": (
        Register(b"\xa1k", 1, 0),
        Find(b"\xa1x"),
        DropEntries(b"\xa1x"),
        ReplaceValue(b"\xa1x", 1, 1),
        Lock(b"\xa1x", "ticket", 0),
        Unlock(b"\xa1x", "ticket"),
        PutMeta("name", 1),
        GetMeta("name"),
        DeleteMeta("name"),
    ),
}


def wrong_calls() -> Iterator[tuple[str, RuntimeCall[Any]]]:
    """Each call with each wrong value in each of its fields, and to whom it is sent."""
    for to, calls in CALLS.items():
        for call in calls:
            for field in call.__struct_fields__:
                for value in WRONG:
                    yield f"/app/{to}", msgspec.structs.replace(call, **{field: value})


class Send(hf.Message[list[str]]):
    """Send all of them."""


class Stop(hf.Message):
    """End for the reason with this number."""

    number: int


class Idle(hf.Actor):
    def __init__(self) -> None:
        self.done = 0

    @hf.on(Stop)
    def stop(self, message: Stop) -> None:
        self.ctx.stop(OwnReason("own") if message.number < 0 else REASONS[message.number])


class Client(Idle):
    some: hf.Binding[hf.supervision.DynamicSupervisor]
    copies: hf.Binding[hf.Actor]
    crew: hf.Binding[hf.Actor]
    names: hf.Binding[hf.Actor]

    @hf.on(Send)
    async def send(self, message: Send) -> list[str]:
        ports = {ref.path: ref for ref in (self.some, self.copies, self.crew, self.names)}
        return await send_all(ports)


async def ask(ref: hf.ActorRef[Any], call: RuntimeCall[Any]) -> None:
    await ref.ask(call, 20.0)


async def tell(ref: hf.ActorRef[Any], call: RuntimeCall[Any]) -> None:
    ref.tell(call)


async def send_all(refs: dict[str, hf.ActorRef[Any]]) -> list[str]:
    """Tell and ask each of them; returns what was no refusal: a crash, or no answer."""
    bad: list[str] = []
    for to, call in wrong_calls():
        for send in (ask, tell):
            try:
                await send(refs[to], call)
            except (hf.RemoteCrash, hf.AskFailed, hf.AskTimeout) as error:
                bad.append(f"{call!r:.200} to {to}: {error!r:.200}")
            except hf.HoldfastError:
                continue
            if isinstance(call, Lock):
                refs[to].tell(Unlock(call.key, call.ticket))
    return bad
