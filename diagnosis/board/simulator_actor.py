"""A board as an actor: it serves the real protocol on the loopback, and fails as a board does, when told to."""

from __future__ import annotations

import asyncio
from typing import TypeAlias

from ...actors.kernel.actor import Actor, on
from ...actors.kernel.message import Message, Refusal, RuntimeCall
from .board_frames import CHANNELS
from .board_tls import server_tls
from .simulated_board import ROBOT, Load, SimulatedBoard
from .tcp_server import BoardServer

POWER_TOPIC = "/board_power"
"""Where the simulator says that a channel has gone on or off, for simulated devices that hang on it."""


class ChannelSwitched(Message):
    """A channel has gone on or off; on `/board_power`."""

    channel: int
    name: str
    on: bool


class StuckChannel(Message, tag=True):
    """The channel stays as it is, whatever is acknowledged."""

    channel: int


class WrongCurrent(Message, tag=True):
    """The channel draws this, whatever hangs on it."""

    channel: int
    milliamperes: int


class DropConnections(Message, tag=True):
    """All connections are cut now, and for some seconds new ones too."""

    seconds: float = 0.0


class DelayReplies(Message, tag=True):
    """Each answer comes so many seconds late."""

    seconds: float


class MuteBoard(Message, tag=True):
    """It hears, and says nothing."""


Fault: TypeAlias = StuckChannel | WrongCurrent | DropConnections | DelayReplies | MuteBoard


class NoSuchChannel(Refusal, text="the board has no channel {channel}: channels are 0 to 9"):
    """Channels are 0 to 9."""

    channel: int


class InjectFault(RuntimeCall):
    """From now on the board has this fault too."""

    fault: Fault


class ClearFaults(Message):
    """It has no fault any more; channels stay as they are."""


class PowerCycle(RuntimeCall):
    """Its own power goes and comes: connections end, and its default channels are on."""


class BoardState(Message):
    """Where it listens, and which channels truly have power."""

    url: str
    on: frozenset[int]


class GetBoard(Message[BoardState]):
    """Where is it, and what is on?"""


class _Hear(Message):
    """New connections are taken again."""

    number: int


class _Switched(Message):
    channel: int
    on: bool


class BoardSimulator(Actor):
    """A simulated board that listens on `host`.

    Args:
        loads: what hangs on its channels; by default the paper's robot.
        defaults: channels that are on after its power-up; by default the PC.
        port: 0 is any that is free; `GetBoard` tells which.
        token, insecure: see `BoardServer`.
        certificate, key: files with which connections are encrypted; None: they are not.
        ca: a file with the certificates of who signs those of clients, who then need one.
    """

    deterministic = False

    def __init__(
        self,
        loads: tuple[Load, ...] = ROBOT,
        *,
        defaults: tuple[int, ...] = (1,),
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        certificate: str | None = None,
        key: str | None = None,
        ca: str | None = None,
        insecure: bool = False,
    ) -> None:
        self._token, self._insecure = token, insecure
        self._tls = server_tls(certificate, key, ca) if certificate is not None and key is not None else None
        self._loads, self._defaults, self._host, self._port = loads, defaults, host, port
        self._refusals = 0

    async def on_start(self, restored: bool) -> None:
        """Power up, and listen. Raises OSError: the address cannot be had."""
        self._board = SimulatedBoard(
            self._loads,
            defaults=self._defaults,
            clock=asyncio.get_running_loop().time,
            rng=self.ctx.random,
            changed=self._changed,
        )
        self._server = BoardServer(
            self._board, self._host, self._port, self._token, tls=self._tls, insecure=self._insecure
        )
        listens: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.ctx.create_task(self._listen(listens))
        await listens

    async def _listen(self, listens: asyncio.Future[None]) -> None:
        """Until the life ends; as a task of it, it also ends when the actor is killed."""
        try:
            try:
                await self._server.start()
            except OSError as error:
                listens.set_exception(error)
                return
            listens.set_result(None)
            await asyncio.get_running_loop().create_future()
        finally:
            await self._server.close()

    def _changed(self, channel: int, on: bool) -> None:
        """Called by connections too, which end a moment after the life."""
        if not self.ctx._closed:
            self.ctx.ref.tell(_Switched(channel, on))

    @on(_Switched)
    async def _tell_devices(self, message: _Switched) -> None:
        name = self._board.loads[message.channel].name
        await self.ctx.publish(POWER_TOPIC, ChannelSwitched(message.channel, name, message.on))

    @on(GetBoard)
    def _state(self, message: GetBoard) -> BoardState:
        return BoardState(self._server.url, self._board.on)

    @on(InjectFault)
    def _inject(self, message: InjectFault) -> None:
        match message.fault:
            case StuckChannel(channel):
                self._board.stuck.add(_known(channel))
            case WrongCurrent(channel, milliamperes):
                self._board.wrong[_known(channel)] = milliamperes
            case DelayReplies(seconds):
                self._server.delay = seconds
            case MuteBoard():
                self._server.is_mute = True
            case DropConnections(seconds):
                self._refusals += 1
                self._server.drop()
                if seconds:
                    self._server.is_deaf = True
                    self.ctx.tell_after(seconds, _Hear(self._refusals))

    @on(_Hear)
    def _hear(self, message: _Hear) -> None:
        if message.number == self._refusals:
            self._server.is_deaf = False

    @on(ClearFaults)
    def _clear(self, message: ClearFaults) -> None:
        self._board.stuck.clear()
        self._board.wrong.clear()
        self._server.delay = 0.0
        self._server.is_mute = self._server.is_deaf = False

    @on(PowerCycle)
    def _power_cycle(self, message: PowerCycle) -> None:
        self._server.drop()
        self._board.power_cycle()


def _known(channel: int) -> int:
    if not 0 <= channel < CHANNELS:
        raise NoSuchChannel(channel=channel)
    return channel
