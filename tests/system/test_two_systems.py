"""Two systems of one program: where a ref of one works in the other, and what is said where it does not."""

from typing import Any

import pytest

import holdfast as hf


class Get(hf.Message[int]): ...


class Give(hf.Message[int]):
    """Ask this one."""

    ref: hf.ActorRef[hf.Actor]


class Server(hf.Actor):
    @hf.on(Get)
    def get(self, message: Get) -> int:
        return 7


class Taker(hf.Actor):
    @hf.on(Give)
    async def give(self, message: Give) -> int:
        answer: int = await message.ref.ask(Get())
        return answer


@pytest.mark.parametrize(
    ("isolation", "recovery"),
    [("task", None), ("task", hf.hybrid()), ("process", None), ("process", hf.hybrid())],
    ids=["plain", "recorded", "process", "recorded process"],
)
async def test_a_ref_of_another_system_works_where_it_is_not_sent_as_an_address(
    isolation: Any, recovery: hf.Method | None
) -> None:
    async with hf.ActorSystem("north", log=False) as north, hf.ActorSystem("south", log=False) as south:
        server = await south.start(hf.child("server", hf.start(Server)))
        taker = await north.start(hf.child("taker", hf.start(Taker), isolation=isolation, recovery=recovery))
        if isolation == "task" and recovery is None:
            assert await taker.ask(Give(server)) == 7
            return
        with pytest.raises(hf.HoldfastError, match=r"it is of another system than north, .*`hf.connect` does"):
            await taker.ask(Give(server))


@pytest.mark.parametrize("at", ["sqlite:/tmp/x.db", "bank", "http://localhost/app"])
async def test_a_connection_takes_servers_alone(at: str) -> None:
    with pytest.raises(hf.SpecError, match=r"names no servers: nats://HOST,HOST/NAME or tls://... does"):
        async with hf.connect(at):
            pass
