"""The ledger of forks, against a naive model: whatever comes in whichever order, each descriptor has one owner."""

from __future__ import annotations

import asyncio
import os
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from holdfast.actors.errors import ProcessUnavailable
from holdfast.actors.process.fork.forked_process import ForkLedger, ForkRequest


def is_open(fd: int) -> bool:
    try:
        os.fstat(fd)
    except OSError:
        return False
    return True


class Asked:
    """What the model knows of one fork that was asked for."""

    def __init__(self, request: ForkRequest) -> None:
        self.request = request
        self.pid = self.pidfd = 0
        self.is_answered = self.has_resumed = self.is_dead = False


class Forks(RuleBasedStateMachine):
    """Whoever asks may give up at any time; the server answers late or never, and children die when they like."""

    @initialize()
    def begin(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.ledger, self.asked = ForkLedger(), list[Asked]()
        self.child = os.posix_spawn("/bin/true", ["true"], {})
        self.pidfd = os.pidfd_open(self.child)
        os.waitpid(self.child, 0)
        self.strays: list[int] = []  # descriptors that nobody may keep
        self.next_pid = 1_000_000

    def some(self, draw: int, *, answered: bool | None = None, resumed: bool = False) -> Asked | None:
        found = [
            one
            for one in self.asked
            if one.has_resumed is resumed and (answered is None or one.is_answered is answered)
        ]
        return found[draw % len(found)] if found else None

    @rule(count=st.integers(1, 3))
    def ask(self, count: int) -> None:
        for _ in range(count if sum(not one.has_resumed for one in self.asked) < 6 else 0):
            self.asked.append(Asked(self.ledger.begin(self.loop.create_future())))

    @rule(draw=st.integers(0, 9), fds=st.sampled_from([1, 1, 1, 0]), resumed=st.sampled_from([False, False, True]))
    def answer(self, draw: int, fds: int, resumed: bool) -> None:
        one = self.some(draw, answered=False, resumed=resumed)
        if one is None:
            return
        one.is_answered, self.next_pid = True, self.next_pid + 1
        one.request._close_child_fds()  # The server has them.
        pidfds = [os.dup(self.pidfd) for _ in range(fds)]
        is_wanted = not one.request.outcome.done()
        self.ledger.forked(one.request.number, self.next_pid, pidfds)
        if fds and is_wanted and not resumed:
            one.pid, one.pidfd = self.next_pid, pidfds[0]
            assert one.request.outcome.result() == one.pid
        else:
            self.strays += pidfds
            assert resumed or one.request.outcome.exception() is not None or one.request.outcome.cancelled()

    @rule(draw=st.integers(0, 9))
    def refuse(self, draw: int) -> None:
        one = self.some(draw, answered=False)
        if one is not None:
            one.is_answered = True
            self.ledger.refused(one.request.number, "no memory")
            assert one.request.outcome.done()

    @rule(number=st.integers(50, 60))
    def answer_nobody(self, number: int) -> None:
        fd = os.dup(self.pidfd)
        self.strays.append(fd)
        self.ledger.forked(number, 999, [fd])

    @rule(draw=st.integers(0, 9))
    def die(self, draw: int) -> None:
        one = self.some(draw, answered=True)
        if one is not None and one.pid and not one.is_dead:
            one.is_dead = True
            assert self.ledger.exited(one.pid, 9)  # Whoever asked has not had it yet.
            assert one.request.status == 9

    @rule(draw=st.integers(0, 9), gives_up=st.booleans())
    def resume(self, draw: int, gives_up: bool) -> None:
        """Whoever asked goes on: with the process, or without."""
        one = self.some(draw)
        if one is None:
            return
        request, one.has_resumed = one.request, True
        child: Any = None
        if gives_up or not request.outcome.done():
            request.outcome.cancel()
        elif not request.outcome.cancelled() and request.outcome.exception() is None:
            child = self.ledger.hand_over(request)
        self.ledger.close(request)
        assert not self.ledger.exited(one.pid, 9)  # Nobody waits for it any more.
        if child is None:
            assert one.pid not in self.ledger.children
            self.strays += [one.pidfd] if one.pidfd else []
            return
        assert (child.pid, child.pidfd) == (one.pid, one.pidfd)
        assert self.ledger.children[one.pid] is child
        child.close()
        self.strays.append(one.pidfd)

    @rule(really=st.integers(0, 5))
    def fail(self, really: int) -> None:
        if really:
            return
        self.ledger.fail("the server has ended")
        for one in self.asked:
            if not one.is_answered:
                error = None if one.request.outcome.cancelled() else one.request.outcome.exception()
                assert one.request.outcome.cancelled() or isinstance(error, ProcessUnavailable)

    @invariant()
    def nothing_is_kept_that_nobody_has(self) -> None:
        for one in getattr(self, "asked", ()):
            if one.pidfd and not one.has_resumed:
                assert is_open(one.pidfd)

    def teardown(self) -> None:
        if not hasattr(self, "asked"):
            return
        for one in self.asked:
            if not one.has_resumed:
                self.ledger.close(one.request)
                self.strays += [one.pidfd] if one.pidfd else []
            assert one.request.sock.fileno() == -1
        assert not [fd for fd in self.strays if is_open(fd) and os.readlink(f"/proc/self/fd/{fd}").endswith("[pidfd]")]
        os.close(self.pidfd)
        self.loop.close()


Forks.TestCase.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestForks = Forks.TestCase
