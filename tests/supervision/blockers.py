"""An actor that blocks the thread of its process, where it is told to."""

from __future__ import annotations

import time

import holdfast as hf


class Blocker(hf.Actor):
    """Sleeps, without letting anybody else run, in `__init__`, `on_start` or `on_stop`."""

    def __init__(self, phase: str) -> None:
        self.phase = phase
        self._block("__init__")

    def _block(self, phase: str) -> None:
        while phase == self.phase:
            time.sleep(0.01)

    def on_start(self, restored: bool) -> None:
        self._block("on_start")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self._block("on_stop")
