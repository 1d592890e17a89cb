"""The server of lines: connections end in every way, and nothing that was said to a user is lost."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[2] / "examples/tcp_server.py"
PATIENCE = 60.0
"""Seconds that anything may take on a busy machine."""


class Client:
    """One connection."""

    def __init__(self, port: int, *, buffer: int = 0) -> None:
        self.socket = socket.socket()
        if buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self.socket.settimeout(PATIENCE)
        try:
            self.socket.connect(("127.0.0.1", port))
        except OSError:
            self.socket.close()
            raise
        self._lines = self.socket.makefile("r")

    def send(self, *lines: str) -> None:
        self.socket.sendall("".join(f"{line}\n" for line in lines).encode())

    def say(self, line: str) -> str:
        """The next line that comes."""
        self.send(line)
        return self.hear()

    def hear(self) -> str:
        """The next line; "" at the end of the connection."""
        return self._lines.readline().rstrip("\n")

    def rest(self) -> list[str]:
        """All lines to the end of the connection."""
        try:
            return [line.rstrip("\n") for line in self._lines]
        except ConnectionError:
            return []

    def close(self) -> None:
        self._lines.close()
        self.socket.close()


class Server:
    """The program, which can be ended and started again."""

    def __init__(self, folder: Path, life: ExitStack, processes: int) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            self.port = listening.getsockname()[1]
        self._life, self._folder = life, folder
        self._given = {"PORT": str(self.port), "STORE": f"sqlite:{folder}/tcp.db", "PROCESSES": str(processes)}
        self.start()

    def start(self) -> None:
        log = self._life.enter_context((self._folder / "log").open("ab"))
        command = (sys.executable, str(PROGRAM))
        self.process = subprocess.Popen(command, env=os.environ | self._given, stderr=log, cwd=self._folder)

    def client(self, *, buffer: int = 0) -> Client:
        """Connect, as soon as somebody listens."""
        until = time.monotonic() + PATIENCE
        while True:
            try:
                client = Client(self.port, buffer=buffer)
            except OSError:
                assert self.process.poll() is None, (self._folder / "log").read_text()
                assert time.monotonic() < until
                time.sleep(0.05)  # It is another program, which tells nobody when it listens.
            else:
                self._life.callback(client.close)
                return client

    def user(self, name: str) -> Client:
        """Connect as a user."""
        client = self.client()
        assert client.say(f"hello {name}") == f"hello {name}"
        return client

    def end(self, number: int) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def kill_process_of(self, client: Client) -> None:
        """End the process in which a connection lives, and wait until it has closed what it had open."""
        ends = f"sport = :{self.port} and dport = :{client.socket.getsockname()[1]}"
        told = subprocess.run(["ss", "-Htnp", ends], capture_output=True, text=True, check=True).stdout
        process = os.pidfd_open(int(told.partition("pid=")[2].partition(",")[0]))
        try:
            signal.pidfd_send_signal(process, signal.SIGKILL)
            assert select.select([process], [], [], PATIENCE)[0]
        finally:
            os.close(process)


@contextmanager
def serving(folder: Path, processes: int = 1) -> Generator[Server, None, None]:
    with ExitStack() as life:
        server = Server(folder, life, processes)
        try:
            yield server
        finally:
            server.process.kill()
            server.process.wait()


def test_what_is_said_waits_for_its_user_until_it_is_acknowledged(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        bob = server.client()
        assert [bob.say(f"say ann {text}") for text in ("one", "two", "three")] == ["said"] * 3
        ann = server.user("ann")
        assert [ann.hear() for _ in range(3)] == ["1 one", "2 two", "3 three"]
        ann.send("ack 2")
        assert ann.say("ping") == "pong"
        ann.close()
        assert server.end(signal.SIGKILL) == -signal.SIGKILL
        server.start()
        assert server.client().say("say ann four") == "said"
        ann = server.user("ann")
        assert [ann.hear(), ann.hear()] == ["3 three", "4 four"]


@pytest.mark.parametrize("processes", [1, 2])
def test_a_user_who_comes_again_takes_over_when_his_old_connection_has_ended(tmp_path: Path, processes: int) -> None:
    with serving(tmp_path, processes) as server:
        clients = [server.user("ann") for _ in range(5)]
        for client in clients[:-1]:
            assert client.rest() == ["bye: you are connected elsewhere"]
        assert server.client().say("say ann hello") == "said"
        assert clients[-1].hear() == "1 hello"


def test_a_client_that_does_not_read_is_let_go_and_holds_up_nobody(tmp_path: Path) -> None:
    text = "x" * 60_000
    with serving(tmp_path) as server:
        ann, bob = server.client(buffer=4096), server.client()
        assert ann.say("hello ann") == "hello ann"
        for _ in range(120):
            assert bob.say(f"say ann {text}") == "said"
        again = server.user("ann")
        assert again.hear() == f"1 {text}"
        assert len(ann.rest()) < 120


def test_a_stop_tells_those_who_are_connected(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        ann = server.user("ann")
        assert server.end(signal.SIGTERM) == 128 + signal.SIGTERM
        assert ann.rest() == ["bye: this server ends, connect again"]


def test_a_session_learns_that_its_connection_has_died_with_the_program(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        server.user("ann")
        server.end(signal.SIGKILL)
        server.start()
        stranger = server.client()  # Who has the place of the old connection now.
        assert stranger.say("ping") == "pong"
        ann = server.user("ann")
        assert stranger.say("say ann hello") == "said"
        assert ann.hear() == "1 hello"


def test_a_session_learns_that_its_connection_has_died_with_a_process(tmp_path: Path) -> None:
    with serving(tmp_path, processes=2) as server:
        ann = server.user("ann")
        server.kill_process_of(ann)
        assert ann.rest() == []
        assert server.client().say("say ann hello") == "said"
        ann = server.user("ann")
        assert ann.hear() == "1 hello"
