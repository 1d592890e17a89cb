"""What the tests of diagnosis share."""

import sys
from pathlib import Path

# Helpers beside the tests are imported by name.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)
