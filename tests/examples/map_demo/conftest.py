"""A small log of the demo's format, drawn here: a robot drives down a corridor."""

from pathlib import Path

import pytest

SCANS = 60
BEAMS = 19
CORRIDOR = 2.0  # metres from the middle to either wall


def line(number: int) -> str:
    """The corridor runs east; the robot looks east, with beams from right to left."""
    angles = [-1.5708 + 3.1416 * beam / (BEAMS - 1) for beam in range(BEAMS)]
    ranges = " ".join(f"{min(CORRIDOR / max(abs(angle), 0.01), 60.0):.2f}" for angle in angles)
    pose = f"{0.3 * number:.3f} 0.0 0.0"
    return (
        f"ROBOTLASER1 0 -1.5708 3.1416 {3.1416 / (BEAMS - 1):.6f} 50.0 0.1 0 {BEAMS} {ranges} 0 {pose} {pose} "
        f"0 0 0 0 0 {1000.0 + number:.1f} robot {number}.0\n"
    )


@pytest.fixture
def small_log(tmp_path: Path) -> Path:
    path = tmp_path / "corridor.g2o"
    path.write_text("# a corridor\n" + "".join(line(number) for number in range(SCANS)))
    return path
