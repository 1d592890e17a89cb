"""The two lanes of commits, each in order: which submission waits for which. Data and decisions."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from ..actors.errors import HoldfastError
    from .journal import Entry


class Submission(Protocol):
    """What is to be written, and what follows."""

    @property
    def entries(self) -> Sequence[tuple[str, Entry]]:
        """What is written, by address."""
        ...

    @property
    def weight(self) -> int:
        """How many messages it is worth."""
        ...

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        ...

    def safe(self) -> None:
        """Let it take effect: it is as safe as it has to be."""
        ...

    def refused(self, error: HoldfastError) -> bool:
        """It was not written. False: it has happened, and must be written when that is possible again."""
        ...

    def abandoned(self, error: HoldfastError) -> None:
        """It has happened, and will never be written: who waits for it is told."""
        ...


@dataclasses.dataclass(slots=True)
class CommitLanes:
    """What was submitted, from its submission to its effect.

    Attributes:
        is_all_slow: whether the store is safe only when it is synced: nothing is quick then.
        is_synced: whether homes want what they submit to be synced if they do not say what they want.
        synced_paths: homes that want what they submit to be synced.
        quick_paths: homes that want less than that.
        last_slow: the last submission of a home in the slow lane.
        pending: what is not written, each with its number in the slow lane; 0: it is in the quick one.
        is_urgent: whether something among it need not be synced.
        unsynced: what is written and waits for a sync, with its number.
        ready: what is as safe as it has to be, and has not taken effect yet.
        submitted, written, synced: numbers in the slow lane, up to which this is so.
    """

    is_all_slow: bool = False
    is_synced: bool = False
    synced_paths: set[str] = dataclasses.field(default_factory=set)
    quick_paths: set[str] = dataclasses.field(default_factory=set)
    last_slow: dict[str, int] = dataclasses.field(default_factory=dict)
    pending: list[tuple[Submission, int]] = dataclasses.field(default_factory=list)
    is_urgent: bool = False
    unsynced: deque[tuple[int, Submission]] = dataclasses.field(default_factory=deque)
    ready: deque[Submission] = dataclasses.field(default_factory=deque)
    submitted: int = 0
    written: int = 0
    synced: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether everything that was submitted has taken effect."""
        return not (self.pending or self.unsynced or self.ready)

    def want(self, path: str, *, is_synced: bool) -> None:
        """Take down how safe what a home submits has to be."""
        self.synced_paths.discard(path)
        self.quick_paths.discard(path)
        (self.synced_paths if is_synced else self.quick_paths).add(path)

    def rename(self, paths: Mapping[str, str]) -> None:
        """Take down that homes have other addresses."""
        self.synced_paths = {paths.get(path, path) for path in self.synced_paths}
        self.quick_paths = {paths.get(path, path) for path in self.quick_paths}
        self.last_slow = {paths.get(path, path): number for path, number in self.last_slow.items()}

    def _is_slow(self, submission: Submission) -> bool:
        if not self.quick_paths:
            return self.is_all_slow or bool(self.synced_paths)
        if not (self.synced_paths or self.is_synced):
            return False
        paths, synced = self.quick_paths, self.synced  # What is kept for who is not known yet may have to be synced.
        return any(path not in paths or self.last_slow.get(path, 0) > synced for path, _ in submission.entries)

    def submit(self, submission: Submission) -> None:
        """Put a submission in its lane: whoever has something in the slow one stays there with all that follows."""
        number = 0
        if self._is_slow(submission):
            self.submitted = number = self.submitted + 1
            if self.quick_paths:
                for path, _ in submission.entries:
                    self.last_slow[path] = number
        else:
            self.is_urgent = True
        self.pending.append((submission, number))

    def first(self, most: int) -> int:
        """How many of what is pending are worth so many messages, or just more."""
        weight = 0
        for count, (submission, _) in enumerate(self.pending, 1):
            weight += submission.weight
            if weight >= most:
                return count
        return len(self.pending)

    def take_written(self, counts: Sequence[int], positions: Sequence[int]) -> None:
        """The first ones stand in the journal, each with so many entries there: what need not be synced is ready."""
        done = self.pending[: len(counts)]
        del self.pending[: len(counts)]
        self.is_urgent = any(not number for _, number in self.pending)
        begin = 0
        for (submission, number), count in zip(done, counts, strict=True):
            end = begin + count
            submission.written(positions[begin:end])
            begin = end
            if number:
                self.written = number
                self.unsynced.append((number, submission))
            else:
                self.ready.append(submission)

    def take_synced(self, number: int) -> None:
        """All up to this number has outlived the machine: it is ready."""
        self.synced = number
        while self.unsynced and self.unsynced[0][0] <= number:
            self.ready.append(self.unsynced.popleft()[1])
        if not self.unsynced and not self.pending:
            self.last_slow.clear()

    def refuse(self, error: HoldfastError) -> None:
        """Refuse what is not written and can be refused; the rest stays, in front of what comes meanwhile."""
        pending, self.pending = self.pending, []
        kept = [(submission, number) for submission, number in pending if not submission.refused(error)]
        self.pending = [*kept, *self.pending]

    def abandon(self, error: HoldfastError) -> None:
        """Give up all that is not safe: it will never take effect."""
        waiting = [*(submission for _, submission in self.unsynced), *(submission for submission, _ in self.pending)]
        self.unsynced.clear()
        self.pending = []
        for submission in waiting:
            if not submission.refused(error):
                submission.abandoned(error)
