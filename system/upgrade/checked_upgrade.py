"""The check of an upgrade: new code handles again what a store has recorded, in a process apart, and is compared.

The process may hang in the user's code, or be ended by it. It says in a page of memory which turn it is in, so that
this is known of it then; the next process goes on with the next address.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import mmap
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from typing import IO, Any, Final, NoReturn

from ...actors.errors import HoldfastError, SpecError
from ...actors.exit_reasons import Signal
from ...actors.process.fork.launch import import_path
from ...actors.seconds import check_seconds
from ...checkpoint.store_key import StoreKey, read_store_key
from ...checkpoint.store_tools.copies import back_up_store
from ...checkpoint.store_tools.upgrade_check import DIFFERENT, AddressCheck
from .page import PAGE_BYTES, WorkerPosition, read_place

LOOK_SECONDS: Final = 0.2
"""How often is looked whether the process has come further."""
TURN_TIMEOUT: Final = 30.0
"""Seconds a turn may take if the user does not say."""
START_TIMEOUT: Final = 60.0
"""Seconds that what comes before the first turn may take at least: an import, or reading what is recorded."""
PROCESS: Final = f"from {__package__}.checking_process import main; main()"


@dataclasses.dataclass(frozen=True, slots=True)
class UpgradeCheck:
    """The outcome of the check of an upgrade.

    Attributes:
        store: its path.
        target: the name of the new program's specs.
        addresses: what became of each recorded address.
    """

    store: str
    target: str
    addresses: list[AddressCheck]

    @property
    def is_fine(self) -> bool:
        """Say whether the new code goes on with all that is recorded as the old one would."""
        return all(one.is_fine for one in self.addresses)

    @property
    def has_differences(self) -> bool:
        """Say whether it does not at some address; else some may be unchecked."""
        return any(one.verdict in DIFFERENT for one in self.addresses)


class CheckLost(Exception):
    """The process is over before it had checked everything."""

    def __init__(self, why: str, place: WorkerPosition) -> None:
        super().__init__(why)
        self.place = place


def check_upgrade(
    store: str | os.PathLike[str],
    target: str,
    *,
    recovery: str | os.PathLike[str] | None = None,
    store_key: StoreKey | None = None,
    turn_timeout: float = TURN_TIMEOUT,
) -> UpgradeCheck:
    """Check whether a new program goes on with what a store has recorded as the old one would; it is not changed.

    A system may have the store open. A copy of it is made in a temporary folder, and the recorded turns of each address
    are handled again by the new code, in a process of its own. What they send goes nowhere. It blocks until that is
    done: call it in a thread, or in another process.

    Args:
        store: the path of the SQLite database.
        target: the specs of the new program, as "module:name" or "program.py:name" (see `load_specs`). Nothing of it
            is imported in this process.
        recovery: the recovery file of the new program, if it has one.
        store_key: of an encrypted store, as in `ActorSystem(store_key=...)`; the copy is encrypted with it, too.
        turn_timeout: seconds a turn may take; one that takes longer is a difference.

    Raises:
        SpecError: the specs cannot be had. StoreError: the store cannot be read or copied. WrongStoreKey: the key
            is not the store's.
    """
    seconds = check_seconds("check_upgrade", "turn_timeout", turn_timeout)
    where, secret = os.path.realpath(store), read_store_key(store_key)
    with tempfile.TemporaryDirectory(prefix="holdfast-upgrade-") as folder:
        copy = os.path.join(folder, "copy.db")
        back_up_store(where, copy, key=secret)
        order = {
            "store": copy,
            "target": target,
            "recovery": None if recovery is None else os.path.abspath(recovery),
            "page": os.path.join(folder, "page"),
            "has_key": secret is not None,
        }
        checks = list(_checks(order, folder, seconds, secret))
    return UpgradeCheck(where, target, checks)


def _checks(order: dict[str, Any], folder: str, seconds: float, secret: bytes | None) -> Iterator[AddressCheck]:
    """All addresses, in processes that follow one another if need be."""
    left: list[str] | None = None
    while left is None or left:
        try:
            ordered = order if left is None else {**order, "addresses": left}
            for record in _records(ordered, folder, seconds, secret):
                if "error" in record:
                    raise HoldfastError(record["error"])
                if "addresses" in record:
                    left = record["addresses"]
                else:
                    assert left is not None
                    check = AddressCheck(**record)
                    left.remove(check.address)
                    yield check
        except CheckLost as lost:
            if not left:
                raise SpecError(order["target"], f"while it was imported, its process {lost}") from lost
            address, place = left.pop(0), lost.place
            if place.turn < 0:
                why = f"before its first turn, its process {lost}"
                yield AddressCheck(address, "unchecked", problem=why)
            else:
                why = f"in this turn its process {lost}"
                yield AddressCheck(address, "differs", place.handled, place.turn, place.message, why)


def _records(order: dict[str, Any], folder: str, seconds: float, secret: bytes | None) -> Iterator[dict[str, Any]]:
    """What one process says, to its end.

    Raises:
        CheckLost: it was ended, or has not come further for so many seconds.
    """
    with open(order["page"], "w+b") as file, open(os.path.join(folder, "errors"), "w+b") as errors:
        file.truncate(PAGE_BYTES)
        with mmap.mmap(file.fileno(), PAGE_BYTES) as page, _running(order, errors, secret) as (process, said):
            lines = _lines(process, said, page, seconds)
            for line in lines:
                record = json.loads(line)
                if "over" in record:
                    return
                yield record
            _lost(process.wait(), errors, read_place(page))


def _lost(status: int, errors: IO[bytes], place: WorkerPosition) -> NoReturn:
    errors.seek(0)
    last = errors.read().decode(errors="replace").strip().rpartition("\n")[2]
    how = f"was ended by {Signal(-status)}" if status < 0 else f"has ended with status {status}"
    raise CheckLost(f"{how}: {last}" if last else how, place)


@contextlib.contextmanager
def _running(
    order: dict[str, Any], errors: IO[bytes], secret: bytes | None
) -> Generator[tuple[subprocess.Popen[bytes], IO[bytes]], None, None]:
    """A process that checks; it ends with this block at the latest, with all that it has started."""
    read, write = os.pipe()
    with open(read, "rb") as said:
        try:
            process = subprocess.Popen(
                [sys.executable, "-c", PROCESS, json.dumps(order), str(write)],
                stdin=subprocess.PIPE,  # It gives the key, and its end tells the process that this one is gone.
                stdout=subprocess.DEVNULL,
                stderr=errors,
                pass_fds=(write,),
                env={**os.environ, "PYTHONPATH": os.pathsep.join(import_path())},
                start_new_session=True,
            )
        finally:
            os.close(write)
        with process:
            try:
                if secret is not None and process.stdin is not None:
                    with contextlib.suppress(BrokenPipeError):  # How it has ended is found where its lines are read.
                        os.write(process.stdin.fileno(), secret)
                yield process, said
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)


def _lines(process: subprocess.Popen[bytes], said: IO[bytes], page: mmap.mmap, seconds: float) -> Iterator[bytes]:
    """The lines that a process writes.

    Raises:
        CheckLost: it has not come further for so many seconds.
    """
    before, since, rest = read_place(page), time.monotonic(), b""
    with selectors.DefaultSelector() as selector:
        selector.register(said, selectors.EVENT_READ)
        while True:
            if selector.select(LOOK_SECONDS):
                data = os.read(said.fileno(), 1 << 16)
                if not data:
                    return
                *lines, rest = (rest + data).split(b"\n")
                yield from lines
                since = time.monotonic()
            place = read_place(page)
            if place != before:
                before, since = place, time.monotonic()
                continue
            limit = seconds if place.turn >= 0 else max(seconds, START_TIMEOUT)
            if time.monotonic() - since > limit:
                raise CheckLost(f"has not come to an end within {limit:g} s", place)
