"""A program that watches clients and a child's pipes, and then can watch no more descriptors: python served.py LOOP."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteSystem
from tests.faults.watches import wait_for_word

LINES = 100_000
BYTES = 900_000
CHILD = f"""
import sys
sys.stdin.readline()
for n in range({LINES}): print(n, 'x' * 30)
print('got', len(sys.stdin.read()), flush=True)
"""


def look(path: Path) -> str:
    """As another process would do it."""
    try:
        with RemoteSystem(path) as remote:
            return f"served {len(remote.tree())}"
    except hf.HoldfastError as error:
        return f"{type(error).__name__}: {error}"


async def work() -> None:
    path = Path.cwd() / "app.sock"
    lines: list[str] = []
    over = asyncio.Event()

    def heard(event: object) -> None:
        if isinstance(event, hf.events.LogLine):
            lines.append(event.text)
            if event.text.startswith("got"):
                over.set()

    async with hf.ActorSystem("app", log=False) as system, control_endpoint(system, path):
        system._node.events.add_sink(heard)
        child = hf.supervision.program(
            [sys.executable, "-I", "-S", "-c", CHILD], id="it", stdin=True, restart="temporary"
        )
        program = await system.start(child)
        await asyncio.to_thread(len, "")  # Its thread is there.
        wait_for_word()
        await program.ask(hf.supervision.ProgramInput("go\n"), timeout=60.0)
        await program.ask(hf.supervision.ProgramInput(data=b"y" * BYTES, end=True), timeout=60.0)
        for _ in range(2):
            print(await asyncio.to_thread(look, path), flush=True)
        await over.wait()
        is_whole = lines[:-1] == [f"{n} {'x' * 30}" for n in range(LINES)]
        print(lines[-1], is_whole, flush=True)
        wait_for_word()
        print((await asyncio.to_thread(look, path)).split(" ", maxsplit=1)[0], flush=True)


def main() -> None:
    (hf.run if sys.argv[1] == "uvloop" else asyncio.run)(work())
