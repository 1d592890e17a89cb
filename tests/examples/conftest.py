"""What the tests of the examples share."""

import sys
from pathlib import Path

# The programs import each other by bare names, as scripts do, and so do the processes of their actors.
PROGRAMS = str(Path(__file__).parents[2] / "examples/programs")
if PROGRAMS not in sys.path:
    sys.path.append(PROGRAMS)
