"""Starlette websockets: one actor for each connection, which writes to it; a room that all of them share is recorded.

`uvicorn websocket_chat:app`, then connect to `ws://localhost:8000/chat` and send numbers: "5" is answered by "kept 5",
and everybody who is connected reads it.
"""

import asyncio
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import TypedDict

from ledger import Ledger, Note, Notes, ledger, make_system
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

import holdfast as hf
from holdfast.console.service.health import Service

SLOWEST = 5.0
"""Seconds that a client may take to read one message; one that is slower is let go."""


class Kept(hf.Message):
    """A number was kept: all connections tell their clients."""

    number: int


class Connection(hf.Actor):
    """Writes to one client. One that does not read fills the mailbox of its own actor, and holds up nobody else."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket

    @hf.subscribe("/kept")
    @hf.on(Kept)
    async def tell_client(self, message: Kept) -> None:
        async with asyncio.timeout(SLOWEST):
            await self._socket.send_text(f"kept {message.number}")

    async def on_stop(self, reason: hf.ExitReason) -> None:
        if reason != hf.NORMAL:  # The client has not hung up: it is told, rather than left waiting.
            await self._socket.close(1012, "this server ends: connect again")


CONNECTIONS = hf.dynamic(
    "connections",
    template=hf.child(None, hf.Start(Connection), restart="temporary", mailbox=hf.bounded(100, overflow="drop_oldest")),
    max_children=10_000,
)


class State(TypedDict):
    """What each connection finds in its `state`."""

    service: Service
    ledger: hf.ActorRef[Ledger]
    connections: hf.ActorRef[hf.supervision.DynamicSupervisor]


@asynccontextmanager
async def lifespan(app: Starlette) -> AsyncGenerator[State, None]:
    """The system starts and stops with the server."""
    async with Service(make_system(), ends_server=True) as service:
        kept = await service.system.start(ledger())
        connections = await service.system.start(CONNECTIONS)
        service.up()
        yield {"service": service, "ledger": kept, "connections": connections}


async def chat(socket: WebSocket) -> None:
    """Read from one client, for as long as it is connected."""
    await socket.accept()
    service: Service = socket.state.service
    connection = await socket.state.connections.ask(hf.StartChild(args=(socket,)))
    try:
        async for text in socket.iter_text():
            number = int(text)
            await socket.state.ledger.ask(Note(number))
            await service.system.publish("/kept", Kept(number))  # Only when it is safe in the store.
    except (hf.HoldfastError, ValueError) as error:
        await socket.close(1011, str(error)[:100])
    finally:
        await service.system.stop(connection, hf.NORMAL)


async def notes(request: Request) -> JSONResponse:
    """List the numbers that are kept."""
    return JSONResponse({"worker": 0, "numbers": await request.state.ledger.ask(Notes())})


async def ready(request: Request) -> PlainTextResponse:
    """Whether clients should connect here."""
    verdict = await request.state.service.ready()
    return PlainTextResponse(verdict.text, verdict.status)


app = Starlette(
    routes=[WebSocketRoute("/chat", chat), Route("/notes", notes), Route("/readyz", ready)], lifespan=lifespan
)
