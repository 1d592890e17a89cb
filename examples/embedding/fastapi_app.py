"""A FastAPI application under uvicorn or gunicorn, with one worker or with several.

`uvicorn fastapi_app:app`, or `WEB_CONCURRENCY=2 gunicorn -k uvicorn_worker.UvicornWorker fastapi_app:app`; then
`curl -X POST localhost:8000/notes/1` and `curl localhost:8000/notes`. Each worker has a ledger of its own.
"""

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import TypedDict

from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse
from ledger import Ledger, Note, Notes, ledger, make_system

import holdfast as hf
from holdfast.console.service.health import Service

WORKERS = int(os.environ.get("WEB_CONCURRENCY", "1"))
"""How many workers there are, which uvicorn and gunicorn read as well."""


class State(TypedDict):
    """What each request finds in `request.state`."""

    service: Service
    ledger: hf.ActorRef[Ledger]
    threads: hf.system.ThreadPortal


@asynccontextmanager
async def lifespan(app: FastAPI) -> AsyncGenerator[State, None]:
    """The system starts and stops with its worker; if its tree fails, its master starts another."""
    async with Service(make_system, workers=WORKERS, ends_server=True) as service:
        kept = await service.system.start(ledger(isolation="process"))
        service.up()
        yield {"service": service, "ledger": kept, "threads": service.system.from_thread()}


app = FastAPI(lifespan=lifespan)


@app.post("/notes/{number}")
async def note(number: int, request: Request) -> dict[str, int]:
    """An `async def` runs on the loop of the system, and uses the ref itself."""
    return {"count": await request.state.ledger.ask(Note(number))}


@app.get("/notes")
def notes(request: Request) -> dict[str, list[int] | int]:
    """A plain `def` runs in a thread, where a ref must not be used: the portal brings the message to the loop."""
    numbers: list[int] = request.state.threads.ask(request.state.ledger, Notes())
    return {"worker": request.state.service.number, "numbers": numbers}


@app.get("/livez")
async def live(request: Request) -> PlainTextResponse:
    """Whether this worker should go on."""
    verdict = await request.state.service.live()
    return PlainTextResponse(verdict.text, verdict.status)


@app.get("/readyz")
async def ready(request: Request) -> PlainTextResponse:
    """Whether requests should come here."""
    verdict = await request.state.service.ready()
    return PlainTextResponse(verdict.text, verdict.status)
