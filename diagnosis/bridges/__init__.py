"""Bridges: what diagnosis finds goes to other systems, and what they have found comes in."""

from ...actors.events import NotDelivered
from .alert_app import AlertApp
from .alerts import ALERTS, AlertObserver, OutsideAlert
from .payload import WebhookAlert, WebhookPayload
from .ros_diagnostics import RosBridge
from .webhook import WebhookBridge

__all__ = [
    "ALERTS",
    "AlertApp",
    "AlertObserver",
    "NotDelivered",
    "OutsideAlert",
    "RosBridge",
    "WebhookAlert",
    "WebhookBridge",
    "WebhookPayload",
]
