"""Refs and handles belong to a running system: a copy of what holds one holds the same one, and none is pickled."""

import copy
import dataclasses
import pickle
from typing import Any

import msgspec
import pytest

import holdfast as hf


class Held(hf.Message[dict[str, bool]]):
    """Asks for which of its handles a deep copy is the handle itself, and which could be pickled."""


class Late(hf.Message[int]): ...


class Keeper(hf.Actor):
    @hf.on(Late)
    async def late(self, message: Late) -> int:
        self._handle = self.ctx.reply_handle()
        return self._handle  # type: ignore[return-value]

    @hf.on(Held)
    async def held(self, message: Held) -> dict[str, bool]:
        handles: dict[str, Any] = {
            "ref": self.ctx.ref,
            "timer": self.ctx.tell_after(60.0, Late()),
            "monitor": self.ctx.monitor(self.ctx.find("/app/other", Keeper)),
            "reply": self.ctx.reply_handle(),
        }
        return {name: is_itself(handle) for name, handle in handles.items()}


@dataclasses.dataclass
class Order:
    by: hf.ActorRef[Keeper]
    lines: list[int]


class Ordered(msgspec.Struct):
    by: hf.ActorRef[Keeper]
    lines: list[int]


def is_itself(handle: Any) -> bool:
    with pytest.raises(TypeError, match=r"belongs to a running system and cannot be pickled.*system.ref\(path\)"):
        pickle.dumps(handle)
    copied = copy.deepcopy({"held": [handle]})["held"][0]
    return copied == handle and copy.copy(handle) == handle and type(copied) is type(handle)


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_a_copy_of_a_handle_is_itself(recovery: hf.Method | None) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.child("other", hf.start(Keeper)))
        keeper = await system.start(hf.child("keeper", hf.start(Keeper), recovery=recovery))
        assert await keeper.ask(Held()) == dict.fromkeys(("ref", "timer", "monitor", "reply"), True)


async def test_what_holds_a_ref_can_be_copied() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        keeper = await system.start(hf.child("keeper", hf.start(Keeper)))
        order = Order(keeper, [1])
        assert dataclasses.asdict(order) == {"by": keeper, "lines": [1]}
        assert copy.deepcopy(order) == order
        ordered = copy.deepcopy(Ordered(keeper, [1]))
        assert ordered.by is keeper
        assert ordered.lines == [1]
