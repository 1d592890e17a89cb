"""The bench: where an engine is opened, closed, killed, and made to fail."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from ...actors.errors import StoreError
from ...checkpoint.engine_calls import safe_at_of
from ...checkpoint.journal import Journal, SafeAt
from .comparing import PromiseBroken
from .watching import full_disk, grown, signature, watched

Factory = Callable[[Path], Journal]
Crash = Callable[[Journal, Path], Path]
Fail = Callable[[Path], AbstractContextManager[None]]


def acknowledged(journal: Journal, write: Callable[[], object]) -> None:
    """Write, and wait until it is as safe as it has to be before anybody may be told of it."""
    write()
    if safe_at_of(journal) == "sync":
        journal.sync()


class Bench:
    """Makes stores in folders of their own below one folder.

    Args:
        factory: opens the engine in a folder.
        crash: given an engine and its folder, makes a folder as a kill of the process would leave it now; or `None`:
            kills are not tested.
        fail: a context in which the folder takes no more bytes.
        path: an empty folder.
    """

    def __init__(self, factory: Factory, crash: Crash | None, path: Path, fail: Fail = full_disk) -> None:
        self.factory, self.crash, self.fail = factory, crash, fail
        self._path, self._count = path, 0
        self._opened: list[OpenEngine] = []

    def fresh(self) -> Path:
        """A new folder; the one beside it, `1`, is free for a crash hook to make."""
        self._count += 1
        folder = self._path / str(self._count) / "0"
        folder.mkdir(parents=True)
        return folder

    def open(self, folder: Path | None = None) -> OpenEngine:
        """Open the engine, in a new folder if none is given."""
        made = OpenEngine(self, folder or self.fresh())
        self._opened.append(made)
        return made

    def copy(self, journal: Journal, folder: Path) -> Path:
        """The folder as a kill would leave it now, elsewhere."""
        if self.crash is None:
            raise ValueError("nothing is known of kills")
        made = self.crash(journal, folder)
        place = self.fresh()
        place.rmdir()
        return made.rename(place)

    def close(self) -> None:
        """Close all that is still open."""
        while self._opened:
            try:
                self._opened.pop().journal.close()
            except StoreError:
                pass  # It has failed before, as it was made to.

    def remove(self) -> None:
        """Close all, and remove all files."""
        self.close()
        shutil.rmtree(self._path, ignore_errors=True)


class OpenEngine:
    """An open engine, and where it is.

    Attributes:
        journal: the engine, of the present opening.
        folder: its folder.
        epoch: that of the newest opening, which the next one's must exceed.
    """

    def __init__(self, bench: Bench, folder: Path) -> None:
        self.bench, self.folder = bench, folder
        self.epoch = 0
        self.journal = self._open(folder)

    def _open(self, folder: Path) -> Journal:
        journal = self.bench.factory(folder)
        epoch = journal.epoch
        if type(epoch) is not int or epoch <= self.epoch:
            journal.close()
            raise PromiseBroken(
                f"an opening has epoch {epoch!r} after epoch {self.epoch}: it must rise with each of them"
            )
        self.epoch = epoch
        return journal

    def reopen(self) -> None:
        """Close it and open it again."""
        self.journal.close()
        self.journal = self._open(self.folder)

    @property
    def safe_at(self) -> SafeAt:
        """When what was written outlives a kill: at once, or only when a `sync` has come back."""
        return safe_at_of(self.journal)

    def kill(self, *, synced: bool = True) -> None:
        """Go on with what a kill leaves; what was open before is closed, in its own folder, as if it were not there.

        Args:
            synced: have an engine sync before, if what it was given is not safe without that.
        """
        if synced and self.safe_at == "sync":
            self.journal.sync()
        folder = self.bench.copy(self.journal, self.folder)
        self.journal.close()
        self.folder = folder
        self.journal = self._open(folder)

    @contextmanager
    def surviving(self, folder: Path) -> Generator[Journal, None, None]:
        """What a kill has left, opened for a look; the engine itself stays open."""
        epoch = self.epoch
        journal = self._open(folder)
        self.epoch = epoch
        try:
            yield journal
        finally:
            journal.close()
            shutil.rmtree(folder.parent, ignore_errors=True)

    @contextmanager
    def killing(self, draw: random.Random, most: int, share: float = 1.0) -> Generator[list[Path], None, None]:
        """Copy the folder as a kill leaves it each time it changes meanwhile, with the newest write whole and torn.

        Args:
            draw: chooses which of the states, and where a write is torn.
            most: copies at most.
            share: of the states that are copied.
        """
        copies: list[Path] = []
        problems: list[Exception] = []
        before = signature(self.folder)

        def look(event: str, _: Any) -> None:
            nonlocal before
            if event in ("c_call", "call") or problems or len(copies) >= most:
                return
            now = signature(self.folder)
            if now == before:
                return
            longer, before = grown(before, now), now
            if draw.random() >= share:
                return
            try:
                copies.append(self.bench.copy(self.journal, self.folder))
                if longer is not None:
                    copies.append(self._torn(*longer, draw))
            except Exception as error:  # It would be raised inside the engine.
                problems.append(error)

        with watched(look):
            yield copies
        if problems:
            raise problems[0]

    def _torn(self, path: str, old: int, new: int, draw: random.Random) -> Path:
        """The folder with one file cut off within what was written last."""
        folder = self.bench.fresh()
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        with open(folder / Path(path).relative_to(self.folder), "r+b") as file:
            file.truncate(draw.randrange(old + 1, new))
        return self.bench.copy(self.journal, folder)
