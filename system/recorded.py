"""What a system lets its user do to recorded actors: quarantine, and snapshots of several actors as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..actors.ref import ActorRef
from ..checkpoint.homes import Homes
from ..checkpoint.quarantine import QuarantinedMessage
from ..supervision.admin import RestartChild, TerminateChild
from ..supervision.supervisor import Supervisor


class Recorded:
    """Control of what the homes keep."""

    @property
    def homes(self) -> Homes:
        """All recorded addresses, for those who change the tree."""
        raise NotImplementedError

    def quarantined(self, actor: ActorRef[Any] | str | None = None) -> list[QuarantinedMessage]:
        """Messages put aside because they have ended their actor's process again and again, oldest first.

        They survive a restart of the root if the actor's journal does.

        Args:
            actor: only those of this actor, given by ref or path.
        """
        path = actor.path if isinstance(actor, ActorRef) else actor
        return self.homes.quarantine.messages(path)

    def retry(self, message: QuarantinedMessage) -> None:
        """Have a quarantined message handled as if it had come now. (Whoever asked has got `Quarantined` long ago.)

        Raises:
            NotQuarantined: it was tried again, dropped or erased meanwhile. NoSuchActor: its actor was not started yet.
        """
        self.homes.quarantine.retry(message, self.homes.at(message.address))

    def drop(self, message: QuarantinedMessage) -> None:
        """Forget a quarantined message; it becomes a dead letter.

        Raises:
            NotQuarantined: it was tried again, dropped or erased meanwhile.
        """
        self.homes.quarantine.drop(message)

    async def checkpoint_group(self, actors: Sequence[ActorRef[Any]], *, name: str) -> None:
        """Keep one consistent cut of several recorded actors: their states, and the messages between them (R78).

        It takes the place of an older one of that name. With a store it is kept over restarts of the root, and as safe
        as its `durability` says when this returns.

        Raises:
            HoldfastError: one of them is not recorded, or the store refused.
        """
        homes = self.homes
        homes.groups.take(name, [actor.path for actor in actors])
        await homes.synced()

    def group_snapshots(self) -> list[str]:
        """The names of the group snapshots there are, oldest first."""
        return self.homes.groups.names()

    async def forget_group(self, name: str) -> None:
        """Remove a group snapshot, which takes as much room as the states of its actors do.

        Raises:
            NoSuchGroup: there is none of that name. HoldfastError: the store refused.
        """
        self.homes.groups.forget(name)
        await self.homes.synced()

    async def restore_group(self, name: str, *, timeout: float = 60.0) -> None:
        """Bring all actors of a group snapshot back to it, with the messages that were under way between them.

        They are stopped, last named first, and started again, first named first; messages to them meanwhile, and all
        that they did since the cut, do not count: asks that wait fail with ActorStopped. What they have sent to others
        since is not called back.

        Raises:
            NoSuchGroup: there is none of that name. HoldfastError: an actor could not be stopped or started by its
                supervisor, or the store refused.
        """
        groups = self.homes.groups
        living: list[tuple[ActorRef[Supervisor], str]] = []
        for path in groups.members(name):
            home = self.homes.at(path)
            cell = None if home is None else home.cell
            if cell is None or cell.is_dead:
                continue  # Whoever starts it finds it as it was.
            above, _, child = path.rpartition("/")
            living.append((ActorRef[Supervisor](cell.node.cell_at(above)), child))
        for supervisor, child in reversed(living):
            await supervisor.ask(TerminateChild(child), timeout)
        groups.replace(name)
        members = groups.members(name)
        groups.wait(members)
        try:
            for supervisor, child in living:
                await supervisor.ask(RestartChild(child), timeout)
        finally:
            groups.let_go(members)
