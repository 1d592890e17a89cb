"""The whole suite beside four busy loops, again and again: a machine that has other things to do fails no test.

`make loaded RUNS=10`, or `python -m tests.loaded RUNS [arguments of pytest]` from the root of the repository. What
a run that fails has printed is shown, and the rest are made all the same.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from contextlib import ExitStack

LOOPS = 4
BUSY = "import os\nabove = os.getppid()\nwhile os.getppid() == above:\n    for _ in range(1_000_000):\n        pass"
"""It ends by itself when whoever has started it has ended, however that was."""
TESTS = ("-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-p", "no:cacheprovider")


def run_beside(loops: int, runs: int, arguments: list[str]) -> int:
    """Make the runs, and say after each how it went.

    Returns:
        How many of them failed.
    """
    failed = 0
    with ExitStack() as stack:
        for _ in range(loops):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", BUSY]))
            stack.callback(busy.kill)
        for number in range(1, runs + 1):
            began = time.monotonic()
            command = [sys.executable, *TESTS, *arguments]
            done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
            summary = re.findall(r"^.* in [\d.]+s.*$", done.stdout, re.M)
            line = summary[-1] if summary else f"exit status {done.returncode}"
            print(
                f"run {number} of {runs} beside {loops} busy loops, {time.monotonic() - began:.0f} s: {line}",
                flush=True,
            )
            if done.returncode:
                failed += 1
                print(done.stdout, done.stderr, flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(1 if run_beside(LOOPS, int(sys.argv[1]), sys.argv[2:]) else 0)
