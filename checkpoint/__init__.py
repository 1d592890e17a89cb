"""Crash recovery: snapshots, journals, stores and replay."""

from .home.quarantine import QuarantinedMessage
from .recovery_file import RecoveryFile, load_recovery
from .recovery_settings import Held, RecoveryHooks, RecoveryStep, SafeState, held, recovery_hooks, safe_state

__all__ = [
    "Held",
    "QuarantinedMessage",
    "RecoveryFile",
    "RecoveryHooks",
    "RecoveryStep",
    "SafeState",
    "held",
    "load_recovery",
    "recovery_hooks",
    "safe_state",
]
