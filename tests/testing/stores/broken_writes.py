"""Engines that lose something at a kill, a failure, an opening or a closing, or share a store with another owner."""

from __future__ import annotations

import contextlib
import os
import pickle
from collections.abc import Generator, Sequence
from pathlib import Path

from holdfast.checkpoint.journal import Entry, StoreFailed
from tests.checkpoint.one_file import Contents, OneFile


class EpochStays(OneFile):
    """Has the same epoch at each opening."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.epoch = 1


class EpochInFourBits(OneFile):
    """Begins with the first epoch again after sixteen openings."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.epoch %= 16


class WritesAtClose(OneFile):
    """Has something in memory alone until it is closed in good order."""

    def leave_out(self, contents: Contents) -> None:
        """Take out of a copy what is not written yet."""

    def _write(self, contents: Contents) -> None:
        written = contents.copy()
        if self._refusal != "closing":
            self.leave_out(written)
        super()._write(written)

    def close(self) -> None:
        if self._owner >= 0:
            self._refusal = "closing"
            self._write(self._contents)
        super().close()


class EpochAtClose(WritesAtClose):
    """Writes the epoch when it is closed in good order: after a kill the next life has the same."""

    def leave_out(self, contents: Contents) -> None:
        contents.epoch -= 1


class NotesAtClose(WritesAtClose):
    """Writes notes when it is closed in good order."""

    def leave_out(self, contents: Contents) -> None:
        contents.notes = {}


class PacksAtClose(WritesAtClose):
    """Writes blocks when it is closed in good order."""

    def leave_out(self, contents: Contents) -> None:
        contents.blocks = {}


class LastPositionAtClose(OneFile):
    """Writes the highest position when it is closed in good order: after a kill it begins after what is there."""

    def _read(self) -> Contents:
        contents = super()._read()
        clean = self.path.with_suffix(".clean")
        if not clean.exists():
            contents.last = max((position for known in contents.entries.values() for position in known), default=0)
        clean.unlink(missing_ok=True)
        return contents

    def close(self) -> None:
        if self._owner >= 0:
            self.path.with_suffix(".clean").touch()
        super().close()


class NobodyIsLockedOut(OneFile):
    """Has two openings acknowledge at once, each over the other's file."""

    def _lock_out(self) -> int:
        return os.open(self.path.with_suffix(".lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)


class FencesAppendsAlone(OneFile):
    """Refuses the appends of an owner that another one has followed, and takes its notes and cuts."""

    def _lock_out(self) -> int:
        return os.open(self.path.with_suffix(".lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        if self._read().epoch != self.epoch:
            raise StoreFailed(str(self.path), "it has another owner")
        return super().append(entries)


class WritesInPlace(OneFile):
    """Overwrites its file: a kill inside leaves half of it."""

    def _write(self, contents: Contents) -> None:
        with open(self.path, "wb") as file:
            file.write(pickle.dumps(contents))
            file.flush()
            os.fsync(file.fileno())


class WritesInPlaceAtOpening(OneFile):
    """Overwrites its file when it is opened, and never else."""

    def _write(self, contents: Contents) -> None:
        if hasattr(self, "_contents") and contents.epoch == self._contents.epoch:
            super()._write(contents)
        else:
            WritesInPlace._write(self, contents)  # type: ignore[arg-type]


class RemovesBeforeItReplaces(OneFile):
    """Removes the old file before the new one has its name."""

    def _write(self, contents: Contents) -> None:
        beside = self.path.with_suffix(".new")
        beside.write_bytes(pickle.dumps(contents))
        with open(beside, "rb") as file:
            os.fsync(file.fileno())
        self.path.unlink(missing_ok=True)
        os.rename(beside, self.path)


class ReadsWhatIsBeside(OneFile):
    """Prefers a new file that was not finished to the old one."""

    def _read(self) -> Contents:
        beside = self.path.with_suffix(".new")
        if beside.exists() and beside.stat().st_size:
            with contextlib.suppress(EOFError, pickle.UnpicklingError):
                contents: Contents = pickle.loads(beside.read_bytes())
                return contents
        return super()._read()


class NotesInAFileOfTheirOwn(OneFile):
    """Has notes in a second file, written in place."""

    def _write(self, contents: Contents) -> None:
        self.path.with_suffix(".notes").write_bytes(pickle.dumps(contents.notes))
        super()._write(contents)

    def _read(self) -> Contents:
        contents, notes = super()._read(), self.path.with_suffix(".notes")
        contents.notes = pickle.loads(notes.read_bytes()) if notes.exists() else {}
        return contents


class LogWithoutAnEnd(OneFile):
    """Appends each state to one file, and cannot read a newest one that is torn."""

    def _write(self, contents: Contents) -> None:
        with open(self.path, "ab") as file:
            file.write(pickle.dumps(contents))
            file.flush()
            os.fsync(file.fileno())

    def _read(self) -> Contents:
        contents = Contents()
        if self.path.exists():
            with open(self.path, "rb") as file:
                while file.peek(1):
                    contents = pickle.load(file)
        return contents


class RaisesWhatItGets(OneFile):
    """Raises OSError for a disk that fails."""

    @contextlib.contextmanager
    def _changing(self) -> Generator[Contents, None, None]:
        with self._lock:
            if self._refusal:
                raise StoreFailed(str(self.path), self._refusal)
            changed = self._contents.copy()
            yield changed
            self._write(changed)
            self._contents = changed


class RemembersWhatItCouldNotWrite(OneFile):
    """Changes its memory first: after a failure it has what is not in the file."""

    @contextlib.contextmanager
    def _changing(self) -> Generator[Contents, None, None]:
        with self._lock:
            if self._refusal:
                raise StoreFailed(str(self.path), self._refusal)
            yield self._contents
            try:
                self._write(self._contents)
            except OSError as error:
                raise StoreFailed(str(self.path), f"{error}") from error


class AcknowledgesWhatItCouldNotWrite(OneFile):
    """Takes no notice of a write that fails."""

    def _write(self, contents: Contents) -> None:
        with contextlib.suppress(OSError):
            super()._write(contents)


class HalfABatchOnAFullDisk(OneFile):
    """Writes the first half of a batch when there is no room for all, and refuses the batch."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        try:
            return super().append(entries)
        except StoreFailed:
            if not self._refusal and len(entries) > 1:
                super().append(entries[: len(entries) // 2])
            raise


class FiveCountAsFour(OneFile):
    """Hands out the last position of a batch of five again."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions = super().append(entries)
        if len(entries) == 5:
            with self._changing() as contents:
                contents.last -= 1
        return positions


class NeverSyncs(OneFile):
    """Leaves it to the system when its file comes to the disk."""

    def _write(self, contents: Contents) -> None:
        beside = self.path.with_suffix(".new")
        beside.write_bytes(pickle.dumps(contents))
        os.replace(beside, self.path)

    def _sync(self) -> None:
        pass


class SyncsFilesAlone(OneFile):
    """Syncs each file and never its name: a power failure brings the file before it back."""

    def _sync(self) -> None:
        pass


class GoesOnAfterAFailedSync(OneFile):
    """Takes a sync that has failed for one that can be tried again."""

    def sync(self) -> None:
        try:
            super().sync()
        except StoreFailed:
            self._refusal = ""
            raise


class SaysNothingOfAFailedSync(OneFile):
    """Takes no notice of a sync that fails."""

    def _sync(self) -> None:
        with contextlib.suppress(OSError):
            super()._sync()


class WritesWhenItIsClosed(OneFile):
    """Takes writes after it was closed."""

    def close(self) -> None:
        super().close()
        self._refusal = ""


class ClosesOnce(OneFile):
    """Raises at a second close."""

    def close(self) -> None:
        if self._owner < 0:
            raise StoreFailed(str(self.path), "it is closed")
        super().close()


class LosesTheNewestAtClose(OneFile):
    """Goes back to the last but one state when it is closed."""

    def _write(self, contents: Contents) -> None:
        self._before = getattr(self, "_contents", contents)
        super()._write(contents)

    def close(self) -> None:
        if self._owner >= 0:
            OneFile._write(self, self._before)
        super().close()


class OneThreadAtATime(OneFile):
    """Has no lock: an append in another thread goes under, or has a position that is another's."""

    @contextlib.contextmanager
    def _changing(self) -> Generator[Contents, None, None]:
        if self._refusal:
            raise StoreFailed(str(self.path), self._refusal)
        changed = self._contents.copy()
        yield changed
        try:
            self._write(changed)
        except OSError as error:
            raise StoreFailed(str(self.path), f"{error}; nothing was written") from error
        self._contents = changed


class TogetherInParts(OneFile):
    """Says that it keeps several writes as one, and writes each."""

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        yield
