"""How much CPU does recovery cost the main job?

Baseline: the demo's map built by the same actors with `fresh` (no journal, no snapshots). Ours: the same with
`hybrid(interval=2.0)`. User and system seconds of all processes at the demo's pace, without kills: the median of ten
interleaved pairs; the 90 % interval goes to stderr.
Command: python benchmarks/bench_demo_cpu.py [--quick]
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
from pathlib import Path

from harness import Run, main

SCRIPT = Path(__file__).resolve().parents[1] / "examples/programs/demo.py"
DEMO = [sys.executable, str(SCRIPT), "--json", "--kills", "0"]


def cpu_seconds(method: str) -> float:
    """CPU of one undisturbed demo, all its processes included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*DEMO, "--method", method], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = json.loads(done.stdout)
    if not found["identical"]:
        raise RuntimeError(f"the maps of an undisturbed {method} run differ: {found}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


async def demo_cpu(run: Run) -> None:
    """CPU with recovery over CPU without."""
    ratios = sorted(_pair() for _ in range(3 if run.quick else 10))
    print(f"# 90 % interval of the ratio: {ratios[0]:.3f} to {ratios[-1]:.3f}", file=sys.stderr)
    run.bound("CPU of the demo with recovery over without", statistics.median(ratios), unit="x", target=1.05)


def _pair() -> float:
    without = cpu_seconds("fresh")
    return cpu_seconds("hybrid") / without


if __name__ == "__main__":
    main([demo_cpu])
