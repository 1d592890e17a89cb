"""The power board: ten channels that are switched and measured one by one, over TCP.

`Board` is the client, for a real board and for the simulated one alike; `BoardSimulator` is an actor that is a board,
with faults to order; `BoardActor` publishes what a board measures as `/board_measurements`. The frames are in
`board_frames.py`.

Source: Zaman et al. 2013, section IV-A (figure 4).
"""

from .board_actor import TOPIC, BoardActor, BoardFailed, BoardMeasured, GetSpecification, SwitchChannel
from .board_frames import CHANNELS, BadBoardFrame, ChannelSpecification, Measurements, Reading, Specification
from .client import Board, BoardError, BoardLost, BoardRefused, BoardSilent, BoardUnreachable
from .simulated_board import Load, SimulatedBoard
from .simulator_actor import (
    POWER_TOPIC,
    BoardSimulator,
    BoardState,
    ChannelSwitched,
    ClearFaults,
    DelayReplies,
    DropConnections,
    GetBoard,
    InjectFault,
    MuteBoard,
    NoSuchChannel,
    PowerCycle,
    StuckChannel,
    WrongCurrent,
)
from .tcp_server import BoardServer, Device

__all__ = [
    "BadBoardFrame",
    "Board",
    "BoardActor",
    "BoardError",
    "BoardFailed",
    "BoardLost",
    "BoardMeasured",
    "BoardRefused",
    "BoardServer",
    "BoardSilent",
    "BoardSimulator",
    "BoardState",
    "BoardUnreachable",
    "CHANNELS",
    "ChannelSpecification",
    "ChannelSwitched",
    "ClearFaults",
    "DelayReplies",
    "Device",
    "DropConnections",
    "GetBoard",
    "GetSpecification",
    "InjectFault",
    "Load",
    "Measurements",
    "MuteBoard",
    "NoSuchChannel",
    "POWER_TOPIC",
    "PowerCycle",
    "Reading",
    "SimulatedBoard",
    "Specification",
    "StuckChannel",
    "SwitchChannel",
    "TOPIC",
    "WrongCurrent",
]
