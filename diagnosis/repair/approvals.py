"""Approval of plans: by a message, by the command line, or by a callable of the program; whoever answers first."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from .notices import ApprovalWanted, NobodyWaits

Approver = Callable[[ApprovalWanted], bool | str | Awaitable[bool | str]]
"""Is told of a plan: True approves it, False or a reason denies it. It may be async, and take its time."""


class Approvals:
    """The plan that waits for a person; there is one case at a time.

    Args:
        approver: the program's own; None: only messages answer.
    """

    def __init__(self, approver: Approver | None = None) -> None:
        self._approver = approver
        self._wanted: ApprovalWanted | None = None
        self._answer: asyncio.Future[str] | None = None

    @property
    def wanted(self) -> ApprovalWanted | None:
        """What a person is asked for now."""
        return self._wanted

    def answer(self, case: int, why_not: str) -> None:
        """Approve (an empty `why_not`) or deny. Raises NobodyWaits."""
        answer = self._answer
        if self._wanted is None or self._wanted.case != case or answer is None or answer.done():
            raise NobodyWaits(case)
        answer.set_result(why_not)

    async def ask(
        self,
        wanted: ApprovalWanted,
        told: Callable[[ApprovalWanted], Awaitable[None]],
        overtaken: Coroutine[Any, Any, None],
    ) -> str | None:
        """Why a plan must not be carried out, empty if it may; None: nobody has answered in time.

        Args:
            wanted: what is asked, and for how long.
            told: tells it, when an answer can be taken already.
            overtaken: returns when nobody need answer any more.
        """
        self._wanted, self._answer = wanted, asyncio.get_running_loop().create_future()
        beside = [asyncio.create_task(overtaken)]
        try:
            await told(wanted)
            if self._approver is not None:
                beside.append(asyncio.create_task(self._ask_program(self._approver, wanted, self._answer)))
            await asyncio.wait((self._answer, beside[0]), timeout=wanted.seconds, return_when=asyncio.FIRST_COMPLETED)
            return self._answer.result() if self._answer.done() else None
        finally:
            self._wanted = self._answer = None
            for task in beside:
                task.cancel()

    async def _ask_program(self, approver: Approver, wanted: ApprovalWanted, answer: asyncio.Future[str]) -> None:
        try:
            said = approver(wanted)
            if inspect.isawaitable(said):
                said = await said
            why = "" if said is True else said if isinstance(said, str) and said else "the program said no"
        except Exception as error:  # Whatever the program raises is no yes.
            why = f"the program's approval has failed: {type(error).__name__}: {error}"
        if not answer.done():
            answer.set_result(why)
