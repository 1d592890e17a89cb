"""The end of a part of a batch, when what its turns have left may turn out to be no state that can be saved.

The turn that has left it so fails: whoever asked gets the error, and the state goes back to where it was before. It
must never end the replica: its successor would be given the same request, and end too.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from ..alarms import ProtectionLost

if TYPE_CHECKING:
    from ...checkpoint.protocol import TurnEnd
    from ..replica.protected_actor import Server
    from .brick_messages import Request


async def sealed(server: Server, ends: list[TurnEnd], pending: deque[Request]) -> list[TurnEnd]:
    """Seal a part that was run; returns its ends as they are after that."""
    while True:
        begun, tail = list(server.begun), list(server.tail)
        try:
            server.seal(ends)
        except Exception as error:  # What the user's own values and methods raise; it is passed on to who asked.
            server.begun, server.tail = begun, tail
            if server.is_lazy:
                _go_on_without(server, ends)
                return ends
            if server.point is None or not begun:
                raise
            await _find(server, ends, error)
            ends = await server.part_again(pending, single=len(begun) > 1)
        else:
            return ends


def _go_on_without(server: Server, ends: list[TurnEnd]) -> None:
    """Nobody looks at the state now: what is handled goes on; but no other replica can take it."""
    begun, server.begun = server.begun, []
    server._skips.clear()
    server._keep_tail(begun, ends)
    standing = server.standing
    if server.can_save:
        server.can_save = False
        standing.node.emit(ProtectionLost(standing.address, standing.path, standing.epoch))


async def _find(server: Server, ends: list[TurnEnd], error: Exception) -> None:
    """If only one turn can have done it, that one fails; else they are run again, one by one."""
    begun, life = server.begun, server.life
    if len(begun) == 1 and life is not None and life.cell.actor is not None:
        server.fail(begun[0], ends[-1], error)
    await server.drop_life()
