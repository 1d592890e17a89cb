"""The places below `/<system>/recovery`, in start order: one line for each part."""

from __future__ import annotations

from .controller import RecoveryController
from .handler import MessageHandler
from .part import Part

PARTS: tuple[tuple[str, type[Part]], ...] = (
    ("controller", RecoveryController),
    ("message_handler", MessageHandler),
)
