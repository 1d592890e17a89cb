"""The soak of `make soak`, for some seconds; and what it calls a leak."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

from tests import soak

# The actors of the soak are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[1])
if ROOT not in sys.path:
    sys.path.append(ROOT)


async def test_under_kills_nothing_is_lost() -> None:
    report = await soak.run(3.0, 20_260_601, least=5)
    assert not report.problems, str(report)
    assert report.requests > 0
    assert sum(report.done.values()) + sum(report.refused.values()) >= 20
    assert len(report.samples) >= 5


def samples(count: int, **slopes: float) -> list[dict[str, float]]:
    """What noise looks like, and growth by so much from the first to the last."""
    noise = random.Random(1)
    levels = {"pss_kb": 90_000.0, "rss_kb": 50_000.0, "descriptors": 41.0, "children": 6.0, "threads": 2.0}
    levels |= {"store_kb": 9_000.0, "wal_kb": 60_000.0}
    return [
        {
            name: level + slopes.get(name, 0.0) * at / count + noise.uniform(-0.01, 0.01) * level
            for name, level in levels.items()
        }
        for at in range(count)
    ]


def test_noise_is_no_leak() -> None:
    assert soak.leaks(samples(1000)) == []


@pytest.mark.parametrize(
    ("name", "more"),
    [("pss_kb", 20_000), ("descriptors", 10), ("children", 4), ("threads", 6), ("store_kb", 4_000)],
)
def test_growth_is_told_with_its_name(name: str, more: float) -> None:
    [problem] = soak.leaks(samples(1000, **{name: more}))
    assert problem.startswith(f"{name} grows by ")


def test_a_spike_is_no_leak_and_too_few_samples_say_nothing() -> None:
    spiked = samples(1000)
    spiked[700]["descriptors"] = 5000.0
    assert soak.leaks(spiked) == []
    assert soak.leaks(samples(soak.ENOUGH, pss_kb=1e9)) == []


def test_a_log_of_the_store_without_end_is_told() -> None:
    [problem] = soak.leaks(samples(100, wal_kb=40_000.0))
    assert problem.startswith("the write-ahead log has ")
