"""The command that shows a running system in the browser: dashboard."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import secrets
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from ..remote import RemoteSystem
from ..runtime_folder import found_sockets
from .reaching import FAILED, GREETING_SECONDS, Socket, System, chosen, ended, told


def dashboard(
    system: System = None,
    socket: Socket = None,
    host: Annotated[str, typer.Option(help="The address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 0,
    read_only: Annotated[bool, typer.Option("--read-only", help="Nobody changes anything in this page.")] = False,
    token_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The token is in it; it is made if it is not there. Else a new one is drawn."
        ),
    ] = None,
    names: Annotated[
        list[str] | None, typer.Option("--name", metavar="HOST", help="A name that browsers use for this machine.")
    ] = None,
    certfile: Annotated[Path | None, typer.Option(metavar="FILE", help="A certificate with its chain: TLS.")] = None,
    keyfile: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow an address that others can reach, without TLS.")
    ] = False,
    opens: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Show a running system in the browser: what is ill, why, and what to do, until Ctrl+C.

    The address that is printed has the token behind a '#', which browsers send to nobody.

    Exit status 0: ended by Ctrl+C. 1: it cannot be served. 2: no system answers.
    """
    with told("dashboard"):
        path = chosen(system, socket)
        with RemoteSystem(path) as remote:
            remote.greet(GREETING_SECONDS)
        names_found = [one.system for one in found_sockets() if one.path == path]
        # The next program of that name has another endpoint.
        target = functools.partial(chosen, names_found[0], None) if names_found and socket is None else path
        try:
            from .. import dashboard as room
        except ImportError as error:
            raise ended("dashboard", str(error), FAILED) from error
        token = secrets.token_urlsafe() if token_file is None else room.token_of(token_file, "token_file")
        given = [*(names or ()), host]
        app = (
            room.dashboard(target, readers=token, hosts=given, readers_see_state=True)
            if read_only
            else room.dashboard(target, operators=token, hosts=given)
        )

        async def serve() -> None:
            async with room.open_dashboard(
                app, host=host, port=port, certfile=certfile, keyfile=keyfile, insecure=insecure
            ) as url:
                typer.echo(f"{url}#token={token}")
                if opens:
                    webbrowser.open(f"{url}#token={token}")
                await asyncio.Event().wait()

        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(serve())
