"""Client, server and simulated board together, on the loopback; and the ways in which a board fails."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from urllib.parse import urlsplit
from zlib import crc32

import pytest

import holdfast as hf
from holdfast.diagnosis.board import (
    POWER_TOPIC,
    TOPIC,
    Board,
    BoardActor,
    BoardFailed,
    BoardLost,
    BoardMeasured,
    BoardRefused,
    BoardSilent,
    BoardSimulator,
    BoardState,
    BoardUnreachable,
    ChannelSwitched,
    ClearFaults,
    DelayReplies,
    DropConnections,
    GetBoard,
    GetSpecification,
    InjectFault,
    Load,
    Measurements,
    MuteBoard,
    NoSuchChannel,
    PowerCycle,
    SimulatedBoard,
    StuckChannel,
    SwitchChannel,
    WrongCurrent,
)
from holdfast.diagnosis.board import tcp_server as board_server
from holdfast.diagnosis.board.board_frames import (
    HEAD,
    AskMeasurements,
    AuthenticateFrame,
    BoardDecoder,
    Frame,
    RefusedFrame,
    SwitchFrame,
    encode,
)
from holdfast.testing import probe
from tests.cluster.certificates import certificates

BASE, PC = 0, 1
QUICK = hf.Backoff(initial=0.01, maximum=0.05, jitter=0.0)
LONG = 20.0  # seconds that nothing here takes, unless something is wrong


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


@pytest.fixture
def simulator(system: hf.ActorSystem) -> hf.ActorRef[BoardSimulator]:
    return system.spawn(hf.start(BoardSimulator), name="board")


async def state(simulator: hf.ActorRef[BoardSimulator]) -> BoardState:
    return await simulator.ask(GetBoard())


async def client(simulator: hf.ActorRef[BoardSimulator], *, timeout: float = LONG, broadcast: float = 0.0) -> Board:
    """A client for a block."""
    return Board((await state(simulator)).url, timeout=timeout, broadcast=broadcast, backoff=QUICK)


async def first(board: Board) -> Measurements:
    async with asyncio.timeout(LONG):
        return await anext(aiter(board.measurements()))


async def test_a_board_says_what_it_is(simulator: hf.ActorRef[BoardSimulator]) -> None:
    # D13, D14, D17: ten channels, seven used, and the PC on from the beginning.
    async with await client(simulator) as board:
        specification = await board.specification()
    names = [channel.name for channel in specification.channels]
    assert names[:7] == [
        "robot base",
        "PC",
        "sensor pan-tilt unit",
        "laser alignment",
        "thermal camera",
        "LRF",
        "Kinect",
    ]
    assert len(names) == 10
    assert specification.defaults == {PC}
    assert specification.channels[BASE].millivolts == 24_000


async def test_channels_are_switched_and_measured_one_by_one(simulator: hf.ActorRef[BoardSimulator]) -> None:
    # D13, D16
    async with await client(simulator) as board:
        before = await board.measure()
        await board.switch(BASE, True)
        await board.switch(PC, False)
        after = await board.measure()
    assert [reading.on for reading in before.channels] == [False, True, *[False] * 8]
    assert [reading.on for reading in after.channels] == [True, *[False] * 9]
    assert before.channels[BASE].milliamperes == before.channels[BASE].millivolts == 0
    # At first it draws more than in the long run.
    assert 3_000 < after.channels[BASE].milliamperes < 8_000
    assert 22_000 < after.channels[BASE].millivolts < 24_000
    assert after.uptime_milliseconds >= before.uptime_milliseconds
    assert (await state(simulator)).on == {BASE}


async def test_measurements_are_broadcast_until_they_are_not_wanted(simulator: hf.ActorRef[BoardSimulator]) -> None:
    # D16
    async with await client(simulator) as board:
        await board.broadcast(0.01)
        uptimes = [(await first(board)).uptime_milliseconds for _ in range(3)]
        assert uptimes == sorted(set(uptimes))
        await board.broadcast(0)
        await board.measure()  # What was under way has come by now.
        waiting = asyncio.ensure_future(first(board))
        done, _ = await asyncio.wait((waiting,), timeout=0.1)  # Ten would have come.
        assert not done
        waiting.cancel()
        await asyncio.wait((waiting,))


async def test_default_channels_are_on_after_the_board_s_own_power_up(
    simulator: hf.ActorRef[BoardSimulator],
) -> None:
    # D17
    async with await client(simulator) as board:
        await board.set_defaults({PC, 5})
        await board.switch(BASE, True)
        assert (await state(simulator)).on == {BASE, PC}
        simulator.tell(PowerCycle())
        assert (await state(simulator)).on == {PC, 5}
        assert (await asked_again(board)).channels[5].on
        assert (await board.specification()).defaults == {PC, 5}


async def asked_again(board: Board) -> Measurements:
    """Ask until there is an answer; a connection may be lost before that is noticed."""
    async with asyncio.timeout(LONG):
        while True:
            try:
                return await board.measure()
            except (BoardLost, BoardUnreachable):
                await board.connected()


@pytest.mark.parametrize(("channel", "interval"), [(10, 1.0), (-1, 1.0), (0, 0.001), (0, 4000.0)])
async def test_what_no_board_can_do_is_refused(
    simulator: hf.ActorRef[BoardSimulator], channel: int, interval: float
) -> None:
    async with await client(simulator) as board:
        with pytest.raises(BoardRefused):
            await (board.switch(channel, True) if interval == 1.0 else board.broadcast(interval))
        await board.measure()


async def test_a_stuck_channel_is_acknowledged_and_does_not_change(simulator: hf.ActorRef[BoardSimulator]) -> None:
    await simulator.ask(InjectFault(StuckChannel(BASE)))
    async with await client(simulator) as board:
        await board.switch(BASE, True)
        assert not (await board.measure()).channels[BASE].on
        await simulator.ask(ClearFaults())
        await board.switch(BASE, True)
        assert (await board.measure()).channels[BASE].on


async def test_a_wrong_current_is_what_is_measured(simulator: hf.ActorRef[BoardSimulator]) -> None:
    async with await client(simulator) as board:
        for wrong, measured in ((7, 7), (10**12, 2**31 - 1)):
            await simulator.ask(InjectFault(WrongCurrent(PC, wrong)))
            assert (await board.measure()).channels[PC].milliamperes == measured


async def test_a_fault_of_no_channel_is_refused(simulator: hf.ActorRef[BoardSimulator]) -> None:
    with pytest.raises(NoSuchChannel):
        await simulator.ask(InjectFault(StuckChannel(10)))


async def test_a_request_under_way_when_the_connection_is_cut_is_lost(
    simulator: hf.ActorRef[BoardSimulator],
) -> None:
    async with await client(simulator) as board:
        await board.measure()
        await simulator.ask(InjectFault(MuteBoard()))
        asked = asyncio.ensure_future(board.switch(BASE, True))
        async with asyncio.timeout(LONG):
            while BASE not in (await state(simulator)).on:
                await asyncio.sleep(0.001)
        await simulator.ask(InjectFault(DropConnections()))
        with pytest.raises(BoardLost):
            await asked
        await simulator.ask(ClearFaults())
        # It has been done all the same, and the connection comes back by itself.
        assert (await asked_again(board)).channels[BASE].on


async def test_broadcasts_come_again_over_a_new_connection(simulator: hf.ActorRef[BoardSimulator]) -> None:
    async with await client(simulator, broadcast=0.01) as board:
        await first(board)
        await simulator.ask(InjectFault(DropConnections(0.1)))
        async with asyncio.timeout(LONG):
            while board.is_connected:
                await asyncio.sleep(0.001)
        await first(board)
        assert board.is_connected


async def test_a_late_answer_is_silence_and_disturbs_nobody(simulator: hf.ActorRef[BoardSimulator]) -> None:
    async with await client(simulator, timeout=0.2) as board:
        await board.connected(LONG)
        await simulator.ask(InjectFault(DelayReplies(0.3)))
        with pytest.raises(BoardSilent, match=r"within 0\.2 s"):
            await board.switch(BASE, True)
        await simulator.ask(ClearFaults())
        async with asyncio.timeout(LONG):
            while True:
                try:
                    measured = await board.measure()
                    break
                except BoardSilent:
                    pass
        assert measured.channels[BASE].on


async def test_a_board_that_has_fallen_silent_is_given_a_new_connection(
    simulator: hf.ActorRef[BoardSimulator],
) -> None:
    async with await client(simulator, timeout=0.05) as board:
        await board.connected(LONG)
        await simulator.ask(InjectFault(MuteBoard()))
        for _ in range(3):
            with pytest.raises(BoardSilent):
                await board.measure()
        async with asyncio.timeout(LONG):
            while board.is_connected:
                await asyncio.sleep(0.001)
            await board.connected(LONG)


async def test_no_board_is_said_in_time_and_nothing_is_sent() -> None:
    with pytest.raises(BoardUnreachable, match="nothing was sent"):
        async with Board("tcp://127.0.0.1:1", timeout=0.05, backoff=QUICK) as board:
            await board.switch(BASE, True)


async def test_who_waits_when_the_client_closes_is_let_go(simulator: hf.ActorRef[BoardSimulator]) -> None:
    async with await client(simulator) as board:
        await board.connected()
        await simulator.ask(InjectFault(MuteBoard()))
        asked = asyncio.ensure_future(board.measure())
        watching = asyncio.ensure_future(anext(aiter(board.measurements()), None))
        while not board._watchers or not board._waiting:
            await asyncio.sleep(0)
    with pytest.raises(BoardLost):
        await asked
    assert await watching is None
    with pytest.raises(BoardUnreachable, match="closed"):
        await board.measure()


@pytest.mark.parametrize("url", ["http://127.0.0.1:80", "tcp://127.0.0.1", "tcp://:80", "127.0.0.1:80", "tcp://a:1/x"])
def test_an_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="tcp://host:port"):
        Board(url)


async def spoken_to(simulator: hf.ActorRef[BoardSimulator], *pieces: bytes) -> tuple[list[tuple[int, Frame]], bool]:
    """What a board says to bytes, and whether it ends the connection."""
    host, port = (await state(simulator)).url.removeprefix("tcp://").split(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    try:
        async with asyncio.timeout(LONG):
            for piece in pieces:
                writer.write(piece)
                await writer.drain()
            decoder, heard = BoardDecoder(), list[tuple[int, Frame]]()
            while data := await reader.read(4096):
                decoder.feed(data)
                while (taken := decoder.take()) is not None:
                    heard.append(taken)
                if heard and heard[-1][0] == 99:
                    return heard, False
            return heard, True
    finally:
        writer.close()
        await writer.wait_closed()


async def test_a_bad_frame_is_refused_and_the_connection_lives(simulator: hf.ActorRef[BoardSimulator]) -> None:
    wrong = bytearray(encode(5, SwitchFrame(9, True)))
    wrong[HEAD.size] = 10
    wrong[-4:] = crc32(wrong[:-4]).to_bytes(4, "big")
    heard, is_over = await spoken_to(
        simulator, bytes(wrong), encode(6, RefusedFrame("no")), encode(99, AskMeasurements())
    )
    assert not is_over
    assert heard[0] == (5, RefusedFrame("there is no channel 10: they are 0 to 9"))
    assert heard[1] == (6, RefusedFrame("RefusedFrame is for a board to say"))
    assert isinstance(heard[2][1], Measurements)


async def test_noise_is_refused_and_ends_only_its_own_connection(simulator: hf.ActorRef[BoardSimulator]) -> None:
    async with await client(simulator) as board:
        await board.measure()
        heard, is_over = await spoken_to(simulator, b"GET / HTTP/1.1\r\n\r\n")
        assert is_over
        assert heard == [(0, RefusedFrame("it does not begin as one"))]
        await board.measure()


async def test_a_frame_that_never_ends_is_not_waited_for(
    simulator: hf.ActorRef[BoardSimulator], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_server, "PATIENCE", 0.05)
    assert await spoken_to(simulator, encode(1, AskMeasurements())[:5]) == ([], True)


async def test_too_many_clients_are_told_so(
    simulator: hf.ActorRef[BoardSimulator], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_server, "MOST_CLIENTS", 1)
    async with await client(simulator, broadcast=0.05) as board:
        await board.measure()
        assert await spoken_to(simulator) == ([(0, RefusedFrame("there are 1 connections already"))], True)
        await board.measure()


async def test_silent_clients_give_their_seats_to_those_who_come(simulator: hf.ActorRef[BoardSimulator]) -> None:
    where = urlsplit((await state(simulator)).url)
    silent = [await asyncio.open_connection(where.hostname, where.port) for _ in range(board_server.MOST_CLIENTS)]
    try:
        async with await client(simulator) as board:
            await board.measure()
        async with asyncio.timeout(LONG):
            with contextlib.suppress(ConnectionResetError):
                assert await silent[0][0].read() == b""
    finally:
        for _, writer in silent:
            writer.close()


async def test_without_the_token_nothing_is_done(system: hf.ActorSystem) -> None:
    guarded = system.spawn(hf.start(BoardSimulator, token="sesame"))
    url = (await state(guarded)).url
    async with Board(url, timeout=LONG, backoff=QUICK) as board:
        with pytest.raises(BoardRefused, match="say the token first"):
            await board.switch(BASE, True)
    assert BASE not in (await state(guarded)).on
    async with Board(url, timeout=LONG, backoff=QUICK, token="sesame", broadcast=0.01) as board:
        await board.switch(BASE, True)
        await first(board)
    assert BASE in (await state(guarded)).on
    guess = encode(3, AuthenticateFrame("guess"))
    assert await spoken_to(guarded, guess) == ([(0, RefusedFrame("this is not the token"))], True)


async def test_a_board_is_spoken_to_by_tls_and_only_if_it_is_who_it_should_be(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    ours, theirs = certificates(tmp_path / "board"), certificates(tmp_path / "client")
    files = {"certificate": ours.certificate, "key": ours.key, "ca": theirs.ca}
    start = hf.start(BoardSimulator, token="sesame", **files)  # type: ignore[arg-type]  # all of them are texts
    guarded = system.spawn(start)
    url = (await state(guarded)).url
    assert url.startswith("tls://127.0.0.1:")
    options = {"timeout": LONG, "backoff": QUICK, "token": "sesame"}
    own = {"certificate": theirs.certificate, "key": theirs.key}
    async with Board(url, **options, ca=ours.ca, **own) as board:  # type: ignore[arg-type]  # each of its own type
        await board.switch(BASE, True)
    assert BASE in (await state(guarded)).on
    quick = {**options, "timeout": 1.0}
    async with Board(url, **quick, ca=theirs.ca, **own) as board:  # type: ignore[arg-type]  # each of its own type
        with pytest.raises(BoardUnreachable, match="certificate verify failed"):
            await board.switch(BASE, False)
    async with Board(url, **quick, ca=ours.ca) as board:  # type: ignore[arg-type]  # each of its own type
        with pytest.raises((BoardUnreachable, BoardLost, BoardSilent)):
            await board.switch(BASE, False)
    plain = url.replace("tls:", "tcp:")
    async with Board(plain, **quick) as board:  # type: ignore[arg-type]  # each of its own type
        with pytest.raises((BoardUnreachable, BoardLost, BoardSilent)):
            await board.switch(BASE, False)
    assert BASE in (await state(guarded)).on


@pytest.mark.parametrize(
    "make",
    [
        lambda **options: Board("tcp://10.0.0.7:1", token="sesame", **options),
        lambda **options: board_server.BoardServer(
            SimulatedBoard((), clock=lambda: 0.0), "10.0.0.7", token="sesame", **options
        ),
    ],
    ids=["client", "board"],
)
def test_a_token_does_not_go_over_a_network_in_clear(make: Callable[..., object]) -> None:
    with pytest.raises(ValueError, match=r"the token would go over the network to 10\.0\.0\.7 in clear"):
        make()
    make(insecure=True)


@pytest.mark.parametrize(
    ("files", "said"), [({"certificate": "c"}, "belong together"), ({"ca": "none"}, "cannot be read")]
)
def test_certificates_that_cannot_be_used_are_refused(files: dict[str, str], said: str) -> None:
    with pytest.raises(hf.SpecError, match=said):
        Board("tls://127.0.0.1:1", **files)  # type: ignore[arg-type]  # files, and nothing else


async def test_a_killed_simulator_hangs_up(system: hf.ActorSystem, simulator: hf.ActorRef[BoardSimulator]) -> None:
    async with await client(simulator) as board:
        await board.measure()
        simulator.kill()
        async with asyncio.timeout(LONG):
            while board.is_connected:
                await asyncio.sleep(0.001)


async def test_simulated_devices_hear_of_their_power(system: hf.ActorSystem) -> None:
    devices = probe(system)
    devices.subscribe(POWER_TOPIC)
    loads = (Load("jaguar"), Load("hokuyo"))
    simulator = system.spawn(hf.start(BoardSimulator, loads, defaults=(1,)), name="board")
    async with await client(simulator) as board:
        await board.switch(0, True)
        await board.switch(0, True)
        await board.switch(1, False)
        await board.measure()
    for said in (
        ChannelSwitched(1, "hokuyo", True),
        ChannelSwitched(0, "jaguar", True),
        ChannelSwitched(1, "hokuyo", False),
    ):
        assert (await devices.expect(ChannelSwitched)) == said


async def test_measurements_are_a_topic(system: hf.ActorSystem, simulator: hf.ActorRef[BoardSimulator]) -> None:
    # D12: any other observer can use them.
    observer = probe(system)
    observer.subscribe(TOPIC)
    url = (await state(simulator)).url
    actor = system.spawn(hf.start(BoardActor, url, interval=0.01, timeout=LONG), name="link")
    assert (await actor.ask(GetSpecification(), timeout=LONG)).defaults == {PC}
    await actor.ask(SwitchChannel(BASE, True), timeout=LONG)
    async with asyncio.timeout(LONG):
        while not (await observer.expect(BoardMeasured)).measurements.channels[BASE].on:
            pass
    with pytest.raises(BoardFailed) as raised:
        await actor.ask(SwitchChannel(10, True))
    assert raised.value.kind == "BoardRefused"


async def test_a_board_that_is_not_there_crashes_no_actor(system: hf.ActorSystem) -> None:
    actor = system.spawn(hf.start(BoardActor, "tcp://127.0.0.1:1", timeout=0.05), name="link")
    with pytest.raises(BoardFailed) as raised:
        await actor.ask(SwitchChannel(BASE, True), timeout=LONG)
    assert raised.value.kind == "BoardUnreachable"
    actor.kill()
