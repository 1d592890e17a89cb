"""What a system lets its user do to recorded actors: quarantine, and snapshots of several actors as one."""

from __future__ import annotations

from typing import Any

from ..actors.ref import ActorRef
from ..checkpoint.homes import Homes
from ..checkpoint.quarantine import QuarantinedMessage


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
