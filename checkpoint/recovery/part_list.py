"""The places below `/<system>/recovery`, in start order: one line for each part."""

from __future__ import annotations

from .checkpoint_handler import CheckpointHandler
from .controller import RecoveryController
from .message_handler import MessageHandler
from .part import RecoveryPart
from .switch_monitor import MessageSwitch

PARTS: tuple[tuple[str, type[RecoveryPart]], ...] = (
    ("controller", RecoveryController),
    ("switch", MessageSwitch),
    ("checkpoints", CheckpointHandler),
    ("messages", MessageHandler),
)
