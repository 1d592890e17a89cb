"""What a fork server and its children have of the process that has started it. Imported there."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import socket
import sys
import time
from typing import Any

LIMITS = sorted(name for name in dir(resource) if name.startswith("RLIMIT_"))
STATUS = ("Umask", "Threads", "SigBlk", "SigIgn", "SigCgt", "NoNewPrivs", "CapEff")


def descriptors(pid: int) -> list[str]:
    folder = f"/proc/{pid}/fd"
    found: list[str] = []
    for fd in os.listdir(folder):
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            found.append(re.sub(r"\d+", "", os.readlink(f"{folder}/{fd}")))
    return sorted(found)


def facts() -> dict[str, Any]:
    """Of this process, a child, and of the fork server, its parent; the numbers of processes and sockets left out."""
    server = os.getppid()
    with open(f"/proc/{server}/status") as file:
        status = dict(line.rstrip("\n").split(":\t", 1) for line in file if ":\t" in line)
    return {
        "started by": int(status["PPid"]),
        "leads its session": os.getsid(server) == server == os.getpgid(server),
        "status": {name: status[name].strip() for name in STATUS},
        "standard streams": [re.sub(r"\d+", "", os.readlink(f"/proc/{server}/fd/{fd}")) for fd in range(3)],
        "descriptors": descriptors(server),
        "descriptors of a child": descriptors(os.getpid()),
        "environment": {name: value for name, value in os.environ.items() if value != str(server)},
        "limits": {name: resource.getrlimit(getattr(resource, name)) for name in LIMITS},
        "folder": os.getcwd(),
        "argv": sys.argv,
        "path": sys.path,
        "flags": str(sys.flags),
        "executable": sys.executable,
        "time zone": time.tzname,
        "niceness": os.nice(0),
    }


def main(sock: socket.socket, page: int) -> int:
    """Say it to whoever asks."""
    sock.recv(1)
    sock.sendall(json.dumps(facts()).encode() + b"\n")
    return 0
