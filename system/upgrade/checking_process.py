"""The process that checks an upgrade: it imports the new program, and has it handle the recorded turns."""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import json
import mmap
import os
import sys
import threading
from collections.abc import Callable
from typing import Any

from ...actors.errors import HoldfastError
from ...actors.kernel.node import Node
from ...checkpoint.recovery_file import load_recovery
from ...checkpoint.store_key import KEY_BYTES
from ...checkpoint.store_opening import open_journal
from ...checkpoint.store_tools.kept_lives import apart
from ...checkpoint.store_tools.rerun import Recipe
from ...checkpoint.store_tools.upgrade_check import check_address
from .new_program import NewProgram, load_specs
from .page import PAGE_BYTES, Progress


def main() -> None:
    """Do what the order in the first argument says, and tell of it on the descriptor in the second one."""
    order: dict[str, Any] = json.loads(sys.argv[1])
    said = os.fdopen(int(sys.argv[2]), "w")
    os.set_inheritable(said.fileno(), False)
    sys.argv[1:] = []
    gc.set_threshold(50_000)  # What is read back stays: to look through it again and again takes a fifth of the time.
    key = os.read(0, KEY_BYTES) if order["has_key"] else None
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def tell(record: dict[str, Any]) -> None:
        said.write(json.dumps(record) + "\n")
        said.flush()

    try:
        with open(order["page"], "r+b") as file, mmap.mmap(file.fileno(), PAGE_BYTES) as page:
            asyncio.run(_check(order, key, Progress(page), tell))
    except (HoldfastError, OSError) as error:
        tell({"error": str(error)})
    tell({"over": True})
    os._exit(0)  # Threads and exit handlers of the program are no reason to stay.


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


async def _check(
    order: dict[str, Any], key: bytes | None, progress: Progress, tell: Callable[[dict[str, Any]], None]
) -> None:
    """Raises HoldfastError, OSError: nothing can be checked."""
    specs = load_specs(order["target"])
    file = None if order["recovery"] is None else load_recovery(order["recovery"])
    homes = apart(Node("check", asyncio.get_running_loop()), open_journal(f"sqlite:{order['store']}", key=key))
    program = NewProgram(homes, specs, file)
    addresses: list[str] = order.get("addresses") or sorted(homes.known(""))
    tell({"addresses": addresses})
    for address in addresses:
        progress.next_address()
        found = program.recipe(address)
        if isinstance(found, Recipe):
            found = await check_address(homes, address, found, progress.turn)
        tell(dataclasses.asdict(found))
    homes.close()
