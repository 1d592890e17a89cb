"""Snapshots of several actors as one: a cut that could have been, and the way back to it (R78).

Chandy and Lamport send a marker along each channel, so that each process saves its state and what was under way to it.
Here all channels end in homes of one process, and a turn's outputs are at the homes of their receivers in the very step
that ends it: one marker for all homes, taken between two steps of the root's loop, is such a cut. What each home has
then (snapshot, turns since, messages that wait) is the actor's state and its channels; asks under way are kept too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError
from ..addresses import is_at
from ..journal import Entry, Saved
from .snapshot_record import FORMAT, Meta, outlasting

if TYPE_CHECKING:
    from ..home.homes import Homes
    from ..home.switch import Switch

RESTORING = "restoring group"
"""The fact that names the group whose homes are being replaced."""


class NoSuchGroup(HoldfastError, text="there is no group snapshot {name!r}; checkpoint_group() makes one"):
    """No snapshot of a group has this name."""

    name: str


class HomeImage(msgspec.Struct, array_like=True, frozen=True):
    """One home at the cut."""

    path: str
    meta: bytes
    entries: list[list[Any]]


class GroupSnapshot(msgspec.Struct, array_like=True, frozen=True):
    """The homes of a group at one cut."""

    format: int
    time: float
    images: list[HomeImage]


class Groups:
    """The group snapshots of a root."""

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
        self._waiting: set[str] = set()  # who waits for the others of a group that is restored
        unfinished = homes.journal.noted(RESTORING)
        if unfinished is not None:  # This process's predecessor died in the middle of it.
            self.replace(unfinished.decode())

    # -- the cut ----------------------------------------------------------------------------------------------------

    def take(self, name: str, paths: Sequence[str]) -> None:
        """Keep one cut of these homes under a name.

        Raises:
            HoldfastError: one of them is not recorded, or the store refused.
        """
        homes = [self._recorded(path) for path in paths]
        group = GroupSnapshot(FORMAT, self._homes.node.clock.wall(), [_image(home) for home in homes])
        self._homes.journal.note(_key(name), msgspec.msgpack.encode(group))

    def _recorded(self, path: str) -> Switch:
        home = self._homes.at(path)
        if home is None:
            raise HoldfastError(f"{path} is not recorded: only actors with recovery=hybrid(...) can be in a group")
        if not home.method.replays:
            raise HoldfastError(f"{path} replays nothing: only actors with recovery=hybrid(...) can be in a group")
        return home

    # -- the way back -----------------------------------------------------------------------------------------------

    def members(self, name: str) -> list[str]:
        """The addresses in a group snapshot.

        Raises:
            NoSuchGroup: there is none of that name.
        """
        return [image.path for image in self._group(name).images]  # as they are now

    def names(self) -> list[str]:
        """The group snapshots there are, oldest first."""
        return [key.removeprefix(_key("")) for key in self._homes.journal.notes(_key(""))]

    def forget(self, name: str) -> None:
        """Remove a group snapshot.

        Raises:
            NoSuchGroup: there is none of that name. HoldfastError: the store refused.
        """
        if self._homes.journal.noted(_key(name)) is None:
            raise NoSuchGroup(name)
        self._homes.journal.note(_key(name), None)

    def forget_below(self, top: str, dry_run: bool = False) -> int:
        """Remove the group snapshots with a member at an address or below it: how many that were, or (`dry_run`) are.

        Raises:
            HoldfastError: the store refused.
        """
        meant = [name for name in self.names() if any(is_at(path, top) for path in self.members(name))]
        for name in [] if dry_run else meant:
            self.forget(name)
        return len(meant)

    def replace(self, name: str) -> None:
        """Have the next lives at its addresses begin at the cut. Nobody may live there now.

        Raises:
            NoSuchGroup: there is none of that name. HoldfastError: the store refused; what is left to do is done when
                it is opened again.
        """
        group, journal = self._group(name), self._homes.journal
        journal.note(RESTORING, name.encode())
        for image in group.images:
            self._homes.vacate(image.path, "its group goes back to an earlier snapshot")
        for image in group.images:
            meta = msgspec.msgpack.decode(image.meta, type=Meta)
            meta = msgspec.structs.replace(meta, time=self._homes.node.clock.wall())  # Its timers have stood still.
            entries: list[Entry] = [
                tuple(tuple(part) if isinstance(part, list) else part for part in entry) for entry in image.entries
            ]
            if journal.durable:
                old = [position for position, _ in journal.load(image.path).entries]
                fresh = msgspec.structs.replace(meta, epoch=journal.epoch)
                journal.cut(image.path, msgspec.msgpack.encode(fresh), old, turn=meta.turn, keep=1)
                if entries:
                    journal.append([(image.path, entry) for entry in entries])
            self._homes.planted[image.path] = Saved(
                msgspec.msgpack.encode(meta), meta.turn, list(enumerate(entries, 1))
            )
        journal.note(RESTORING, None)

    def _group(self, name: str) -> GroupSnapshot:
        data = self._homes.journal.noted(_key(name))
        if data is None:
            raise NoSuchGroup(name)
        group = msgspec.msgpack.decode(data, type=GroupSnapshot)
        now = self._homes.addresses.now
        images = [msgspec.structs.replace(image, path=now(image.path)) for image in group.images]
        return msgspec.structs.replace(group, images=images)

    def wait(self, paths: Iterable[str]) -> None:
        """From now on these homes hold what waits, until `let_go`: what they publish would find nobody."""
        self._waiting.update(paths)

    def let_go(self, paths: Iterable[str]) -> None:
        """All of them are there, or will not come."""
        for path in paths:
            self._waiting.discard(path)
            home = self._homes.at(path)
            if home is None or not home.life.is_kept_back:
                continue
            home.life.is_kept_back = False
            if home.life.is_ready:  # Else it lets itself go when it is live.
                home.let_at()

    def opened(self, home: Switch) -> None:
        """A home has its next cell: it holds what waits while its group is restored."""
        home.life.is_kept_back = home.path in self._waiting


def _key(name: str) -> str:
    return f"group {name}"


def _image(home: Switch) -> HomeImage:
    """What its store would have of it, if the root died now."""
    timers, topics = outlasting(home)
    newest = home.ledger.newest or Meta(FORMAT, -1, 0, [], {}, [], home.journal.epoch, b"")
    state = newest.state
    if newest.blocks:  # They are removed when later snapshots do not need them: a group has its own copy.
        state = b"".join(part.data for part in home.images.restore(newest.blocks))
    meta = msgspec.structs.replace(
        newest,
        format=FORMAT,
        next_id=home.ledger.next_id,
        timers=timers,
        topics=topics,
        state=state,
        blocks=[],
        earlier=[],
        owed=home.calls.debts(),
        ties=home.ties.saved(home.ledger.turn + 1),
        claims={key: clock for key, clock in home.timers.at(newest).items() if key not in timers},
        made=msgspec.structs.replace(newest.made, shapes=home.shapes.as_now()),
    )
    return HomeImage(home.path, msgspec.msgpack.encode(meta), [list(entry) for entry in home.ledger.entries()])
