"""Programs that embed a system, each with its real server: stopped and killed under load, none loses a thing."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from tests.examples.embedding.programs import (
    PATIENCE,
    Case,
    Client,
    LineClient,
    Load,
    kept_by_lines,
    running,
)


class ChatClient(Client):
    """One websocket. What the others say it reads, too."""

    def __init__(self, port: int, number: int) -> None:
        super().__init__(port, number)
        self._life = contextlib.ExitStack()
        try:
            there = connect(f"ws://127.0.0.1:{port}/chat", open_timeout=PATIENCE, proxy=None)
            self._socket = self._life.enter_context(there)
        except (WebSocketException, EOFError) as error:
            raise OSError(str(error)) from error

    def put(self, number: int) -> None:
        try:
            self._socket.send(str(number))
            while self._socket.recv(PATIENCE) != f"kept {number}":
                pass
        except WebSocketException as error:
            raise OSError(str(error)) from error

    def close(self) -> None:
        self._life.close()


UVICORN = ("PYTHON", "-m", "uvicorn", "--port", "PORT", "--log-level", "warning")
GUNICORN = ("PYTHON", "-m", "gunicorn", "-k", "uvicorn_worker.UvicornWorker", "-b", "127.0.0.1:PORT")
TWO = {"WEB_CONCURRENCY": "2"}
CASES = {
    "uvicorn with workers": Case((*UVICORN, "fastapi_app:app"), workers=2, environment=TWO),
    "gunicorn": Case((*GUNICORN, "fastapi_app:app"), workers=2, environment=TWO),
    "websockets": Case((*UVICORN, "websocket_chat:app"), ChatClient, status=(0, -15)),
    "aiohttp": Case(("PYTHON", "-m", "aiohttp_app")),
    "plain asyncio": Case(("PYTHON", "-m", "line_server"), LineClient, kept_by_lines, status=(143,)),
    "background jobs": Case(("PYTHON", "-m", "background_jobs"), LineClient, kept_by_lines, status=(143,)),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.some(3)
def test_nothing_confirmed_is_lost_by_sigterm_or_by_kill_9(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    with running(case, tmp_path) as program, Load(program) as load:
        load.wait_for(40)
        program.terminate()
    confirmed = load.confirmed
    with running(case, tmp_path) as program, Load(program, begin=1_000_000) as load:
        assert confirmed <= program.kept()
        load.wait_for(40)
        program.kill()
    confirmed |= load.confirmed
    with running(case, tmp_path) as program:
        assert confirmed <= program.kept()
        program.terminate()
