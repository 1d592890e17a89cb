"""Moves a child to another supervisor: its life goes on, and only its address changes.

So does that of a supervisor, with all below it, if all its supervisors live in the root's process, and stay there. Else
another one takes its place (`succession.py`). Actors come to rest where a turn could be repeated under another address;
supervisors that begin anew stand down when all else is ready.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import ControlFailed, HoldfastError
from ...actors.kernel.ref import Target
from ...checkpoint.home.recorded_home import said_of_turn, switch_of
from ...supervision.children import STOPPED, UP
from .arrangement import busy, child_of
from .draft import Draft, DraftPlace, is_elsewhere
from .handing import UNKNOWN, Handing, check_handed, check_handing
from .living import OnSharedWork
from .operation import Operation, StagedWork, text_of, wrong
from .relocation import MOVED_WITHIN, Gated, Inhabited
from .senders import OtherSenders
from .structure import check_child, check_not_uniform
from .succession import Elsewhere, NewSupervisor, Succession, check_succession

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...checkpoint.home.switch import Switch
    from ...ftm.bricks.sealed_frames import MovedCertificates
    from ..system import ActorSystem

PATIENCE = 0.25
"""Seconds for which some stand still at first while others have not come to rest; it is doubled each time."""


class Reparent(OnSharedWork):
    """Put a child under another supervisor."""

    verb: ClassVar[str] = "move"

    def __init__(self, target: Target, supervisor: Target) -> None:
        super().__init__(target)
        self._to = supervisor
        self._above: DraftPlace | None = None  # the new supervisor, at this point

    @property
    def text(self) -> str:
        return f"move {self.target} to {self._above.path if self._above is not None else text_of(self._to)}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        new, old = await draft.supervisor(self._to), place.parent
        self.target = place.path
        if old is not None and old.is_supervisor and old.is_far:
            await draft.supervisor(old.path)  # It tells whom it has.
        place.know_spec()
        if place.spec is None and old is not None and old.is_supervisor and old.is_far:
            raise wrong(place.path, UNKNOWN)
        if old is None or not old.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it, so it cannot be moved to another")
        if new in place.walk():
            raise wrong(place.path, f"it cannot be moved below itself, to {new.path}")
        check_not_uniform(old)
        if any(one.place is place for one in draft.arrangement.successions):
            raise wrong(place.path, "it begins anew there by this very transaction: move it once")
        if old.is_far or new.is_far:
            check_handing(place, old, new)
        for above in new.upwards():
            if above.comes_last:
                raise wrong(
                    new.path, "it is started only when this transaction is in force: move to it in the next one"
                )
        if new.is_dynamic and place.is_stopped:
            raise wrong(place.path, f"it is stopped, and {new.path} is dynamic: it keeps nobody who does not run")
        anew: list[DraftPlace] = []
        if begins_anew(place, old, new):
            if place.name in new.was.children:
                why = f"it has a child {place.name!r} until this transaction is in force: use the next one"
                raise wrong(new.path, why)
            anew = await successors(draft, place, new, is_given=old.is_far or new.is_far)
        for one in addressed(place):
            check_movable(one)
        check_child(new, place.spec)
        del old.children[place.name]
        new.children[place.name], place.parent = place, new
        self._found, self._above = place, new
        if anew:
            work = self._work = Regrouping(place, draft)
            work.begin_anew(anew, Elsewhere(place), self)
        elif not (place.is_moved or place.is_planned):  # Who is added is started where it is to be.
            work = self._work = Regrouping(place, draft)
            work.hand(place)  # By the first step that moves it, to where the last one wants it.
        place.is_moved = True
        self.between_turns_of = (old, new)
        for holder in (old, new):
            draft.arrangement.touch(holder, self)


class Regrouping(StagedWork):
    """An actor, with all below it, that gets another supervisor, or whose own supervisors begin anew."""

    def __init__(self, top: DraftPlace, draft: Draft) -> None:
        self._top, self._draft = top, draft
        draft.arrangement.regrouped.append(top)
        self._senders = draft.arrangement.senders = draft.arrangement.senders or OtherSenders()
        self._kept_from_rest = ""  # what has kept it from coming to rest when that was tried last
        self._rests: dict[DraftPlace, Gated] = {}
        self._certificates: dict[DraftPlace, MovedCertificates] = {}
        self._handings: list[tuple[DraftPlace, Handing]] = []
        self._successions: list[Succession] = []  # from above
        self._candidate: NewSupervisor | None = None  # the uppermost supervisor that begins anew
        self._patience = PATIENCE  # seconds for which some stand still, while others have not come to rest yet

    def hand(self, place: DraftPlace) -> None:
        """Have this actor be given to the supervisor that it has in the draft in the end."""
        handing = self._draft.arrangement.handings[place] = Handing(place, self._draft.timeout)
        self._handings.append((place, handing))

    def begin_anew(self, places: Iterable[DraftPlace], candidate: NewSupervisor, step: Operation) -> None:
        """Have these supervisors begin anew, the uppermost as this candidate, and get all that are below them."""
        self._candidate = candidate
        for place in places:
            succession = Succession(place, self._draft)
            self._successions.append(succession)
            arrangement = self._draft.arrangement
            arrangement.successions.append(succession)
            for holder in (succession.left, place) if place.is_supervisor else ():
                arrangement.touch(holder, step)
            for child in place.children.values():
                if not (child.begins_anew or child.is_awaited or child.is_moved or child.is_idle):
                    self.hand(child)
                    child.is_moved = True

    async def prepare(self, system: ActorSystem) -> None:
        """Have recorded and protected actors rest: no turn of theirs is to be repeated under another address."""
        if not (self._candidate or self._moved):
            return
        for succession in self._successions:
            await succession.wind_down(system)
        if self._why_not_moved(system):
            await self._let_go(system)  # Whoever has stood down restarts nobody.
        if self._candidate is not None:
            await self._candidate.prepare(system)
        for _, handing in self._moved:
            await handing.prepare(system)
        await self._certify(system)
        others = self._others(system)
        self._senders.settle(others)
        standing = self._senders.find_standing(others, self._held(system))
        waits = self._senders.waits_for(one for one in others if one not in standing) or self._unsteady(system)
        self._kept_from_rest = waits
        if waits:  # Perhaps for what those here have to answer.
            self._senders.have_all_rest()
            await self._go_on(system)
        if waits or not await self._rest(system) or self._why_not_moved(system):
            await self._let_go(system)
            return
        for succession in self._successions:
            await succession.hold(system)

    async def _rest(self, system: ActorSystem) -> bool:
        """Have all of them come to rest: first those whose turn waits for something, while the others go on.

        Returns whether they are at rest.

        What a turn waits for goes on reaching it. It may be the answer, or a message, of somebody who is at rest
        already: nobody stands still for long while another one's turn has not ended.
        """
        loop, end, longest = system._node.loop, math.inf, max(MOVED_WITHIN, self._draft.timeout)
        while late := [(one, rest) for one, rest in self._coming_to_rest(system) if not rest.is_waiting]:
            await self._let_go(system)  # This may take long.
            waiting = [(one, rest) for one, rest in late if said_of_turn(one.living(system._node))]
            for one, rest in waiting or late:
                rest.aim(system, functools.partial(system._moves.pause, one.living(system._node), longest))
            stands_still = bool(self._senders.standing()) or any(rest.is_waiting for rest in self._rests.values())
            end = min(end, loop.time() + self._patience) if stands_still else math.inf
            if loop.time() >= end:
                await self._try_again_later(system)
                return False
            stirs = [future for _, rest in late for future in rest.stirs]
            within = max(0.0, end - loop.time()) if stands_still else None
            await asyncio.wait(stirs, timeout=within, return_when=asyncio.FIRST_COMPLETED)
        if any(has_begun(one.living(system._node)) for one, _ in self._coming_to_rest(system)):
            await self._try_again_later(system)
            return False
        return True

    async def _try_again_later(self, system: ActorSystem) -> None:
        """Let all of them go on, for as long as some have stood still."""
        self._senders.try_again_later()
        await self._go_on(system)
        await asyncio.sleep(self._patience)
        self._patience *= 2

    async def _go_on(self, system: ActorSystem) -> None:
        """Those at rest go on, and those that were to come to rest need not."""
        await asyncio.gather(self._senders.go_on(), *(rest.give_up() for _, rest in self._resting(system)))

    async def _let_go(self, system: ActorSystem) -> None:
        """Supervisors that have stood down go on."""
        for succession in self._successions:
            await succession.let_go(system)

    @property
    def _moved(self) -> list[tuple[DraftPlace, Handing]]:
        """Those of its actors that have another supervisor in the end, and how each is given to that."""
        return [(place, handing) for place, handing in self._handings if place.has_moved]

    def _why_not_moved(self, system: ActorSystem) -> str:
        """Why somebody cannot be given away at this instant; "" if everybody can."""
        if self._candidate is not None and (why := self._candidate.ready(system)):
            return why
        for place, handing in self._moved:
            assert place.was.below is not None
            old = place.was.below.living(system._node)
            if why := handing.ready(system) or ("" if is_elsewhere(old) else self._is_busy(old, place)):
                return why
        return ""

    async def _certify(self, system: ActorSystem) -> None:
        """Have those whose links are secured be certified where they go; requests flow meanwhile."""
        own = {self._top, *(place for place, _ in self._handings)}
        for one in addressed(self._top):
            cell = one.now(system._node) if one.is_protected and not one.is_planned else None
            if cell is None or cell.path == one.path or (one not in own and one.has_moved):  # That is another step's.
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
            raise ControlFailed(self._top.path, "move", f"{why}: {'; '.join(failed)}")

    def _is_readdressed(self, system: ActorSystem) -> bool:
        """Whether the actor, and so all below it, has another address from the commit on."""
        above = self._top.was.below
        return above is not None and f"{above.living(system._node).path}/{self._top.name}" != self._top.path

    def _why_not_readdressed(self, system: ActorSystem) -> str:
        """Why somebody cannot have another address at this instant; "" if everybody can."""
        for one in addressed(self._top) if self._is_readdressed(system) else ():
            cell = one.now(system._node)
            if cell is not None and system._moves.is_moving(cell):  # Its new process knows the address of before.
                return f"{cell.path} is on its way to live elsewhere"
        return ""

    def _resting(self, system: ActorSystem) -> list[tuple[DraftPlace, Gated]]:
        """Those that run turns again, of the actor and all below it, and how each comes to rest.

        Who keeps its address goes on meanwhile: a turn of it, which may wait for days, is repeated where it began.
        """
        own = {self._top, *(place for place, _ in self._handings)}
        for one in addressed_alone(self._top, own) if self._is_readdressed(system) else ():
            # Who is reworked rests for that, and is saved; replicas are only told.
            rests = not one.is_planned and (one.rework is None or one.is_protected)
            cell = one.now(system._node) if rests else None
            switch = switch_of(cell) if cell is not None else None
            runs_again = switch is not None and (switch.method.replays or one.is_protected)
            if runs_again and one not in self._rests:
                self._rests[one] = Gated(one, f"pause of {one.path}")
        return list(self._rests.items())

    def _coming_to_rest(self, system: ActorSystem) -> list[tuple[Inhabited, Gated]]:
        """Those of the actor and all below it that rest, and the senders that do."""
        return [*self._resting(system), *self._senders.standing()]

    def _unsteady(self, system: ActorSystem) -> str:
        """Why replicas that are to rest cannot hear of another address just now."""
        cells = [one.now(system._node) for one, _ in self._resting(system)]
        found = [cell.path for cell in cells if cell is not None and not cell.host.place.is_steady(cell)]
        return f"a replica of {found[0]} is being replaced" if found else ""

    def _others(self, system: ActorSystem) -> list[Switch]:
        """The homes of the others, if addresses change: what they have sent must not be sent again."""
        if not self._is_readdressed(system):
            return []
        # Those that are reworked are saved at the commit.
        reworked = [place for place in self._draft.places() if place.rework is not None]
        own = [place.now(system._node) for place in (*reworked, *(one for one, _ in self._resting(system)))]
        settled = {switch_of(cell) for cell in own if cell is not None}
        return [switch for switch in system._homes if switch not in settled]

    def _held(self, system: ActorSystem) -> set[Switch]:
        """The homes of those that steps hold: nobody else can."""
        regrouped = (one for top in self._draft.arrangement.regrouped for one in addressed(top))
        changed = (one for one in self._draft.places() if one.rework is not None or one.relocation is not None)
        cells = (one.now(system._node) for one in (*regrouped, *changed))
        return {switch for cell in cells if cell is not None and (switch := switch_of(cell)) is not None}

    @property
    def waits_for(self) -> str:
        lodgings, rests = (handing for _, handing in self._handings), self._rests.values()
        said = (*(one.waits_for for one in lodgings), *(one.waits_for for one in rests))
        return next(filter(None, said), "")

    def ready(self, system: ActorSystem) -> str:
        if not (self._candidate or self._moved):
            return ""
        if why := self._why_not_moved(system) or self._why_not_readdressed(system):
            return why
        others = self._others(system)
        self._senders.settle(others)
        if why := self._senders.waits_for(others) or self._unsteady(system):
            return why
        for resting, rest in self._resting(system):
            cell = resting.living(system._node)
            switch = switch_of(cell)
            if not rest.is_waiting:
                waits = f": {self._kept_from_rest}" if self._kept_from_rest else ""
                return f"{cell.path} is not at rest{waits}"
            if has_begun(cell):
                return f"{cell.path} is at rest before a turn that it has begun"
            if switch is not None and switch.method.replays and not is_saved(switch):
                return f"{cell.path} is at rest, and the snapshot that it takes there is not complete yet"
        return next((why for one in self._successions if (why := one.ready(system))), "")

    def _is_busy(self, old: Cell, place: DraftPlace) -> str:
        """Why a supervisor of this process cannot let its child go at this instant; "" if it can."""
        if why := busy(old):
            return why
        one = child_of(old, place.name)
        if one is None:
            raise wrong(old.path, f"it has no child {place.name!r} any more")
        if one.state not in (UP, STOPPED) or one.row is not None or one.up is not None:
            return f"{old.path}/{place.name} is being restarted"
        return ""

    def commit(self, system: ActorSystem) -> None:
        self._senders.open()
        for rest in self._rests.values():
            rest.open()

    async def finish(self, system: ActorSystem) -> None:
        try:
            await self._senders.gone_on()
            for _, handing in self._handings:
                await handing.finish(system)
            for rest in self._rests.values():
                if rest.task is not None:
                    with contextlib.suppress(HoldfastError):  # Its life has ended: the next one begins where it is now.
                        await asyncio.shield(rest.task)
        finally:
            await self._settle_certificates(is_moved=True)

    async def release(self, system: ActorSystem) -> None:
        """Let go of all of it, whatever of it cannot be let go of: that is told then."""
        problems: list[Exception] = []
        try:
            for works in (
                [succession.let_go(system) for succession in self._successions],
                [succession.give_up(system) for succession in self._successions],
                [self._senders.go_on(), *(rest.give_up() for rest in self._rests.values())],
                [handing.release(system) for _, handing in self._handings],
            ):
                done = await asyncio.gather(*works, return_exceptions=True)
                problems += [one for one in done if isinstance(one, Exception)]
        finally:
            try:
                if self._candidate is not None:
                    await self._candidate.release(system)
            finally:
                await self._settle_certificates(is_moved=False)
        for problem in problems:
            raise problem


def addressed(place: DraftPlace) -> Iterator[DraftPlace]:
    """An actor and all below it, but the parts of mechanisms: these go with whom they protect."""
    yield place
    if not place.is_protected:
        for child in place.children.values():
            yield from addressed(child)


def addressed_alone(place: DraftPlace, own: set[DraftPlace]) -> Iterator[DraftPlace]:
    """The same, without those that another step moves there, `own` being those that this one does."""
    if place in own or not place.has_moved:
        yield place
        for child in () if place.is_protected else place.children.values():
            yield from addressed_alone(child, own)


def check_movable(place: DraftPlace) -> None:
    """Whether an actor can have another address.

    Raises:
        SpecError: something that cannot be told knows it by its address.
    """
    method = place.spec.recovery if place.spec is not None else None
    if method is not None and method.replays and not method.snapshots:
        why = "it takes no snapshots, so all its turns would be repeated under another address"
        raise wrong(place.path, f"{why}: use hybrid(...)")


def begins_anew(place: DraftPlace, old: DraftPlace, new: DraftPlace) -> bool:
    """Whether another supervisor takes the place of this one, for some of it is in another process, or will be."""
    if not place.is_supervisor or place.is_planned:
        return False
    return old.is_far or new.is_far or any(one.is_supervisor and has_process(one) for one in addressed(place))


def has_process(place: DraftPlace) -> bool:
    """Whether a supervisor has a process of its own, or is below one that has."""
    cell, spec = place.cell, place.spec
    return (spec is not None and spec.isolation == "process") or (cell is not None and is_elsewhere(cell))


async def successors(draft: Draft, place: DraftPlace, new: DraftPlace, *, is_given: bool) -> list[DraftPlace]:
    """The supervisors at and below a place that begin anew, from above.

    Args:
        draft: as it is at this point.
        place: the uppermost.
        new: the supervisor below which all of it will be.
        is_given: whether any of them leaves a process, or comes to one.

    Raises:
        SpecError: they cannot, or somebody below them cannot be given to another supervisor.
    """
    if place.is_supervisor:
        await draft.supervisor(place.path)  # It tells whom it has.
    check_succession(place)
    found = [place]
    for child in list(place.children.values()):
        child.know_spec()
        if (is_given or place.is_far) and not child.is_awaited:
            check_handed(child, place, new)
        if child.begins_anew and not child.is_stopped:
            found += await successors(draft, child, new, is_given=is_given)
    return found


def is_saved(switch: Switch) -> bool:
    """Whether a replay would compare nothing: all that it has done is in its snapshot."""
    compared = any(turn.digests or turn.reply or turn.state for turn in switch.turns.values())
    return not (compared or switch.ledger.released or switch.images.is_saving)


def has_begun(cell: Cell) -> bool:
    """Whether an actor has a turn in hand that has let something out: one that rests may stand before it.

    Its last life had begun with it, and the turn was to be run again when the actor came to rest.
    """
    switch = switch_of(cell)
    return switch is not None and bool(switch.ledger.released)
