"""A plain asyncio program: a server that reads lines, under `hf.run`. It needs no framework, and no web server.

`python line_server.py`, then `echo "note 5" | nc localhost 8000`. The same program is what line-server.service
(systemd, with watchdog), Dockerfile (as PID 1) and kubernetes.yaml (with probes) run: see `PROBES` in the last two.
"""

import asyncio
import os

from ledger import Note, Notes, ledger, make_system
from lines import serve_lines

import holdfast as hf
from holdfast.console.service.health import Service


async def main() -> None:
    """Serve until a signal comes: `hf.run` then cancels this, and the system stops in order."""
    async with Service(make_system(), probes=os.environ.get("PROBES")) as service:
        kept = await service.system.start(ledger())

        async def answer(words: list[str]) -> str:
            match words:
                case ["note", number]:
                    await kept.ask(Note(int(number)))
                    return f"kept {number}"
                case ["notes"]:
                    return " ".join(map(str, await kept.ask(Notes())))
                case _:
                    return "note NUMBER, or notes"

        async with serve_lines(answer):
            service.up()
            await asyncio.Event().wait()


if __name__ == "__main__":
    hf.run(main())
