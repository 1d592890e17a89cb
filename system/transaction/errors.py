"""Errors of transactions that were refused or failed."""

from __future__ import annotations

from ...actors.errors import HoldfastError


class TransactionFailed(HoldfastError):
    """A step could not be carried out; what was done before it has been undone.

    Attributes:
        step: the step, in words.
        cause: why, in words; in the same process the error itself is `__cause__`.
        undone: the steps that were undone, in that order.
        kept: steps that could not be undone, each with the reason: their effect is still there.
    """

    step: str
    cause: str
    undone: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()

    def __str__(self) -> str:
        left = f"; NOT undone: {'; '.join(self.kept)}" if self.kept else "; everything is as before"
        return f"transaction failed at: {self.step} ({self.cause}){left}"


class TransactionRefused(TransactionFailed):
    """A step cannot be carried out, as was seen before anything was done."""

    def __str__(self) -> str:
        return f"transaction refused at: {self.step} ({self.cause}); nothing was done"
