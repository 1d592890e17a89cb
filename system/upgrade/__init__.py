"""Looking at recorded turns with the code of a program: the check of an upgrade, and the replay of one actor.

Both work with a copy of the store. Nothing of the program gets out: see `checkpoint/store_tools/rerun.py`.
"""

from __future__ import annotations

from ...checkpoint.store_tools.upgrade_check import AddressCheck
from .checked_upgrade import UpgradeCheck, check_upgrade
from .replayed_actor import ReplayedState, ReplayedTurn, replay_actor

__all__ = ["AddressCheck", "ReplayedState", "ReplayedTurn", "UpgradeCheck", "check_upgrade", "replay_actor"]
