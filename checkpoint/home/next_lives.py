"""Asks of recorded turns to supervisors, registries and pools, which keep no journal: their next lives are asked again.

What such an actor had not handled when it was stopped, or what leads to the same if it is handled twice, is asked of
its next life, in this program or, from the asker's journal, in the next one. The turn that waits for it is left if its
actor is to end before that. If nobody will live there again, the turn hears so.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, NamedTuple

from ...actors.errors import ActorStopped, AskFailed
from ...actors.exit_reasons import ExitReason
from ...actors.kernel.cell import DOWN, GONE, RUNNING, Cell
from ...actors.kernel.node import cell_kind
from .recorded_home import switch_of

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.kernel.codec import Codec
    from ...actors.kernel.node import Node
    from ..protocol import Out
    from .homes import Homes
    from .pending_asks import SwitchAsk
    from .switch import Switch


def _never(codec: Codec, name: str, body: bytes) -> bool:
    return False


def _nobody(node: Node, path: str) -> type[Actor] | None:
    return None


class RuntimeAsks(NamedTuple):
    """What is known of actors that keep no journal, and of what they are asked.

    Attributes:
        bears_repetition: whether a message leads to the same if it is handled twice.
        to_come: the class of who is about to be started at an address; None: nobody is, as far as is known here.
    """

    bears_repetition: Callable[[Codec, str, bytes], bool] = _never
    to_come: Callable[[Node, str], type[Actor] | None] = _nobody


class NextLives:
    """The asks of a root that wait for somebody to live at an address again."""

    def __init__(self, homes: Homes, runtime: RuntimeAsks) -> None:
        self._homes, self._runtime = homes, runtime
        self._waiting: dict[str, list[SwitchAsk]] = {}

    def bears_repetition(self, name: str, body: bytes) -> bool:
        """Whether a message to somebody who keeps no journal leads to the same if it is handled twice."""
        return self._runtime.bears_repetition(self._homes.node.codec, name, body)

    def may_be_asked(self, home: Switch, turn: int, out: Out) -> bool:
        """Whether the turn in hand asks again what it has asked in an earlier program, of who keeps no journal."""
        return (turn, out.k) in home.ledger.waits.unasked or self.bears_repetition(out.name, out.body)

    def is_to_come(self, target: Cell) -> bool:
        """Whether one of the runtime's actors is about to be started where nobody lives at the moment."""
        kind = self._runtime.to_come(self._homes.node, target.path)
        return kind is not None and kind._is_asked_again and self._lasts

    def answers(self, cell: Cell) -> bool:
        """Whether what waits at an address between two lives is answered by the next one, also in the next program."""
        kind = cell_kind(cell)
        return self._is_up or switch_of(cell) is not None or (kind is not None and kind._is_asked_again)

    def takes(self, ask: SwitchAsk, error: BaseException) -> bool:
        """Whether an ask has not failed by the end of who was asked: it is asked of the next life."""
        out, kind = ask.out, cell_kind(ask.target)
        if out is None or kind is None or not kind._is_asked_again:
            return False
        there = ask.target.living
        if isinstance(error, AskFailed):
            if error.actor != there.path or not self.bears_repetition(out.name, out.body):
                return False
            ask.doubt = error
        elif not isinstance(error, ActorStopped) or there.state is RUNNING:
            return False  # It takes nothing more, and is not started again; or a worker of a pool has ended.
        if there.state is GONE and not self._may_come(there):
            return False
        self._go_on(ask.switch.outputs.made_again(ask))
        return True

    def _may_come(self, gone: Cell) -> bool:
        """Whether an address that was given up may have a next life: its supervisor has ended, and comes back."""
        return gone.host.parent.is_restarting(gone) and self._lasts

    @property
    def _lasts(self) -> bool:
        """Whether the asks outlive the end that is under way, if one is."""
        return self._homes.journal.durable or self._is_up

    @property
    def _is_up(self) -> bool:
        """Whether the program goes on."""
        root = self._homes.node.root
        return root is not None and root.state is RUNNING

    def _go_on(self, ask: SwitchAsk) -> None:
        """Ask again, as soon as somebody takes it there."""
        if ask.is_over:
            return
        there = ask.target.living
        if there.state is GONE:
            self.wait(ask, there.path)
            return
        ask.strand()
        if there.state is DOWN:
            self._homes.node.loop.call_soon(self._send, ask)
        else:
            there.ended().add_done_callback(functools.partial(self._again, ask))

    def _again(self, ask: SwitchAsk, ended: asyncio.Future[ExitReason]) -> None:
        self._go_on(ask)

    def _send(self, ask: SwitchAsk) -> None:
        ask.switch.outputs.send_ask(ask.chain[0][1], ask.target, ask)

    def wait(self, ask: SwitchAsk, path: str) -> None:
        """Have an ask wait until somebody lives at an address; in a program that ends, for the next one."""
        ask.strand()
        waiting = self._waiting.get(path)
        if waiting is None:
            waiting = self._waiting[path] = []
            self._homes.node.awaited.setdefault(path, []).append(functools.partial(self._come, path))
        waiting[:] = [*(one for one in waiting if not one.is_over), ask]
        self.rest(ask)

    def rest(self, ask: SwitchAsk) -> None:
        """Leave an ask that waits to the next program, if this one ends; it has its whole time limit there."""
        if ask.is_over or self._is_up or ask not in self._waiting.get(ask.target.path, ()):
            return
        if ask.doubt is None:
            ask.switch.calls.note_unasked(ask, is_so=True)
        ask.drop()

    def _come(self, path: str) -> None:
        for ask in self._waiting.pop(path, ()):
            self._homes.node.loop.call_soon(self._send, ask)  # Whoever comes there is not started yet.

    def began(self, supervisor: str, listed: Collection[str]) -> None:
        """A supervisor begins with these children: who waits for another one below it hears that it does not come."""
        above = f"{supervisor}/"
        for path in [one for one in self._waiting if one.startswith(above)]:
            if path[len(above) :].partition("/")[0] not in listed:
                self._give_up(path)

    def dismissed(self, supervisor: str) -> None:
        """A supervisor is forgotten: nobody brings back those below it."""
        for path in [one for one in self._waiting if f"{one}/".startswith(f"{supervisor}/")]:
            self._give_up(path)

    def _give_up(self, path: str) -> None:
        for ask in self._waiting.pop(path, ()):
            ask.out = None  # It is not asked again.
            ask.fail(ActorStopped(path, "it is not started again"))
