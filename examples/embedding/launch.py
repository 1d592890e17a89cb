"""Run the nodes of a launch file, with recovery in place of `respawn`: `python launch.py robot.launch.xml`.

A node that dies is started again with its state, and misses nothing that was published meanwhile. Look at it by
`holdfast tree` and `holdfast inspect /robot/nodes/odometry --state`.
"""

import asyncio
import os
import shlex
import sys
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.service.health import Service


def node_spec(node: ElementTree.Element) -> hf.ChildSpec[Any]:
    """Turn one `<node>` into a child: a class of ours, or a program of anybody's.

    Raises:
        hf.SpecError: the node is not well described; the text says which one, and what is wrong.
    """
    name, delay = node.get("name", ""), float(node.get("respawn_delay", "0"))
    restart: Literal["permanent", "temporary"] = "permanent" if node.get("respawn") == "true" else "temporary"
    backoff = hf.Backoff(initial=delay, maximum=max(delay, 5.0))
    if command := node.get("exec"):
        return hf.supervision.program(shlex.split(command), id=name, restart=restart, backoff=backoff)
    module, _, kind = node.get("type", "").partition(":")
    if not kind:
        raise hf.SpecError(name, 'a node needs exec="COMMAND" or type="MODULE:CLASS"')
    params = {one.get("name", ""): float(one.get("value", "")) for one in node.iter("param")}
    start = hf.start(getattr(import_module(module), kind), **params)
    return hf.child(name, start, isolation="process", recovery=hf.hybrid(), restart=restart, backoff=backoff)


def launch(file: Path) -> hf.ChildSpec[hf.Supervisor]:
    """Read a launch file: all nodes below one supervisor, started from top to bottom."""
    nodes = [node_spec(node) for node in ElementTree.parse(file).getroot().iter("node")]
    return hf.supervisor("nodes", intensity=20, period=60.0, children=nodes)


async def main(file: Path) -> None:
    """Run the nodes until a signal comes."""
    folder = os.environ.get("NOTES_FOLDER", ".")
    system = hf.ActorSystem("robot", store=f"sqlite:{folder}/robot.db")
    async with Service(system) as service, control_endpoint(system, os.environ.get("SOCKET")):
        await system.start(launch(file))
        service.up()
        await asyncio.Event().wait()


if __name__ == "__main__":
    hf.run(main(Path(sys.argv[1])))
