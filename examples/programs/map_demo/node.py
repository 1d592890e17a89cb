"""A node of the fleet that maps a building: it stands by, leads, reads the log on, and answers over a Unix socket.

Command: python -m map_demo.node STORE SOCKET LOG SPEED INTERVAL
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from pathlib import Path
from typing import Any

import msgspec

from holdfast import ActorSystem, HoldfastError, hybrid, run

from .actors import GetMap, LogRead, Mapper, Reader, ReadLog
from .demo_runs import LONGEST_READING, MAPPER, READER, tree
from .desk import PATIENCE, Desk, Inquiry
from .far import KINDS, FarAnswer, FarRequest, read_frame, write_frame
from .grid import Geometry
from .log import survey

DESK = "/demo/robot/desk"


async def read_on(system: ActorSystem, log: str, speed: float) -> LogRead:
    """Have the log read from behind the last scan that the mapper has."""
    state = await system.ref(MAPPER, Mapper).ask(GetMap(), timeout=PATIENCE)  # Behind all that waits for it.
    reading = ReadLog(log, speed, state.scans)
    return await system.ref(READER, Reader).ask(reading, timeout=LONGEST_READING)


async def answer(system: ActorSystem, request: FarRequest, reading: asyncio.Future[LogRead]) -> bytes:
    """Do what was asked from outside, and return the reply."""
    message: Any = msgspec.msgpack.decode(request.message, type=KINDS[request.kind])
    match message:
        case ReadLog():
            return msgspec.msgpack.encode(await asyncio.shield(reading))
        case GetMap():
            return msgspec.msgpack.encode(await system.ref(MAPPER, Mapper).ask(message, timeout=PATIENCE))
        case _:
            inquiry = Inquiry(message.serial, request.kind, request.message)
            return await system.ref(DESK, Desk).ask(inquiry, timeout=PATIENCE)


async def serve(
    system: ActorSystem, reading: asyncio.Future[LogRead], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Answer one client, until it is gone or something cannot be answered: then it asks again."""
    working: set[asyncio.Task[None]] = set()

    async def work(request: FarRequest) -> None:
        try:
            reply = await answer(system, request, reading)
            write_frame(writer, msgspec.msgpack.encode(FarAnswer(request.number, os.getpid(), reply)))
        except (HoldfastError, OSError):
            writer.close()

    try:
        with contextlib.suppress(EOFError, OSError):
            while True:
                task = asyncio.create_task(work(msgspec.msgpack.decode(await read_frame(reader), type=FarRequest)))
                working.add(task)
                task.add_done_callback(working.discard)
    finally:
        for task in working:
            task.cancel()
        writer.close()


async def main() -> None:
    """Stand by, lead, and serve until another leads."""
    store, socket, log, speed, interval = sys.argv[1:]
    found = survey(Path(log))
    geometry = Geometry.covering(found.x_min, found.y_min, found.x_max, found.y_max)
    async with ActorSystem("demo", store=store, standby="warm", log=False) as system:
        await system.start(tree(geometry, hybrid(interval=float(interval)), kills=0, desk=True))
        reading = asyncio.ensure_future(read_on(system, log, float(speed)))
        try:
            own = f"{socket}.{os.getpid()}"
            async with await asyncio.start_unix_server(lambda *ends: serve(system, reading, *ends), own):
                os.replace(own, socket)  # From here on clients come to this leader.
                await asyncio.Event().wait()
        finally:
            reading.cancel()


if __name__ == "__main__":
    run(main, again=True)
