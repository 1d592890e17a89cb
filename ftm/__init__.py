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
from .model.application import Application
from .model.change_model import FaultClasses, Resources, recovery_price, resource_price, response_price, select
from .model.detection import Detection
from .model.mechanism import Mechanism, Role, compose
from .monitoring.judge import Readings, Settings
from .monitoring.monitor import Measured, MonitoringEngine, Observe
from .monitoring.watched import watch_of

__all__ = [
    "AD",
    "After",
    "Application",
    "Before",
    "Brick",
    "Detection",
    "Done",
    "FaultClasses",
    "LFR",
    "Measured",
    "Mechanism",
    "MonitoringEngine",
    "NVP",
    "Observe",
    "PBR",
    "Proceed",
    "ProtectionStatus",
    "RB",
    "Readings",
    "Resources",
    "Role",
    "SEC",
    "Settings",
    "TMR",
    "TR",
    "Work",
    "compose",
    "recovery_price",
    "resource_price",
    "response_price",
    "select",
    "watch_of",
]
