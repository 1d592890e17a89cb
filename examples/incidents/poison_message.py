"""A crash loop: one image makes the decoder of a thumbnail service read beyond its buffer, and the kernel ends it."""

import asyncio
import os
import signal

import holdfast as hf


class Shrink(hf.Message[int]):
    image: str


class Thumbnails(hf.Actor):
    def __init__(self) -> None:
        self.done = 0

    @hf.on(Shrink)
    def shrink(self, message: Shrink) -> int:
        decode(message.image)
        self.done += 1
        return self.done


def decode(image: str) -> None:
    """Stands for a decoder written in C: this is what a bad one does to the process that it is in."""
    if image == "holiday.webp":
        os.kill(os.getpid(), signal.SIGSEGV)


async def main(system: hf.ActorSystem) -> None:
    spec = hf.child("thumbnails", hf.start(Thumbnails), isolation="process", recovery=hf.hybrid())
    thumbnails = await system.start(spec)
    for image in ("cat.png", "holiday.webp", "dog.png"):
        thumbnails.tell(Shrink(image))
    await asyncio.Event().wait()
