"""Fault-tolerance mechanisms, which are inserted, exchanged and composed while requests flow."""

from .bricks.brick_messages import Done, Work
from .bricks.bricks import After, Before, Brick, Proceed
from .group.protected import ProtectionStatus
from .mechanisms.ad import AD
from .mechanisms.lfr import LFR
from .mechanisms.nvp import NVP
from .mechanisms.pbr import PBR
from .mechanisms.rb import RB
from .mechanisms.sec import SEC
from .mechanisms.tmr import TMR
from .mechanisms.tr import TR
from .model.detection import Detection
from .model.mechanism import Mechanism, Role, compose

__all__ = [
    "AD",
    "After",
    "Before",
    "Brick",
    "Detection",
    "Done",
    "LFR",
    "Mechanism",
    "NVP",
    "PBR",
    "Proceed",
    "ProtectionStatus",
    "RB",
    "Role",
    "SEC",
    "TMR",
    "TR",
    "Work",
    "compose",
]
