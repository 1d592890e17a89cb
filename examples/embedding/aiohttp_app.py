"""An aiohttp application: the system lives in its cleanup context. `python aiohttp_app.py`."""

import os
from collections.abc import AsyncGenerator

from aiohttp import web
from ledger import Ledger, Note, Notes, ledger, make_system

import holdfast as hf
from holdfast.console.service.health import Service

SERVICE = web.AppKey("service", Service)
LEDGER = web.AppKey("ledger", hf.ActorRef[Ledger])


async def run_system(app: web.Application) -> AsyncGenerator[None, None]:
    """Start the system before the first request, and stop it after the last one."""
    async with Service(make_system()) as service:
        app[SERVICE] = service
        app[LEDGER] = await service.system.start(ledger())
        service.up()
        yield


async def note(request: web.Request) -> web.Response:
    """Keep a number."""
    return web.json_response({"count": await request.app[LEDGER].ask(Note(int(request.match_info["number"])))})


async def notes(request: web.Request) -> web.Response:
    """List the numbers that are kept."""
    return web.json_response({"worker": 0, "numbers": await request.app[LEDGER].ask(Notes())})


async def live(request: web.Request) -> web.Response:
    """Whether the program should go on."""
    verdict = await request.app[SERVICE].live()
    return web.Response(text=verdict.text, status=verdict.status)


async def ready(request: web.Request) -> web.Response:
    """Whether requests should come here."""
    verdict = await request.app[SERVICE].ready()
    return web.Response(text=verdict.text, status=verdict.status)


def make_app() -> web.Application:
    """Make the application."""
    app = web.Application()
    app.cleanup_ctx.append(run_system)
    app.router.add_post("/notes/{number}", note)
    app.router.add_get("/notes", notes)
    app.router.add_get("/livez", live)
    app.router.add_get("/readyz", ready)
    return app


if __name__ == "__main__":
    # By itself aiohttp waits for a minute for a connection that was made when the signal came.
    web.run_app(make_app(), host="127.0.0.1", port=int(os.environ.get("PORT", "8000")), shutdown_timeout=10.0)
