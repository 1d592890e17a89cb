"""The killer: the same moments for the same seed, each process once."""

import signal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from map_demo.killer import LONGEST_DELAY, Killer, Moment, schedule
from map_demo.report import MapperKill


@given(st.integers(0, 50), st.integers(1, 5000), st.integers())
def test_a_seed_gives_the_same_moments_within_the_log(kills: int, scans: int, seed: int) -> None:
    moments = schedule(kills, scans, seed)
    assert moments == schedule(kills, scans, seed)
    assert len(moments) == kills
    assert [moment.scan for moment in moments] == sorted(moment.scan for moment in moments)
    assert all(1 <= moment.scan <= scans and 0 <= moment.delay <= LONGEST_DELAY for moment in moments)


def test_another_seed_gives_other_moments() -> None:
    assert schedule(5, 3873, 7) != schedule(5, 3873, 8)


class Processes:
    """Processes that are there, then gone, then replaced, as the killer sees them."""

    def __init__(self, *pids: int | None) -> None:
        self.pids = list(pids)
        self.signals: list[tuple[int, int]] = []

    def find(self) -> int | None:
        return self.pids.pop(0) if len(self.pids) > 1 else self.pids[0]

    def kill(self, pid: int, number: int) -> None:
        if pid == 13:
            raise ProcessLookupError
        self.signals.append((pid, number))


async def test_each_process_is_killed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    processes = Processes(11, 11, None, 13, 12)
    monkeypatch.setattr("os.kill", processes.kill)
    told: list[MapperKill] = []
    killer = Killer([Moment(5, 0.0), Moment(6, 0.0)], processes.find, told.append)
    killer.saw(4)
    assert not processes.signals
    killer.saw(9)
    await killer.finish()
    assert processes.signals == [(11, signal.SIGKILL), (12, signal.SIGKILL)]
    assert killer.kills == told == [MapperKill(11, 5), MapperKill(12, 6)]


async def test_no_kills_are_done_at_once() -> None:
    await Killer([], lambda: None, lambda kill: None).finish()
