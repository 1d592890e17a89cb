"""Moving a child to another supervisor: its life goes on, only its address changes."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import ControlFailed, HoldfastError
from ...checkpoint.home.recorded_home import switch_of
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import SnapshotNow
from ...supervision.children import STOPPED, UP
from ...supervision.respec import recipe_spec
from .arrangement import busy, child_of
from .draft import Draft, DraftPlace, Target, is_elsewhere
from .handing import Handing, check_handing, is_far
from .operation import Operation, text_of, wrong
from .relocation import MOVED_WITHIN, Gated
from .structure import check_child, check_not_uniform

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...ftm.bricks.sealed_frames import MovedCertificates
    from ..system import ActorSystem


class Reparent(Operation):
    """Put a child under another supervisor."""

    verb: ClassVar[str] = "move"

    def __init__(self, target: Target, supervisor: Target) -> None:
        super().__init__(target)
        self._to = supervisor
        self._above: DraftPlace | None = None  # the new supervisor, at this point
        self._root: DraftPlace | None = None
        self._asked: dict[Switch, int] = {}  # who was asked for a snapshot, behind which turn
        self._rests: dict[DraftPlace, Gated] = {}
        self._certificates: dict[DraftPlace, MovedCertificates] = {}
        self._handing: Handing | None = None  # by the first step that moves this actor, to where the last one wants it

    @property
    def text(self) -> str:
        return f"move {self.target} to {self._above.path if self._above is not None else text_of(self._to)}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        new, old = await draft.supervisor(self._to), place.parent
        self.target = place.path
        if place.spec is None and place.cell is not None:  # Its supervisor lives in another process.
            place.spec = recipe_spec(place.cell)
        if old is None or not old.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it, so it cannot be moved to another")
        if new in place.walk():
            raise wrong(place.path, f"it cannot be moved below itself, to {new.path}")
        check_not_uniform(old)
        if is_far(old) or is_far(new):
            await draft.supervisor(old.path)  # It tells whom it has before it has one less in the draft.
            check_handing(place, old, new)
        for above in new.upwards():
            if above.comes_last:
                raise wrong(
                    new.path, "it is started only when this transaction is in force: move to it in the next one"
                )
        if new.is_dynamic and place.is_stopped:
            raise wrong(place.path, f"it is stopped, and {new.path} is dynamic: it keeps nobody who does not run")
        for one in addressed(place):
            check_movable(one)
        check_child(new, place.spec)
        del old.children[place.name]
        new.children[place.name], place.parent = place, new
        self._found, self._above, self._root = place, new, draft.root
        if not (place.is_moved or place.is_planned):  # Who is added is started where it is to be.
            self._handing = draft.arrangement.handings[place] = Handing(place, draft.timeout)
        place.is_moved = True
        self.between_turns_of = (old, new)
        for holder in (old, new):
            draft.arrangement.touch(holder, self)

    async def prepare(self, system: ActorSystem) -> None:
        """Have recorded and protected actors rest: no turn of theirs is to be repeated under another address."""
        if self._found is None or self._handing is None or not self._place.has_moved:
            return
        await self._handing.prepare(system)
        await self._certify(system)
        waits = bool(self._others_settle(system)) or bool(self._unsteady(system))
        for one, rest in self._resting(system):
            if waits:  # Perhaps for what those here have to answer.
                await rest.give_up()
            else:
                await rest.reach(system, functools.partial(system._moves.pause, one.living(system.node), MOVED_WITHIN))

    async def _certify(self, system: ActorSystem) -> None:
        """Have those whose links are secured be certified where they go; requests flow meanwhile."""
        for one in addressed(self._place):
            cell = one.now(system.node) if one.is_protected and not one.is_planned else None
            if cell is None or (one is not self._place and one.has_moved):  # That is another step's.
                continue
            if one not in self._certificates:
                from ...ftm.migration.protection import moved_certificates

                certificates = moved_certificates(cell, one.path)
                if certificates is None:
                    continue
                self._certificates[one] = certificates
            await self._certificates[one].prepare()

    async def _settle_certificates(self, *, is_moved: bool) -> None:
        """Have what is certified under the addresses where they are not be revoked.

        Raises:
            ControlFailed: of whom it could not.
        """
        failed = list[str]()
        for one, certificates in self._certificates.items():
            try:
                await certificates.settle(is_moved=is_moved)
            except HoldfastError as error:
                failed.append(f"{one.path}: {error}")
        if failed:
            why = "certificates under the addresses where its replicas are not could not be revoked"
            raise ControlFailed(self.target, self.verb, f"{why}: {'; '.join(failed)}")

    def _resting(self, system: ActorSystem) -> list[tuple[DraftPlace, Gated]]:
        """Those that run turns again, of the actor and all below it, and how each comes to rest."""
        for one in addressed(self._place):
            # Who is reworked rests for that, and is saved; replicas are only told.
            rests = not one.is_planned and (one.rework is None or one.is_protected)
            cell = one.now(system.node) if rests else None
            switch = switch_of(cell) if cell is not None else None
            runs_again = switch is not None and (switch.method.replays or one.is_protected)
            if runs_again and one not in self._rests:
                self._rests[one] = Gated(one, f"pause of {one.path}")
        return list(self._rests.items())

    def _unsteady(self, system: ActorSystem) -> str:
        """Why replicas that are to rest cannot hear of another address just now."""
        cells = [one.now(system.node) for one, _ in self._resting(system)]
        found = [cell.path for cell in cells if cell is not None and not cell.host.place.is_steady(cell)]
        return f"a replica of {found[0]} is being replaced" if found else ""

    def _others_settle(self, system: ActorSystem) -> str:
        """Why the others are not so far that addresses can change; they are asked for what is missing."""
        assert self._root is not None
        reworked = [place for place in self._root.walk() if place.rework is not None]  # They are saved at the commit.
        own = [place.now(system.node) for place in (*reworked, *(one for one, _ in self._resting(system)))]
        settled = {switch_of(cell) for cell in own if cell is not None}
        others = [switch for switch in system.homes if switch not in settled]
        settle_senders(others, self._asked)
        return WAITING if any(map(is_unsettled, others)) else ""

    @property
    def waits_for(self) -> str:
        lodging = "" if self._handing is None else self._handing.waits_for
        return lodging or next((rest.waits_for for rest in self._rests.values() if rest.waits_for), "")

    def ready(self, system: ActorSystem) -> str:
        place = self._place
        if self._handing is None or not place.has_moved:
            return ""
        assert place.was.below is not None
        old = place.was.below.living(system.node)
        if why := self._handing.ready(system) or (self._is_busy(old, place.name) if not is_elsewhere(old) else ""):
            return why
        if why := self._others_settle(system) or self._unsteady(system):
            return why
        for resting, rest in self._resting(system):
            switch = switch_of(resting.living(system.node))
            if not rest.is_waiting:
                return f"{resting.path} is not at rest"
            if switch is not None and switch.method.replays and not is_saved(switch):
                return f"the last snapshot of {resting.path} is not in the store yet"
        return ""

    def _is_busy(self, old: Cell, name: str) -> str:
        """Why a supervisor of this process cannot let its child go at this instant; "" if it can."""
        if why := busy(old):
            return why
        one = child_of(old, name)
        if one is None:
            raise wrong(old.path, f"it has no child {name!r} any more")
        if one.state not in (UP, STOPPED) or one.row is not None or one.up is not None:
            return f"{self.target} is being restarted"
        return ""

    def commit(self, system: ActorSystem) -> None:
        for rest in self._rests.values():
            rest.open()

    async def finish(self, system: ActorSystem) -> None:
        try:
            if self._handing is not None:
                await self._handing.finish(system)
            for rest in self._rests.values():
                if rest.task is not None:
                    with contextlib.suppress(HoldfastError):  # Its life has ended: the next one begins where it is now.
                        await asyncio.shield(rest.task)
        finally:
            await self._settle_certificates(is_moved=True)

    async def release(self, system: ActorSystem) -> None:
        try:
            for rest in self._rests.values():
                await rest.give_up()
            if self._handing is not None:
                await self._handing.release(system)
        finally:
            await self._settle_certificates(is_moved=False)


def addressed(place: DraftPlace) -> Iterator[DraftPlace]:
    """An actor and all below it, but the parts of mechanisms: these go with whom they protect."""
    yield place
    if not place.is_protected:
        for child in place.children.values():
            yield from addressed(child)


def check_movable(place: DraftPlace) -> None:
    """Whether an actor can have another address.

    Raises:
        SpecError: something that cannot be told knows it by its address.
    """
    cell, spec = place.cell, place.spec
    if place.is_supervisor and (
        (spec is not None and spec.isolation == "process") or (cell is not None and is_elsewhere(cell))
    ):
        raise wrong(place.path, "its process knows all below it by their addresses")
    method = spec.recovery if spec is not None else None
    if method is not None and method.replays and not method.snapshots:
        why = "it takes no snapshots, so all its turns would be repeated under another address"
        raise wrong(place.path, f"{why}: use hybrid(...)")


WAITING = "recorded actors may have to repeat what they sent to it: their snapshots are waited for"


def is_unsettled(switch: Switch) -> bool:
    """Whether what it has sent may be sent again, to be compared."""
    ledger, method = switch.ledger, switch.method
    if not (method.replays or method.snapshots):  # Protected, without recovery: only the turn in hand is made again.
        return bool(ledger.released)
    return ledger.has_sent


def is_saved(switch: Switch) -> bool:
    """Whether a replay would compare nothing: all that it has done is in its snapshot."""
    compared = any(turn.digests or turn.reply or turn.state for turn in switch.turns.values())
    return not (compared or switch.ledger.released or switch.images.is_saving)


def settle_senders(homes: Iterable[Switch], asked: dict[Switch, int]) -> None:
    """Have recorded actors take a snapshot, so that no replay sends to an address of before; each turn once."""
    for switch in homes:
        life = switch.life
        if is_unsettled(switch) and asked.get(switch) != switch.turn and life.port is not None and life.is_released:
            asked[switch] = switch.turn
            life.port.to_life(SnapshotNow(urgent=True))  # also if it is suspended
