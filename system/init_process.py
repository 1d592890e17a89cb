"""The first process of a container (PID 1): it reaps whoever nobody waits for, and passes signals on to the program."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import warnings
from typing import NoReturn


def leave_init() -> None:
    """If this is PID 1, go on in a child process: PID 1 stays behind as its init, and ends as the child ends.

    The kernel gives each orphan to PID 1, and ignores signals that it has no handler for. A program that waits for
    orphans would take the exit status of its own children from whoever waits for them, so a process of its own does it.

    Where other threads run already a child would go on without them: then a RuntimeWarning is given, and nobody reaps.
    """
    if os.getpid() != 1:
        return
    threads = len(os.listdir("/proc/self/task"))
    if threads > 1:
        why = f"hf.run is PID 1, and {threads} threads run already: it reaps no orphans; use `docker run --init`"
        warnings.warn(why, RuntimeWarning, stacklevel=3)
        return
    for stream in (sys.stdout, sys.stderr):  # What is left in a buffer would be written by both.
        stream.flush()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    program = os.fork()
    if program:
        _serve_as_init(program)
    if os.isatty(0):  # Ctrl+C is for the program, and reaches it once.
        os.setpgid(0, 0)
        os.tcsetpgrp(0, os.getpgrp())  # SIGTTOU is blocked.
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve_as_init(program: int) -> NoReturn:
    """Reap and pass signals on, until the program ends. All signals are blocked here, so that none gets lost."""
    own = {signal.SIGCHLD, signal.SIGTTIN, signal.SIGTTOU}  # The others are for the program.
    while True:
        number = signal.sigwait(signal.valid_signals())
        if number not in own:
            with contextlib.suppress(ProcessLookupError):
                os.kill(program, number)
            continue
        while True:
            try:
                ended, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                os._exit(1)  # The program is no child any more, which nobody can bring about: do not hang.
            if not ended:
                break
            if ended == program:
                code = os.waitstatus_to_exitcode(status)
                os._exit(code if code >= 0 else 128 - code)  # The program has done what stands in `atexit`.
