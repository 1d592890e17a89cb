"""Programs under strace: whether that can be, and that nothing is left of them."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from pathlib import Path


def can_trace() -> bool:
    """Whether strace is here, and may do its work."""
    if shutil.which("strace") is None:
        return False
    return (
        subprocess.run(["strace", "-qq", "-e", "trace=none", "true"], capture_output=True, check=False).returncode == 0
    )


def end_all(program: subprocess.Popen[bytes], tracer: subprocess.Popen[bytes] | None, folder: Path) -> None:
    """Leave no process of the program behind: each has the directory that it was started in."""
    program.kill()
    while left := _processes_in(folder):
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            program.wait(0.1)
    if tracer is not None:
        tracer.kill()
        tracer.communicate()
    if program.stdin is not None and not program.stdin.closed:
        program.communicate()


def _processes_in(folder: Path) -> list[int]:
    """Those that live and work there."""
    found: list[int] = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdecimal() and (entry / "cwd").samefile(folder):
                found.append(int(entry.name))
    return found
