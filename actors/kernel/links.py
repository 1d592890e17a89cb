"""Links and monitors by Erlang's rules: who is told of an end, and what it does to them.

A link is two-sided, and of two lives: any end but `NORMAL` ends the other side with the same reason, unless that one
traps exits. Between two lives nobody is there to be linked with, so that no life has a link of the one before it; only
a life that goes on where the last one was, by a recovery, keeps its links. A monitor is one-sided and only informs: of
one life (`monitor`; between two lives of the next), or of the address (`watch`: once, when it is gone for good).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from ..events import EndedByLink
from ..exit_reasons import NOPROC, NORMAL, ExitReason
from ..values.saved_refs import OneOfItsKind
from .envelope import LEAVE, Item

if TYPE_CHECKING:
    from .cell import Cell


MADE_UP_NAME: Final = "$"
"""How the names begin of actors that were given none."""


class Monitor(OneOfItsKind):
    """A handle on one watch over another actor, from `ctx.monitor` or `ctx.watch`, for the actor that watches.

    An actor with recovery may keep it in its state.
    """

    __slots__ = ()

    def cancel(self) -> None:
        """Cancel the monitor: no DOWN arrives after this, not even one that is queued already."""
        raise NotImplementedError


class LifeMonitor(Monitor):
    """One watch of `target` by `watcher`."""

    __slots__ = ("active", "for_good", "life", "name", "target", "watcher")

    def __init__(self, watcher: Cell, target: Cell, for_good: bool, name: str = "") -> None:
        self.watcher, self.target, self.for_good = watcher, target, for_good
        self.name = name or target.path  # the address that the watcher knows, also if the target has moved
        self.active = True
        self.life = watcher.life  # a watch ends with the life that set it

    def cancel(self) -> None:
        self.active = False
        target = self.target
        self.forget()
        if target.more is not None and self in target.more.ties.monitors:
            target.more.ties.monitors.remove(self)
            target.host.told(target, "demonitor", {"watcher": self.watcher.path, "for_good": self.for_good})

    def forget(self) -> None:
        """Forget the monitor: its DOWN has been told, or is not wanted any more."""
        if self.watcher.more is not None:
            self.watcher.more.ties.watching.pop(self, None)


class Ties:
    """What binds the actors of an address to others: links, who watches them, and whom they watch or have ordered."""

    __slots__ = ("links", "monitors", "ordered", "watching")

    def __init__(self) -> None:
        self.links: dict[Cell, str] = {}  # and the address that each is known by here, also if it has moved
        self.monitors: list[LifeMonitor] = []
        self.watching: dict[LifeMonitor, None] = {}
        self.ordered: dict[str, None] = {}  # addresses to which it has given orders


def monitor(watcher: Cell, target: Cell, *, for_good: bool, name: str = "") -> LifeMonitor:
    """Start a watch; if nobody lives there, DOWN with NOPROC comes at once. `name`: the address that was given."""
    watch = LifeMonitor(watcher, target, for_good, name)
    if target.is_dead:
        watcher.push(Down(watch, NOPROC, recovering=False))
    else:
        note_watch(watch)
        target.host.told(target, "monitor", {"watcher": watcher.path, "for_good": for_good})
    return watch


def has_missed(watch: LifeMonitor) -> None:
    """The life that was watched is over, though the actor lives: its watcher is told so now."""
    target = watch.target
    if watch.for_good or not watch.active or target.more is None or watch not in target.more.ties.monitors:
        return  # It is told already, or is not to be told.
    reason = target.more.reason
    recovering = target.host.recovers(reason)
    if not recovering:
        drop_watch(watch)
    watch.watcher.push(Down(watch, reason, recovering))


def note_watch(watch: LifeMonitor) -> LifeMonitor:
    """Have a watch here that is kept on the other side of a border already: nobody is told of it."""
    watch.target.extra().ties.monitors.append(watch)
    watch.watcher.extra().ties.watching[watch] = None
    return watch


def drop_watch(watch: LifeMonitor) -> None:
    """A watch is kept on the other side of a border alone from now on: nobody is told of that."""
    watch.forget()
    watch.target.extra().ties.monitors.remove(watch)


def hand_over(old: Cell, new: Cell) -> set[str]:
    """The actor at `new` takes the place of that at `old`: who is tied to the old one is tied to the new one.

    Nobody hears of an end. What the old one watches is not watched any more. Returns the addresses by which the other
    process in which the new one lives knows the old one: those ties are to be handed over there too, and only there.
    """
    known: set[str] = set()
    if old.more is None or not old.more.has_more:
        return known
    ties, its = old.more.ties, new.extra().ties
    for peer, name in ties.links.items():
        theirs = peer.extra().ties.links
        called = theirs.pop(old, new.path)
        if _are_elsewhere_together(peer, new):
            known.add(called)
            continue
        its.links[peer], theirs[new] = name, called
        new.host.told(new, "link", {"peer": peer.path})
    for watch in ties.monitors:
        if _are_elsewhere_together(watch.watcher, new):
            known.add(watch.name)
            watch.forget()
            continue
        watch.target = new
        its.monitors.append(watch)
        new.host.told(new, "monitor", {"watcher": watch.watcher.path, "for_good": watch.for_good})
    ties.links, ties.monitors = {}, []
    for watch in list(ties.watching):
        watch.cancel()
    return known


def _are_elsewhere_together(one: Cell, other: Cell) -> bool:
    return one.host is other.host and not one.host.place.is_here


def demonitor(watcher: Cell, target: Cell, *, for_good: bool) -> None:
    """Cancel one such watch, whichever: they are alike."""
    for watch in target.more.ties.monitors if target.more is not None else ():
        if watch.watcher is watcher and watch.for_good is for_good:
            watch.cancel()
            return


def link(one: Cell, other: Cell, name: str = "") -> None:
    """Link two lives; at most one link per pair. `name`: the address of the other that was given.

    If nobody lives there now, EXIT with NOPROC comes at once, also if another life will begin there.
    """
    if one is other:
        return
    if other.has_nobody:
        one.push(Exit(other, NOPROC, name))
        return
    one.extra().ties.links[other] = name or other.path
    other.extra().ties.links[one] = one.path
    other.host.told(other, "link", {"peer": one.path})


def unlink(one: Cell, other: Cell) -> None:
    """Remove the link; no EXIT from it arrives afterwards, not even one that is queued already."""
    if sever(one, other):
        other.host.told(other, "unlink", {"peer": one.path})
    for item in one.queue or ():
        if type(item) is Exit and item.source is other:
            item.active = False


def sever(one: Cell, other: Cell) -> bool:
    """Forget the link on both sides. Returns whether there was one."""
    found = False
    for cell, peer in ((one, other), (other, one)):
        if cell.more is not None and peer in cell.more.ties.links:
            del cell.more.ties.links[peer]
            found = True
    return found


def announce(cell: Cell, reason: ExitReason, *, recovering: bool) -> None:
    """A life has ended: EXIT over its links, DOWN to its monitors."""
    more = cell.more
    if more is None or not more.has_more:
        return
    ties = more.ties
    if not recovering:
        tell_linked(cell, reason)
    if ties.monitors:
        stay: list[LifeMonitor] = []
        for watch in ties.monitors:
            if watch.for_good:
                stay.append(watch)
            else:
                watch.watcher.push(Down(watch, reason, recovering))
                if recovering:
                    stay.append(watch)
                else:
                    watch.forget()
        ties.monitors = stay


def tell_linked(cell: Cell, reason: ExitReason) -> None:
    """The links of a life end with it: EXIT to whoever lives at the other ends."""
    more = cell.more
    if more is None or not more.has_more or not more.ties.links:
        return
    peers, more.ties.links = more.ties.links, {}
    for peer in peers:
        name = peer.more.ties.links.pop(cell, "") if peer.more is not None else ""
        if name and not peer.awaits_first_life:
            peer.push(Exit(cell, reason, name))


def gone(cell: Cell, reason: ExitReason) -> None:
    """The address is gone for good: tell who watches it."""
    more = cell.more
    if more is None or not more.has_more:
        return
    ties = more.ties
    watchers = [watch for watch in ties.monitors if watch.for_good]
    ties.monitors = [watch for watch in ties.monitors if not watch.for_good]
    for watch in watchers:
        watch.forget()
        watch.watcher.push(Down(watch, reason, recovering=False))


def down_arrived(
    watcher: Cell, target: Cell, reason: ExitReason, *, recovering: bool, for_good: bool, is_carried: bool = False
) -> None:
    """A DOWN came from another process: it belongs to the oldest such watch that is still wanted.

    One that is carried behind an actor that moves is told also if its watch is not known here: that was over before.
    """
    monitors: list[LifeMonitor] = target.more.ties.monitors if target.more is not None else []
    for watch in monitors:
        if watch.watcher is watcher and watch.for_good is for_good:
            monitors.remove(watch)
            if recovering:
                monitors.append(watch)  # Behind those like it: each gets its own DOWN.
            else:
                watch.forget()
            watcher.push(Down(watch, reason, recovering))
            return
    if is_carried:
        watcher.push(Down(LifeMonitor(watcher, target, for_good), reason, recovering))


class Exit(Item):
    """An EXIT signal over a link, in its place after earlier messages."""

    __slots__ = ("active", "is_carried", "name", "reason", "source")

    def __init__(self, source: Cell, reason: ExitReason, name: str = "") -> None:
        self.source, self.reason = source, reason
        self.name = name or source.path  # the address that it is known by where this goes
        self.active = True
        self.is_carried = False  # it waited while the actor moved: the tie is over, and not known where it lives now

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        cell: Cell = actor.ctx._cell
        if not item.active:
            return None
        if cell.more is not None and cell.more.trap_exits:
            return actor.on_exit(item.source.ref, item.reason)
        if item.reason == NORMAL:
            return None
        from . import lifecycle

        if cell.node.events.has_listeners:
            cell.node.emit(EndedByLink(cell.path, item.name, item.reason))
        lifecycle.finish(cell, item.reason, is_orderly=False)
        return LEAVE

    def hook(self) -> str:
        return "on_exit"


class Down(Item):
    """Tells a monitoring actor that the life it watched is over."""

    __slots__ = ("is_carried", "reason", "recovering", "watch")

    def __init__(self, watch: LifeMonitor, reason: ExitReason, recovering: bool) -> None:
        self.watch, self.reason, self.recovering = watch, reason, recovering
        self.is_carried = False  # as of an EXIT

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        if not item.watch.active or item.watch.life != actor.ctx.life:
            return None
        return actor.on_down(item.watch.target.ref, item.reason, item.recovering)

    def hook(self) -> str:
        return "on_down"
