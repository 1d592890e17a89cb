"""What the tests of the history share."""

import sys
from pathlib import Path

# The actors of some tests are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)
