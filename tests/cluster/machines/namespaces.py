"""A network of machines that are network namespaces of this one: it can be cut between any two of them, each way.

Each machine has an address of its own, and a link to a hub, which passes packets on. The hub alone cuts: it drops what
one machine sends to another, and nobody is told, as on a broken network. It needs root, and iproute2.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
from collections.abc import Generator, Iterable
from pathlib import Path

NAMES = Path("/run/netns")
NEW_NET = 0x40000000
"""CLONE_NEWNET of `setns`."""
WHY_NOT = (
    "" if os.geteuid() == 0 and shutil.which("ip") is not None else "network namespaces need root and the command ip"
)
"""Why there can be none here; empty if there can."""


class Network:
    """Machines and the hub between them. Whoever makes it closes it.

    Args:
        machines: what they are called.
    """

    def __init__(self, machines: Iterable[str]) -> None:
        drop_left_behind()
        self.hub = f"hf{os.getpid()}-hub"
        self._numbers = {machine: number for number, machine in enumerate(machines, 1)}
        self._cut: set[tuple[str, str]] = set()
        made = [self.hub, *map(self.namespace, self._numbers)]
        try:
            for name in made:
                _ip("netns", "add", name)
                _ip("-n", name, "link", "set", "lo", "up")
            self._in_hub("sysctl", "-qw", "net.ipv4.ip_forward=1")
            for machine, number in self._numbers.items():
                own, there = self.namespace(machine), f"m{number}"
                _ip("-n", self.hub, "link", "add", there, "type", "veth", "peer", "name", "eth", "netns", own)
                _ip("-n", self.hub, "addr", "add", f"10.77.{number}.1/30", "dev", there)
                _ip("-n", self.hub, "link", "set", there, "up")
                _ip("-n", own, "addr", "add", f"{self.address(machine)}/30", "dev", "eth")
                _ip("-n", own, "link", "set", "eth", "up")
                _ip("-n", own, "route", "add", "default", "via", f"10.77.{number}.1")
        except BaseException:
            self.close()
            raise

    @property
    def addresses(self) -> list[str]:
        """The addresses of all machines."""
        return [self.address(machine) for machine in self._numbers]

    def namespace(self, machine: str) -> str:
        """The name of a machine's network namespace."""
        return f"hf{os.getpid()}-{machine}"

    def address(self, machine: str) -> str:
        """The address of a machine."""
        return f"10.77.{self._numbers[machine]}.2"

    def command(self, machine: str, *command: str) -> list[str]:
        """The command that runs a command on a machine, as the same process."""
        return ["ip", "netns", "exec", self.namespace(machine), *command]

    @contextlib.contextmanager
    def on(self, machine: str | None) -> Generator[None]:
        """Have the sockets that this thread makes meanwhile be a machine's; of none: be the hub's."""
        with open("/proc/thread-self/ns/net") as before:
            with open(NAMES / (self.hub if machine is None else self.namespace(machine))) as there:
                _enter(there.fileno())
            try:
                yield
            finally:
                _enter(before.fileno())

    def cut(self, sender: str, receiver: str) -> None:
        """Drop whatever one machine sends to another."""
        if (sender, receiver) not in self._cut:
            self._rule("add", sender, receiver)
            self._cut.add((sender, receiver))

    def part(self, some: Iterable[str], others: Iterable[str]) -> None:
        """Cut the network between two groups of machines, both ways."""
        others = [*others]
        for one in some:
            for other in others:
                self.cut(one, other)
                self.cut(other, one)

    def mend(self) -> None:
        """Cut nothing any more."""
        while self._cut:
            self._rule("del", *self._cut.pop())

    def close(self) -> None:
        """Remove all that was made."""
        for name in (*map(self.namespace, self._numbers), self.hub):
            if (NAMES / name).exists():
                _ip("netns", "del", name)

    def _rule(self, verb: str, sender: str, receiver: str) -> None:
        way = ("from", self.address(sender), "to", self.address(receiver))
        _ip("-n", self.hub, "rule", verb, *way, "priority", "100", "blackhole")

    def _in_hub(self, *command: str) -> None:
        subprocess.run(["ip", "netns", "exec", self.hub, *command], check=True)


def drop_left_behind() -> None:
    """Remove the namespaces of test runs that were killed."""
    for name in NAMES.glob("hf*-*"):
        pid = name.name[2:].partition("-")[0]
        if pid.isdigit() and not Path("/proc", pid).exists():
            _ip("netns", "del", name.name)


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"ip {' '.join(words)}: {done.stderr}"


def _enter(descriptor: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(descriptor, NEW_NET) != 0:
        raise OSError(ctypes.get_errno(), "setns")
