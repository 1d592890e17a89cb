"""A system's methods for recorded actors: quarantine, erasing, backups, and group snapshots."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..actors.errors import ControlFailed, HoldfastError, SpecError
from ..actors.kernel import lifecycle
from ..actors.kernel.cell import DOWN
from ..actors.kernel.ref import ActorRef, Target
from ..actors.seconds import check_seconds
from ..checkpoint.home.disposal import Erased
from ..checkpoint.home.homes import Homes
from ..checkpoint.home.quarantine import QuarantinedMessage
from ..cluster.lines.lines import Lines, PeerLook
from ..supervision.admin import RestartChild, TerminateChild, WhichChildren
from ..supervision.children import STOPPED
from ..supervision.supervisor import Supervisor, listed_at

if TYPE_CHECKING:
    from ..checkpoint.store_tools import StoreCopy


class Recorded:
    """Control of what the homes keep."""

    _homes: Homes
    """All recorded addresses, for those who change the tree."""
    _lines: Lines
    """The lines to other systems."""

    def quarantined(self, actor: Target | None = None) -> list[QuarantinedMessage]:
        """Messages put aside because they have ended their actor's process again and again, oldest first.

        They survive a restart of the root if the actor's journal does.

        Args:
            actor: only those of this actor, given by ref or path.
        """
        path = actor.path if isinstance(actor, ActorRef) else actor
        return self._homes.quarantine.messages(path)

    def retry(self, message: QuarantinedMessage) -> None:
        """Have a quarantined message handled as if it had come now. (Whoever asked has got `Quarantined` long ago.)

        Raises:
            NotQuarantined: it was tried again, dropped or erased meanwhile. NoSuchActor: its actor was not started yet.
        """
        self._homes.quarantine.retry(message, self._homes.at(message.address))

    def drop(self, message: QuarantinedMessage) -> None:
        """Forget a quarantined message; it becomes a dead letter.

        Raises:
            NotQuarantined: it was tried again, dropped or erased meanwhile.
        """
        self._homes.quarantine.drop(message)

    def connected(self) -> list[PeerLook]:
        """The programs that are connected to this system, and systems that were, with what is kept for each."""
        return self._lines.peers()

    async def drop_kept(self, system: str) -> int:
        """Drop what recorded actors have told another system that has not accepted it, and forget that system.

        The messages become dead letters. The system may connect again.

        Args:
            system: its name, the first part of its addresses.

        Returns:
            how many messages were kept for it, once the store has it that they are no more.

        Raises:
            SpecError: no system of that name was ever connected. StoreError: the store does not take it.
        """
        if system not in {one.system for one in self._lines.peers()}:
            raise SpecError(system, "no system of that name was ever connected: `holdfast connections` lists who was")
        dropped = self._lines.forget_system(system)
        await self._homes.journal.safe()
        return dropped

    async def erase(self, target: Target, *, dry_run: bool = False) -> Erased:
        """Forget everything that was recorded at an address, where nobody lives now, and below it.

        That is the state and the messages that wait, timers, asks that were not answered, what is in quarantine,
        children that a supervisor would bring back, what transactions have made of mechanisms and specs, group
        snapshots with one of these actors, and the history. It does not matter whether anybody was started there since
        the program began. It is done a few addresses at a time, while the system goes on: whoever is started there
        meanwhile waits. If the program is killed in the middle of it, the next one goes on with it; so it does if
        whoever waits for this is cancelled. Not forgotten is what others have in their own states and messages.

        The bytes may stay in the files until `holdfast store compact`, and in copies: `holdfast store erase` does the
        same in one.

        Args:
            target: the address, or a ref; that of a supervisor means all that was recorded below it, too.
            dry_run: only count what would be forgotten.

        Returns:
            what was forgotten; nothing, if nothing was recorded there.

        Raises:
            ControlFailed: somebody lives there, or is being started or stopped: stop it first; or who lived there was
                moved. SpecError: it is no address of this system, or of a part of a mechanism.
            StoreError: the store refused; what is left is erased when it is asked for again, or the store is opened.
        """
        path, homes = target.path if isinstance(target, ActorRef) else target, self._homes
        if not isinstance(path, str) or not path.startswith(f"/{homes.node.name}/") or path.endswith("/"):
            raise SpecError("erase", f"takes an address below /{homes.node.name}, or a ref, not {target!r}")
        if dry_run:
            return homes.erasures.counted(path)
        await self._vacated(path)
        now = homes.addresses.now(path)
        if now != path and not homes.has_recorded(path):
            raise ControlFailed(path, "erase", f"who lived there was moved to {now}: erase that")
        erased = await asyncio.shield(homes.erasures.erase(path, everything=True))
        await homes.synced()
        await homes.journal.safe()
        return erased

    async def _vacated(self, path: str) -> None:
        """See to it that nobody lives at an address, nor is about to, nor below it.

        Raises:
            ControlFailed: somebody does. SpecError: it is a part of a mechanism.
        """
        node = self._homes.node
        names, above = path.split("/")[2:], f"/{node.name}"
        for place, name in enumerate(names):
            here, cell = f"{above}/{name}", node.cell_at(above)
            listed = listed_at(cell)
            if listed is None:
                children = await ActorRef[Supervisor](cell).ask(WhichChildren())
                found = next(((one.state, one.is_supervisor) for one in children if one.id == name), None)
            else:
                one = listed.get(name)
                found = None if one is None else (one.state, one.spec.is_supervisor)
            is_last = place == len(names) - 1
            if found is None or found[0] == STOPPED:
                other = (cell.children or {}).get(name)  # Without a supervisor, or what is left of a child.
                if other is not None and other.state is not DOWN:
                    raise ControlFailed(path, "erase", f"{here} lives: stop it first")
                if other is not None and is_last:
                    lifecycle.retire(other, "what was recorded of it is erased")
                return
            if is_last:
                raise ControlFailed(path, "erase", f"it is {found[0]}: stop it first")
            if not found[1]:
                raise SpecError(path, f"{here} is no supervisor: erase what was recorded of it with itself")
            above = here

    async def backup(self, path: str | os.PathLike[str]) -> StoreCopy:
        """Copy the store of this system as it is now, while the system goes on; a thread does it.

        All that was acknowledged before the call is in the copy, which is a store of its own: `holdfast store restore`
        brings it back. That of an encrypted store is encrypted with the same key. Cancelling does not end the thread:
        the copy is then finished all the same.

        Args:
            path: the database of the copy. Neither it nor anything of a store may be there; its folder must be.

        Raises:
            SpecError: the system has no store of the form "sqlite:PATH". NotCopied: there is something at `path`, or no
                room. StoreError: the store cannot be read, or is damaged.
        """
        from ..checkpoint.store_tools import back_up_store  # only now: sqlite3 takes a while to import

        file = self._homes.journal.engine.file
        if file is None:
            raise SpecError("backup", "needs a system with a store on the disk: store='sqlite:PATH'")
        return await asyncio.to_thread(back_up_store, file.path, path, key=file.key)

    async def checkpoint_group(self, actors: Sequence[Target], *, name: str) -> None:
        """Keep one consistent cut of several recorded actors: their states, and the messages between them (R78).

        It takes the place of an older one of that name. With a store it is kept over restarts of the root, and as safe
        as its `durability` says when this returns.

        Args:
            actors: refs or paths.
            name: of the snapshot.

        Raises:
            SpecError: there is no actor, or no name. HoldfastError: one of them is not recorded, or the store refused.
        """
        homes = self._homes
        paths = list(dict.fromkeys(actor.path if isinstance(actor, ActorRef) else actor for actor in actors))
        if not paths or not isinstance(name, str) or not name:
            raise SpecError("checkpoint_group", f"needs actors and a name, not {paths} and {name!r}")
        homes.groups.take(name, paths)
        await homes.synced()

    def group_snapshots(self) -> list[str]:
        """The names of the group snapshots there are, oldest first."""
        return self._homes.groups.names()

    async def forget_group(self, name: str) -> None:
        """Remove a group snapshot, which takes as much room as the states of its actors do.

        Raises:
            NoSuchGroup: there is none of that name. HoldfastError: the store refused.
        """
        self._homes.groups.forget(name)
        await self._homes.synced()

    async def restore_group(self, name: str, *, timeout: float = 60.0) -> None:
        """Bring all actors of a group snapshot back to it, with the messages that were under way between them.

        They are stopped and started again in the order of their supervisors; messages to them meanwhile, and all that
        they did since the cut, do not count: asks that wait fail with ActorStopped. What they have sent to others since
        is not called back.

        Raises:
            NoSuchGroup: there is none of that name. HoldfastError: an actor could not be stopped or started by its
                supervisor (the others are started all the same), or the store refused.
        """
        check_seconds("restore_group", "timeout", timeout)
        groups = self._homes.groups
        members = groups.members(name)
        living: list[tuple[ActorRef[Supervisor], str]] = []
        for path in await self._in_start_order([path for path in members if self._is_living(path)], timeout):
            above, _, child = path.rpartition("/")
            living.append((ActorRef[Supervisor](self._homes.node.cell_at(above)), child))
        for supervisor, child in reversed(living):
            await supervisor.ask(TerminateChild(child), timeout)
        groups.replace(name)
        groups.wait(members)
        problems: list[HoldfastError] = []
        try:
            for supervisor, child in living:
                try:
                    await supervisor.ask(RestartChild(child), timeout)
                except HoldfastError as error:
                    problems.append(error)
        finally:
            groups.let_go(members)
        if problems:
            raise problems[0]

    def _is_living(self, path: str) -> bool:
        """Whether it has to be stopped; else whoever starts it finds it as it was."""
        home = self._homes.at(path)
        return home is not None and home.cell is not None and not home.cell.is_dead

    async def _in_start_order(self, paths: Sequence[str], timeout: float) -> list[str]:
        """As their supervisors would start them: a binding wants its target to be there."""
        places: dict[str, int] = {}
        for above in dict.fromkeys(above for path in paths for above in _ancestors(path)):
            supervisor = ActorRef[Supervisor](self._homes.node.cell_at(above))
            children = await supervisor.ask(WhichChildren(), timeout)
            places.update((child.path, place) for place, child in enumerate(children))
        return sorted(paths, key=lambda path: [places[one] for one in (*_ancestors(path)[1:], path)])


def _ancestors(path: str) -> list[str]:
    """The addresses above one, from the root down.

    >>> _ancestors("/app/lab/cell")
    ['/app', '/app/lab']
    """
    names = path.split("/")
    return ["/".join(names[:length]) for length in range(2, len(names))]
