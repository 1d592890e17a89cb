"""The options of a system, checked before anything is started."""

from __future__ import annotations

import dataclasses
import os
from typing import Final, Literal, TypeAlias, get_args

from ..actors.errors import SpecError
from ..actors.loop_watchdog import check_limits
from ..actors.values.path_parts import check_path_part
from ..checkpoint.journal import Journal
from ..checkpoint.method import Durability
from ..checkpoint.recovery_file import RecoveryFile, load_recovery
from ..checkpoint.recovery_settings import RecoveryHooks
from ..checkpoint.store_key import StoreKey
from ..checkpoint.store_opening import check_durability, check_store_key
from ..cluster.configuration import NatsSettings, read_configuration
from ..cluster.joining import is_replicated
from ..cluster.leadership import Standby
from ..cluster.lines.inflow import ConnectionLimits
from ..cluster.servers import Servers
from ..supervision.spec import Flags

ProgramRole: TypeAlias = Literal["waiting", "standby", "leader", "alone"]
"""What a program is to its system.

It is being started, or waits for the servers of its store; another program leads, and it waits; it leads, of several;
or it is the only one there can be.
"""

CONFIGURED: Final = "configured"
"""The store that `holdfast.toml` and the environment name."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class SystemOptions:
    """The arguments of an `ActorSystem`, whose docstring says what each of them means.

    Raises:
        SpecError: the system has no name, or something else than what it takes.
    """

    name: str
    store: str | Journal | Servers | None
    store_key: StoreKey | None = dataclasses.field(repr=False)
    durability: Durability | None
    standby: Standby | None
    reachable: str | Servers | None
    connection_limits: ConnectionLimits
    nats: NatsSettings
    flags: Flags
    preload: tuple[str, ...]
    log: bool
    log_payloads: bool
    history: bool
    seed: int | None
    takeover: bool
    watch_lag: float | None
    watch_turns: float | None
    watch_waits: float | None
    recovery_hooks: RecoveryHooks | None
    recovery: str | os.PathLike[str] | RecoveryFile | None

    def __post_init__(self) -> None:
        check_path_part("ActorSystem", "the name", self.name)
        if not isinstance(self.store, Servers):
            check_durability(self.store, self.durability)
            check_store_key(self.store, self.store_key)
        if self.standby is not None:
            if self.standby not in get_args(Standby):
                known = ", ".join(map(repr, get_args(Standby)))
                raise SpecError("ActorSystem", f"standby must be one of {known} or left out, not {self.standby!r}")
            if not is_replicated(self.store):
                problem = f"standby={self.standby!r} needs a store that several machines keep: store='nats://HOST/NAME'"
                raise SpecError("ActorSystem", problem)
        limits: object = self.connection_limits
        if not isinstance(limits, ConnectionLimits):
            raise SpecError("ActorSystem", f"connection_limits must be a ConnectionLimits, not {limits!r}")
        hooks = self.recovery_hooks
        if hooks is not None and not isinstance(hooks, RecoveryHooks):
            raise SpecError("ActorSystem", f"recovery_hooks must come from recovery_hooks(...), not be {hooks!r}")
        check_limits(watch_lag=self.watch_lag, watch_turns=self.watch_turns, watch_waits=self.watch_waits)

    @property
    def reached_at(self) -> str | Servers | None:
        """Where other programs find the system, if they do."""
        store = self.store
        if self.reachable is None and (isinstance(store, Servers) or (isinstance(store, str) and is_replicated(store))):
            return store
        return self.reachable

    @staticmethod
    def configured(
        store: str | Journal | Servers | None, standby: Standby | None, durability: Durability | None
    ) -> tuple[str | Journal | Servers | None, Standby | None, Durability | None, NatsSettings]:
        """The arguments, and what `holdfast.toml` and the environment say where the store is "configured".

        Raises:
            SpecError: they name no store, or cannot be read.
        """
        if store != CONFIGURED:
            return store, standby, durability, NatsSettings()
        found = read_configuration().under(store=None, standby=standby, durability=durability)
        if found.store is None:
            problem = f"store={CONFIGURED!r}, and no store is configured: write store = '...' into holdfast.toml"
            raise SpecError("ActorSystem", f"{problem}, or set HOLDFAST_STORE")
        return found.store, found.standby, found.durability, found.nats

    def read_recovery_file(self) -> RecoveryFile | None:
        """The recovery file, read now if only its path was given.

        Raises:
            SpecError: it cannot be used, or is another system's.
        """
        given = self.recovery
        file = given if isinstance(given, RecoveryFile) or given is None else load_recovery(given)
        if file is not None:
            file.check(self.name)
        return file
