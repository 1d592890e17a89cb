"""What works where there is no uvloop, and on systems that are not Linux: all but processes."""

import subprocess
import sys
import textwrap

WITHOUT_UVLOOP = """
    import sys

    sys.modules["uvloop"] = None  # as if it were not installed
"""
ELSEWHERE = (
    WITHOUT_UVLOOP
    + """
    # What a program finds on Windows, but for what the loop of this system needs itself. The libraries know that.
    import asyncio, concurrent.futures, multiprocessing, os, platform, psutil, select, signal, socket, sqlite3
    import anyio, msgpack, msgspec, structlog, subprocess, tempfile

    import sysconfig

    sysconfig.get_config_vars()
    for name in ("fcntl", "resource", "pwd", "grp", "termios"):
        sys.modules[name] = None
    LACKS = {
        os: "pidfd_open memfd_create MFD_CLOEXEC fork geteuid getuid killpg setsid O_NOFOLLOW O_CLOEXEC O_NONBLOCK",
        signal: "SIGKILL SIGHUP SIGCHLD SIGUSR1 SIGSTOP SIGCONT pidfd_send_signal pthread_sigmask",
        socket: "SOCK_SEQPACKET SOCK_CLOEXEC SCM_RIGHTS CMSG_LEN MSG_CMSG_CLOEXEC SO_PEERCRED",
        select: "epoll poll",
    }
    for module, names in LACKS.items():
        for name in names.split():
            delattr(module, name)
    sys.platform = "win32"
    asyncio.SelectorEventLoop.add_signal_handler = asyncio.AbstractEventLoop.add_signal_handler  # not implemented
"""
)
PROGRAM = """
    import holdfast as hf


    class Add(hf.Message[int]):
        n: int = 1


    class Boom(hf.Message[int]): ...


    class Account(hf.Actor):
        def __init__(self):
            self.euros = 0

        @hf.on(Add)
        def add(self, message: Add) -> int:
            self.euros += message.n
            return self.euros

        @hf.on(Boom)
        def boom(self, message: Boom) -> int:
            raise ValueError("boom")


    async def main():
        async with hf.ActorSystem("app", log=False) as system:
            account = await system.start(hf.child("account", hf.start(Account), recovery=hf.hybrid()))
            await account.ask(Add(40))
            try:
                await account.ask(Boom())
            except hf.RemoteCrash:
                print("sum", await account.ask(Add(2)))
            try:
                process = await system.start(hf.child("process", hf.start(Account), isolation="process"))
                print("process", await process.ask(Add(7)))
            except hf.HoldfastError as error:
                print("refused", error)
"""
MAIN = """
    if __name__ == "__main__":
        hf.run(main())
        print("uvloop" if sys.modules.get("uvloop") else "no uvloop")
"""


def run(*parts: str, folder: object) -> list[str]:
    """The program's lines, from a process of its own."""
    file = f"{folder}/program.py"
    with open(file, "w") as program:
        program.write("".join(textwrap.dedent(part) for part in parts))
    done = subprocess.run([sys.executable, file], capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_importing_holdfast_does_not_import_uvloop() -> None:
    program = "import sys, holdfast; sys.exit('uvloop' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=120).returncode == 0


def test_without_uvloop_everything_works_on_the_loop_of_asyncio(tmp_path: object) -> None:
    assert run(WITHOUT_UVLOOP, PROGRAM, MAIN, folder=tmp_path) == ["sum 42", "process 7", "no uvloop"]


def test_with_uvloop_a_program_runs_on_it(tmp_path: object) -> None:
    assert run("import sys\n", PROGRAM, MAIN, folder=tmp_path) == ["sum 42", "process 7", "uvloop"]


def test_on_other_systems_there_are_tasks_and_processes_are_refused(tmp_path: object) -> None:
    total, refused, loop = run(ELSEWHERE, PROGRAM, MAIN, folder=tmp_path)
    assert (total, loop) == ("sum 42", "no uvloop")
    assert refused.startswith("refused ")
    assert "/app/process" in refused
    assert "need Linux (pidfd, memfd); this is win32" in refused
