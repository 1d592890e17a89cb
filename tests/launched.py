"""Programs of their own that a test waits for, on any event loop; they find what the tests import."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def environment(**more: str) -> dict[str, str]:
    """Ours, with the folder above the tests among those that modules are imported from."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path, **more}


async def python(
    *words: object, timeout: float = 120.0, stderr: int = subprocess.PIPE
) -> subprocess.CompletedProcess[str]:
    """What our interpreter says if it is given these words, and how it ends."""
    command = [sys.executable, *map(str, words)]
    return await asyncio.to_thread(
        subprocess.run,
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        timeout=timeout,
        check=False,
    )


async def ended(*words: object, timeout: float = 60.0, **more: str) -> int:
    """How a program ends that our interpreter is given with these words, in this environment."""
    command = [sys.executable, *map(str, words)]
    done = await asyncio.to_thread(subprocess.run, command, env=environment(**more), timeout=timeout, check=False)
    return done.returncode


async def kills_itself(*words: object, timeout: float = 60.0, **more: str) -> None:
    """Wait until such a program has killed itself."""
    assert await ended(*words, timeout=timeout, **more) == -signal.SIGKILL
