"""The trial of a stack: a replica outside of the group plays all of its roles first.

Code that has never run is tried where it can hurt nobody: in a process that holds no state, that nobody waits for and
that is killed in any case. Whatever it does there (raise, hang, block its process, end it), the group does not notice.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import Awaitable
from typing import TYPE_CHECKING, Any, Final, TypeVar

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.cell import Cell
from ...supervision.admin import RemoveChild, StartChild
from ..bricks.replica_orders import Rehearse

if TYPE_CHECKING:
    from ...supervision.spec import ChildSpec
    from .replicas import Replicas

T = TypeVar("T")

TRIAL: Final = "trial"
"""How the replica is called that only tries."""
STARTED_WITHIN: Final = 30.0
"""Seconds that its process and its bricks may take to come up."""
REMOVED_WITHIN: Final = 60.0
"""Seconds that a replica may take to end."""
PASSED_WITHIN: Final = 15.0
"""Seconds that it may take to play one of its parts."""
PARTS: Final = ((True, False), (True, True), (False, False), (False, True))
"""Each role (whether it leads), and both ways into it: from the other one, and made in it."""


class TrialFailed(HoldfastError, text="{why}"):
    """The stack was tried, and does not work."""

    actor: str
    why: str


async def tried(replicas: Replicas, above: Cell, spec: ChildSpec) -> None:
    """Start a replica as `spec` says, have it play all roles, and end it.

    Args:
        replicas: those whose stack it is to be.
        above: the supervisor of its replicas.
        spec: that of a replica called `TRIAL`.

    Raises:
        TrialFailed: it does not start, does not let a batch pass, or not in time.
    """
    await ended(replicas, above)  # Whoever has tried before may have died of it.
    replicas.membership.expect(TRIAL)
    ref: Any = above.ref
    try:
        try:
            await ref.ask(StartChild(dataclasses.replace(spec, restart="temporary")), STARTED_WITHIN)
        except AskTimeout:
            raise TrialFailed(replicas.path, f"its bricks were not up within {STARTED_WITHIN:g} s") from None
        except HoldfastError as error:
            raise TrialFailed(replicas.path, str(error)) from error
        await rehearsed(replicas, TRIAL)
    finally:
        await ended(replicas, above)


async def rehearsed(replicas: Replicas, name: str) -> None:
    """Have a replica that has no part yet play all parts, each with a batch without requests.

    Raises:
        TrialFailed: a brick has not started, has ended its replica, or has kept the batch.
    """
    life = replicas.life_of(name)
    try:
        for part in PARTS:
            await replicas.entry(name).ask(Rehearse(*part), PASSED_WITHIN)
    except AskTimeout:
        why = f"one of its bricks did not start, or pass on an empty batch, within {PASSED_WITHIN:g} s"
        raise TrialFailed(replicas.path, why) from None
    except HoldfastError as error:
        raise TrialFailed(replicas.path, await replicas.why_ended(name, life, error)) from error


async def ended(replicas: Replicas, above: Cell) -> None:
    """End the replica that tries: its process is killed, whatever it does."""
    cell = replicas.cell_of(TRIAL)
    if cell is not None:
        await replicas.kill(TRIAL, cell.life)  # It is in nobody's hands: the change itself is made by leave.
        await removed(replicas, above, TRIAL)


async def removed(replicas: Replicas, above: Cell, name: str) -> None:
    """End a replica for good, if it is there."""
    ref: Any = above.ref
    if replicas.cell_of(name) is not None:
        with contextlib.suppress(HoldfastError):  # It is gone already.
            await ref.ask(RemoveChild(name, erase=True), REMOVED_WITHIN)


async def until_given_up(work: Awaitable[T], given_up: asyncio.Future[str]) -> T:
    """What comes of some work, unless nobody wants it any more.

    Raises:
        TrialFailed: it was given up.
    """
    task = asyncio.ensure_future(work)
    try:
        await asyncio.wait((task, given_up), return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise TrialFailed("", given_up.result())
    finally:
        if not task.done():
            task.cancel()
            await asyncio.wait((task,))
    return task.result()
