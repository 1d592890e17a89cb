"""A leak: an actor keeps every session for ever."""

import asyncio
import itertools

import holdfast as hf


class Visit(hf.Message[int]):
    visitor: str
    page: bytes


class Sessions(hf.Actor):
    def __init__(self) -> None:
        self.open: dict[str, bytes] = {}

    @hf.on(Visit)
    def visit(self, message: Visit) -> int:
        self.open[message.visitor] = message.page  # Nobody ever takes one out.
        return len(self.open)


async def main(system: hf.ActorSystem) -> None:
    limits = hf.Limits(memory_bytes=120_000_000)
    sessions = await system.start(hf.child("sessions", hf.start(Sessions), isolation="process", limits=limits))
    for visitor in itertools.count():
        sessions.tell(Visit(f"visitor-{visitor}", b"x" * 100_000))
        await asyncio.sleep(0.005 if visitor < 450 else 0.5)  # The night begins busily.
