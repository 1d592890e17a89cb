"""Actors that are started in OS processes of their own. Imported there, so nothing of pytest here."""

from __future__ import annotations

import asyncio
import ctypes
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import holdfast as hf


class Where(hf.Message[int]):
    """The pid of the process that the actor lives in."""


class Add(hf.Message[int]):
    n: int


class Total(hf.Message[int]):
    pass


class Overdrawn(hf.Refusal):
    missing: int
    where: str


class Withdraw(hf.Message[int]):
    n: int


class Fail(hf.Message[int]):
    text: str


class FailLater(hf.Message[int]):
    text: str


class Run(hf.Message[Any]):
    """One of the things a `Worker` can do, by name."""

    what: str
    with_: Any = None


class Note(hf.Message):
    text: str


class Notes(hf.Message[list[str]]):
    """What was noted so far."""


class Seen(hf.Message):
    """To a recorder."""

    text: str


class Introduce(hf.Message[str]):
    """Ask `other` for its pid and say who it is."""

    other: hf.ActorRef[Any]


class Pass(hf.Message):
    """Tell `to` that we are here."""

    to: hf.ActorRef[Any]
    text: str


class WhoSent(hf.Message[list[str]]):
    """The addresses of the senders of all notes."""


class Later(hf.Message[str]):
    pass


class Answer(hf.Message):
    text: str


class Ticks(hf.Message[int]):
    """Answered when that many ticks have come."""

    count: int


class Tick(hf.Message):
    pass


class Compute(hf.Message[int]):
    n: int


class Computed(hf.Message):
    n: int


class Spend(hf.Message[None]):
    """Compute, and await nothing, until the turn has had so many seconds of a processor."""

    seconds: float


class Block(hf.Message[int]):
    """Wait in the turn until the file is there (`path`), asynchronously or not."""

    path: str
    blocking: bool = False


class Account(hf.Actor):
    def __init__(self, balance: int = 0) -> None:
        self.balance = balance

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        self.balance += message.n
        return self.balance

    @hf.on(Total, readonly=True)
    def total(self, message: Total) -> int:
        return self.balance

    @hf.on(Withdraw)
    def withdraw(self, message: Withdraw) -> int:
        if message.n > self.balance:
            raise Overdrawn(missing=message.n - self.balance, where=self.ctx.path)
        self.balance -= message.n
        return self.balance

    @hf.on(Fail)
    def fail(self, message: Fail) -> int:
        raise ValueError(message.text)

    @hf.on(FailLater)
    async def fail_later(self, message: FailLater) -> int:
        await asyncio.sleep(0)
        raise ValueError(message.text)

    @hf.on(Where)
    def where(self, message: Where) -> int:
        return os.getpid()


class Worker(Account):
    """Does what ends or burdens a process."""

    def __init__(self, log: str = "") -> None:
        super().__init__()
        self._log = log

    def on_start(self, restored: bool) -> None:
        self._write(f"start {self.ctx.life}")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self._write(f"stop {reason}")

    @hf.on(Spend)
    def spend(self, message: Spend) -> None:
        end = time.thread_time() + message.seconds
        while time.thread_time() < end:
            pass

    def _write(self, line: str) -> None:
        if self._log:
            with open(self._log, "a") as file:
                file.write(line + "\n")

    @hf.on(Run)
    def run(self, message: Run) -> Any:
        return getattr(self, "do_" + message.what)(message.with_)

    def do_kill_self(self, signum: int) -> None:
        os.kill(os.getpid(), signum)
        time.sleep(600)

    def do_kill_group(self, _: None) -> None:
        os.killpg(os.getpgid(0), signal.SIGKILL)
        time.sleep(600)

    def do_compute(self, seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    def do_exit(self, code: int) -> None:
        sys.exit(code)

    def do_leave(self, code: int) -> None:
        os._exit(code)

    def do_segfault(self, _: None) -> None:
        ctypes.string_at(0)

    def do_loop(self, path: str) -> None:
        open(path, "w").close()
        while True:
            time.sleep(600)

    def do_allocate(self, size: int) -> int:
        self._ballast = bytearray(b"x") * size
        return len(self._ballast)

    def do_open_files(self, count: int) -> int:
        files = []
        try:
            for _ in range(count):
                files.append(open("/dev/null"))  # noqa: PERF401, SIM115 - how many is the question
        except OSError:
            pass
        finally:
            for file in files:
                file.close()
        return len(files)

    def do_limits(self, _: None) -> list[int]:
        return [resource.getrlimit(resource.RLIMIT_AS)[0], resource.getrlimit(resource.RLIMIT_NOFILE)[0]]

    def do_niceness(self, _: None) -> int:
        return os.nice(0)

    def do_burn(self, _: None) -> None:
        def burn() -> None:
            while True:
                pass

        threading.Thread(target=burn, daemon=True).start()

    def do_start_program(self, _: None) -> int:
        return subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"]).pid

    def do_print(self, lines: list[str]) -> None:
        for line in lines:
            print(line)

    def do_write(self, what: list[Any]) -> None:
        fd, data = what
        while data:
            data = data[os.write(fd, data) :]

    def do_wrong_reply(self, _: None) -> Any:
        return threading.Lock()

    def do_huge_reply(self, size: int) -> bytes:
        return bytes(size)

    def do_huge_error(self, size: int) -> None:
        raise ValueError("x" * size)

    def do_surrogate_error(self, _: None) -> None:
        raise ValueError("half a pair: \ud800")

    @hf.on(Block)
    async def block(self, message: Block) -> int:
        while not os.path.exists(message.path):
            if message.blocking:
                time.sleep(0.005)
            else:
                await asyncio.sleep(0.005)
        self.balance += 1
        return self.balance


class Notebook(hf.Actor):
    """Keeps what it is told, and from whom."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.senders: list[str] = []
        self.waiting: list[tuple[int, hf.ReplyHandle[int]]] = []
        self.ticks = 0

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.notes.append(message.text)
        self.senders.append("" if self.ctx.sender is None else self.ctx.sender.path)

    @hf.subscribe("/news")
    @hf.on(Seen)
    def seen(self, message: Seen) -> None:
        self.notes.append(message.text)
        self.senders.append("" if self.ctx.sender is None else self.ctx.sender.path)

    @hf.on(Notes, readonly=True)
    def all(self, message: Notes) -> list[str]:
        return self.notes

    @hf.on(WhoSent, readonly=True)
    def who_sent(self, message: WhoSent) -> list[str]:
        return self.senders

    @hf.on(Where)
    def where(self, message: Where) -> int:
        return os.getpid()

    @hf.on(Introduce)
    async def introduce(self, message: Introduce) -> str:
        pid = await message.other.ask(Where())
        return f"{self.ctx.path} knows {message.other.path} {'here' if pid == os.getpid() else 'elsewhere'}"

    @hf.on(Pass)
    def pass_on(self, message: Pass) -> None:
        message.to.tell(Note(message.text))

    @hf.on(Later)
    def later(self, message: Later) -> hf.ReplyHandle[str]:
        self.handle = self.ctx.reply_handle()
        return self.handle

    @hf.on(Answer)
    def answer(self, message: Answer) -> None:
        self.handle.reply(message.text)

    @hf.on(Ticks)
    def count_ticks(self, message: Ticks) -> hf.ReplyHandle[int]:
        handle = self.ctx.reply_handle()
        self.waiting.append((message.count, handle))
        if message.count == 1:
            self.ctx.tell_after(0.001, Tick())
        else:
            self.ctx.every(0.001, Tick())
        return handle

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.ticks += 1
        for count, handle in self.waiting:
            if self.ticks >= count:
                handle.reply(count)

    @hf.on(Compute)
    def compute(self, message: Compute) -> hf.ReplyHandle[int]:
        self.result = self.ctx.reply_handle()
        self.ctx.pipe_to_self(self._square(message.n), Computed)
        return self.result

    async def _square(self, n: int) -> int:
        await asyncio.sleep(0)
        return n * n

    @hf.on(Computed)
    def computed(self, message: Computed) -> None:
        self.result.reply(message.n)


class Picky(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise RuntimeError("not like this")


class Slow(Notebook):
    """A notebook that can be held up."""

    @hf.on(Block)
    async def block(self, message: Block) -> int:
        while not os.path.exists(message.path):
            await asyncio.sleep(0.005)
        return 0


class PutAside(hf.Message):
    """Put aside until `Resume`; then noted."""

    text: str


class Resume(hf.Message):
    pass


class Patient(Notebook):
    """Puts messages aside, and writes down in a file what it has handled, in whichever life."""

    def __init__(self, log: str) -> None:
        super().__init__()
        self._log = log
        self._is_ready = False

    @hf.on(PutAside)
    def put_aside(self, message: PutAside) -> None:
        if self._is_ready:
            self._write(message.text)
        else:
            self.ctx.stash()

    @hf.on(Resume)
    def resume(self, message: Resume) -> None:
        self._is_ready = True
        self._write("resume")
        self.ctx.unstash()

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self._write(message.text)

    def _write(self, text: str) -> None:
        with open(self._log, "a") as file:
            file.write(text + "\n")
