"""What surrounds a program that embeds a system: systemd, Kubernetes, a container, a launch file, a notebook."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

import holdfast as hf
from holdfast.console.remote import RemoteRef, RemoteSystem
from tests.examples.embedding.programs import (
    FOLDER,
    PATHS,
    PATIENCE,
    Case,
    LineClient,
    Load,
    ask,
    free_port,
    kept_by_lines,
    running,
)

LINES = ("PYTHON", "-m", "line_server")
AS_INIT = ("unshare", "--user", "--map-root-user", "--pid", "--fork", "--mount-proc", "--kill-child")


def until(holds: Callable[[], bool], what: str) -> None:
    """Wait for something in another process, which tells nobody of it."""
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, what
        time.sleep(0.01)


# -- systemd ----------------------------------------------------------------------------------------------------------


def test_systemd_hears_of_the_start_of_the_loop_and_of_the_stop(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, tempfile.TemporaryDirectory(dir="/tmp") as folder:
        systemd.bind(f"{folder}/notify")
        systemd.settimeout(PATIENCE)
        told: list[str] = []

        def hears(line: str) -> None:
            while line not in (told[-1].splitlines() if told else []):
                told.append(systemd.recv(4096).decode())

        environment = {"NOTIFY_SOCKET": f"{folder}/notify", "WATCHDOG_USEC": "100000"}
        case = Case(LINES, LineClient, kept_by_lines, status=(143,), environment=environment)
        with running(case, tmp_path) as program, Load(program) as load:
            hears("READY=1")
            hears("WATCHDOG=1")
            load.wait_for(40)
            program.terminate()
            hears("STOPPING=1")
        with running(case, tmp_path) as program:
            assert load.confirmed <= program.kept()


def test_the_unit_runs_a_program_that_is_there() -> None:
    unit = (FOLDER / "line-server.service").read_text()
    started = re.search(r"^ExecStart=\S+/python (\S+)$", unit, re.MULTILINE)
    assert started is not None
    assert (FOLDER / started[1]).is_file()
    assert {"Type=notify", "WatchdogSec=15", "KillMode=mixed"} <= set(unit.splitlines())


# -- Kubernetes -------------------------------------------------------------------------------------------------------


def test_the_probes_of_kubernetes_are_answered(tmp_path: Path) -> None:
    pod = yaml.safe_load((FOLDER / "kubernetes.yaml").read_text())["spec"]["template"]["spec"]["containers"][0]
    paths = {pod[probe]["httpGet"]["path"] for probe in ("startupProbe", "readinessProbe", "livenessProbe")}
    assert paths == {"/livez", "/readyz"}
    port = free_port()
    case = Case(LINES, LineClient, kept_by_lines, status=(143,), environment={"PROBES": f"127.0.0.1:{port}"})
    with running(case, tmp_path) as program:
        for path in paths:
            until(lambda path=path: ask(port, path) == "ok\n", path)  # type: ignore[misc]
        with pytest.raises(OSError, match="404"):
            ask(port, "/metrics")
        program.terminate()


# -- a container ------------------------------------------------------------------------------------------------------


def may_unshare() -> bool:
    """Whether this machine lets us have a PID namespace."""
    found = shutil.which("unshare") and shutil.which("nsenter")
    return bool(found) and subprocess.run([*AS_INIT, "true"], capture_output=True, check=False).returncode == 0


def test_as_pid_1_it_handles_signals_and_reaps_orphans(tmp_path: Path) -> None:
    if not may_unshare():
        pytest.skip("this machine does not allow a PID namespace (unshare --user --pid)")
    assert '"line_server.py"' in (FOLDER / "Dockerfile").read_text()
    case = Case((*AS_INIT, *LINES), LineClient, kept_by_lines, status=(143,))
    with running(case, tmp_path) as program, Load(program) as load:
        (init,) = psutil.Process(program.process.pid).children()
        (root,) = init.children()
        enter = ["nsenter", "-t", str(init.pid), "-U", "-p", "--preserve-credentials"]
        subprocess.run([*enter, "sh", "-c", "(sleep 1000 &)"], check=True)
        until(lambda: len(init.children()) == 2, "the orphan does not come to PID 1")
        (orphan,) = set(init.children()) - {root}
        orphan.kill()
        until(lambda: init.children() == [root], "the orphan is not reaped")
        load.wait_for(40)
        init.send_signal(signal.SIGTERM)
        assert program.process.wait(PATIENCE) == 143, program.log.read_text()
    with running(case, tmp_path) as program, Load(program, begin=1_000_000) as more:
        assert load.confirmed <= program.kept()
        more.wait_for(40)
        (init,) = psutil.Process(program.process.pid).children()
        init.kill()  # The kernel kills all of the namespace.
        program.process.wait(PATIENCE)
    with running(case, tmp_path) as program:
        assert load.confirmed | more.confirmed <= program.kept()


WITH_THREAD = """
import asyncio, threading
import holdfast as hf
threading.Thread(target=threading.Event().wait, daemon=True).start()
hf.run(asyncio.sleep(0))
"""


def test_as_pid_1_with_threads_it_warns_and_runs(tmp_path: Path) -> None:
    if not may_unshare():
        pytest.skip("this machine does not allow a PID namespace (unshare --user --pid)")
    command = [*AS_INIT, sys.executable, "-c", WITH_THREAD]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": PATHS}, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, "RuntimeWarning" in done.stderr, "2 threads run already" in done.stderr) == (0, True, True)


# -- one worker of several --------------------------------------------------------------------------------------------


def test_a_worker_that_is_killed_is_followed_by_one_with_its_state(tmp_path: Path) -> None:
    case = Case(
        ("PYTHON", "-m", "uvicorn", "--port", "PORT", "--log-level", "warning", "fastapi_app:app"),
        workers=2,
        environment={"WEB_CONCURRENCY": "2"},
    )
    with running(case, tmp_path) as program, Load(program) as load:
        load.wait_for(20)
        workers = [one for one in psutil.Process(program.process.pid).children() if "spawn_main" in str(one.cmdline())]
        assert len(workers) == 2
        workers[0].kill()
        load.wait_for(60)
        program.ready()  # Both numbers have answered.
        confirmed = set(load.confirmed)
        assert confirmed <= program.kept()


# -- a launch file ----------------------------------------------------------------------------------------------------


@contextmanager
def robot(folder: Path) -> Generator[tuple[subprocess.Popen[bytes], RemoteSystem]]:
    """The nodes of the launch file, up."""
    control = folder / "control"
    environment = {**os.environ, "PYTHONPATH": PATHS, "NOTES_FOLDER": str(folder), "SOCKET": str(control)}
    command = [sys.executable, str(FOLDER / "launch.py"), str(FOLDER / "robot.launch.xml")]
    process = subprocess.Popen(command, env=environment, start_new_session=True, stderr=subprocess.DEVNULL)
    try:
        until(lambda: control.exists() and is_up(control), "the robot does not come up")
        with RemoteSystem(control) as remote:
            yield process, remote
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def is_up(control: Path) -> bool:
    """Whether the odometry can be asked."""
    try:
        with RemoteSystem(control) as remote:
            return odometry(remote)["total"] >= 0
    except (hf.HoldfastError, OSError):  # Its endpoint is open, and the node is not there yet.
        return False


def odometry(remote: RemoteSystem) -> Any:
    """The state of that node."""
    return asked(lambda node: remote.get_state(node, timeout=PATIENCE), remote)


def asked(order: Callable[[RemoteRef], Awaitable[Any]], remote: RemoteSystem) -> Any:
    """What the node answers to an order; one that was in hand when its process was killed is given again."""

    async def ask_again() -> Any:
        while True:
            try:
                return await order(remote.ref("/robot/nodes/odometry"))
            except hf.AskFailed:
                pass

    return asyncio.run(ask_again())


def pid_of(remote: RemoteSystem) -> int:
    """The process in which that node lives."""
    return int(asked(lambda node: remote.get_status(node, timeout=PATIENCE), remote).pid)


def test_the_nodes_of_a_launch_file_miss_nothing_when_they_die(tmp_path: Path) -> None:
    with robot(tmp_path) as (process, remote):
        until(lambda: odometry(remote)["total"] > 20, "the wheels do not turn")
        pid = pid_of(remote)
        assert pid != process.pid
        os.kill(pid, signal.SIGKILL)
        until(lambda: pid_of(remote) != pid, "the node does not come back")
        before = odometry(remote)["total"]
        until(lambda: odometry(remote)["total"] > before + 20, "the node does not go on")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 143
    for _ in range(2):
        with robot(tmp_path) as (process, remote):
            begin = odometry(remote)
            assert begin["total"] > before
            assert begin["missed"] == 0
            until(lambda begin=begin: odometry(remote)["total"] > begin["total"] + 20, "it does not go on")  # type: ignore[misc]
            before = begin["total"]
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


# -- a notebook -------------------------------------------------------------------------------------------------------


def test_a_notebook_goes_on_where_its_kernel_was_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel")
    nbformat = pytest.importorskip("nbformat", reason="needs nbformat")
    monkeypatch.setenv("PYTHONPATH", PATHS)
    monkeypatch.setenv("NOTES_FOLDER", str(tmp_path))
    printed: list[str] = []

    async def run_until(ending: signal.Signals | None) -> None:
        notebook = nbformat.read(FOLDER / "notebook.ipynb", 4)
        client = nbclient.NotebookClient(notebook, timeout=int(PATIENCE))
        async with client.async_setup_kernel():
            cells = list(enumerate(notebook.cells))
            for index, cell in cells[: None if ending is None else -1]:
                await client.async_execute_cell(cell, index)
                printed.extend(one["text"].strip() for one in cell.get("outputs", ()) if one.get("name") == "stdout")
            if ending is not None:
                os.kill(client.km.provisioner.pid, ending)

    for ending in (signal.SIGTERM, signal.SIGKILL, None):
        asyncio.run(run_until(ending))
    assert printed == ["3", "6", "9"]
