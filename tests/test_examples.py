"""Every program in examples/ and examples/tutorial/ runs, and prints what it says it prints."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("warm_programs")

OWN_TESTS = {"rescue_robot", "fastapi_service", "tcp_server", "quick_start", "chapter_4_store"}
"""The first prints times, two serve until they are told to end, the last two are killed."""
FOLDER = Path(__file__).parent.parent / "examples"
EXAMPLES = [
    path for path in sorted([*FOLDER.glob("*.py"), *FOLDER.glob("tutorial/*.py")]) if path.stem not in OWN_TESTS
]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_prints_what_its_comments_say(path: Path) -> None:
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    said = re.findall(r"print\(.*\)\s+# ([^:\n]+)", path.read_text())
    assert done.stdout.splitlines() == [line.strip() for line in said]
