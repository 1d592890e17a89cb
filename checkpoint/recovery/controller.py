"""The recovery controller as an actor: it follows each recovery through its phases."""

from __future__ import annotations

from .part import Part


class RecoveryController(Part):
    """Follows each recovery from the crash to the release."""
