"""A server that answers lines over TCP, for those programs of this folder that have no framework."""

import asyncio
import os
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager

import holdfast as hf


@asynccontextmanager
async def serve_lines(answer: Callable[[list[str]], Awaitable[str]]) -> AsyncGenerator[None, None]:
    """Listen at `PORT` of this machine until the block ends; whoever is still connected is then cut off."""
    talks: set[asyncio.Task[None]] = set()

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async for line in reader:
                writer.write(f"{await answer(line.decode().split())}\n".encode())
                await writer.drain()
        except (OSError, hf.HoldfastError):
            pass  # The client has gone, or the program ends: there was no answer, and the client asks again.
        finally:
            writer.close()

    def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.get_running_loop().create_task(talk(reader, writer))
        talks.add(task)
        task.add_done_callback(talks.discard)

    server = await asyncio.start_server(connected, "127.0.0.1", int(os.environ.get("PORT", "8000")))
    try:
        yield
    finally:
        server.close()
        for task in talks:
            task.cancel()
        await asyncio.gather(*talks, return_exceptions=True)
