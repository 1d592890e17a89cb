"""Programs that embed a system, started as their users start them, and the clients that put load on them."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import holdfast

FOLDER = Path(__file__).parents[3] / "examples/embedding"
PATHS = os.pathsep.join(
    filter(None, (str(FOLDER), str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH")))
)
PATIENCE = 60.0
"""Seconds that anything may take on a busy machine."""

Clients = Callable[[int, int], "Client"]


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


class Client:
    """One connection to a program: it puts numbers, and is told of each that it is kept. This one speaks HTTP."""

    def __init__(self, port: int, number: int) -> None:
        self.port = port

    def put(self, number: int) -> None:
        """Have a number kept. Raises OSError: no answer came."""
        ask(self.port, f"/notes/{number}", "POST")

    def close(self) -> None:
        """Hang up."""


def ask(port: int, path: str, method: str = "GET") -> str:
    """The body of the answer, with status 200. Raises OSError: there was none."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", method=method)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return str(answer.read().decode())
    except urllib.error.URLError as error:
        raise OSError(str(error)) from error
    except http.client.HTTPException as error:  # The server ended in the middle of an answer.
        raise OSError(str(error)) from error


def kept_by_http(port: int, workers: int) -> set[int]:
    """The numbers that all workers keep; connections are spread over them by the kernel."""
    found: dict[int, set[int]] = {}
    until = time.monotonic() + PATIENCE
    while len(found) < workers:
        assert time.monotonic() < until, f"of {workers} workers only {sorted(found)} have answered"
        told = json.loads(ask(port, "/notes"))
        found[told["worker"]] = set(told["numbers"])
    return set().union(*found.values())


class LineClient(Client):
    """The same by lines over TCP."""

    def __init__(self, port: int, number: int) -> None:
        super().__init__(port, number)
        self._socket = socket.create_connection(("127.0.0.1", port), PATIENCE)
        self._lines = self._socket.makefile("rw")

    def say(self, line: str) -> str:
        """The line that comes back. Raises OSError: none came."""
        self._lines.write(line + "\n")
        self._lines.flush()
        answer = self._lines.readline()
        if not answer.endswith("\n"):
            raise OSError("the connection has ended")
        return answer[:-1]

    def put(self, number: int) -> None:
        assert self.say(f"note {number}") == f"kept {number}"

    def close(self) -> None:
        self._socket.close()
        try:
            self._lines.close()
        except OSError:
            pass  # What was not sent any more needs no flush.


def kept_by_lines(port: int, workers: int) -> set[int]:
    """The numbers that are kept."""
    client = LineClient(port, 0)
    try:
        return set(map(int, client.say("notes").split()))
    finally:
        client.close()


@dataclass(frozen=True)
class Case:
    """A program, how it is started, and how one talks to it."""

    command: Sequence[str]
    client: Clients = Client
    kept: Callable[[int, int], set[int]] = kept_by_http
    workers: int = 1
    status: Sequence[int] = (0,)
    """What it may end with after SIGTERM."""
    environment: dict[str, str] = field(default_factory=dict)


@dataclass
class Running:
    """A program that runs."""

    case: Case
    port: int
    process: subprocess.Popen[bytes]
    log: Path

    def ready(self) -> None:
        """Wait until it answers."""
        until = time.monotonic() + PATIENCE
        while True:
            try:
                self.case.kept(self.port, self.case.workers)
            except OSError:
                assert self.process.poll() is None, self.log.read_text()
                assert time.monotonic() < until, self.log.read_text()
                time.sleep(0.05)  # It is another program, which tells nobody when it listens.
            else:
                return

    def kept(self) -> set[int]:
        """What it keeps."""
        return self.case.kept(self.port, self.case.workers)

    def kill(self) -> None:
        """SIGKILL for the program and all its processes, at one moment as good as any."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def terminate(self) -> None:
        """SIGTERM for its first process, as a service manager sends it; it ends well."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(PATIENCE) in self.case.status, self.log.read_text()


@contextmanager
def running(case: Case, folder: Path) -> Generator[Running]:
    """The program, up, with its store in a folder; it is killed at the end."""
    port, log = free_port(), folder / "log"
    command = [sys.executable if part == "PYTHON" else part.replace("PORT", str(port)) for part in case.command]
    environment = {
        **os.environ, "PYTHONPATH": PATHS, "NOTES_FOLDER": str(folder), "PORT": str(port), **case.environment,
    }  # fmt: skip
    with log.open("ab") as output:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=output, start_new_session=True
        )
    program = Running(case, port, process, log)
    try:
        program.ready()
        yield program
    finally:
        if process.poll() is None:
            program.kill()


class Load:
    """Clients that put numbers, each its own, until they get no answer any more; what was confirmed is remembered."""

    def __init__(self, program: Running, clients: int = 4, *, begin: int = 0) -> None:
        self.confirmed: set[int] = set()
        self._program, self._begin, self._step = program, begin, clients
        self._changed = threading.Condition()
        self._is_over = False
        self._threads = [threading.Thread(target=self._put, args=(number,)) for number in range(clients)]

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        for thread in self._threads:
            thread.join()

    def wait_for(self, count: int) -> None:
        """Wait until so many are confirmed."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.confirmed) >= count, PATIENCE), self._program.log.read_text()

    def _put(self, first: int) -> None:
        number, client = self._begin + first, None
        while not self._is_over:
            try:
                client = client or self._program.case.client(self._program.port, number)
                client.put(number)
            except OSError:
                if client is not None:
                    client.close()
                client = None
                if self._program.process.poll() is not None:
                    return
                time.sleep(0.01)  # Its listener is closed, and it has not ended yet.
            else:
                with self._changed:
                    self.confirmed.add(number)
                    self._changed.notify_all()
                number += self._step
        if client is not None:
            client.close()
