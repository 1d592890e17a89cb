"""What the tests of mechanisms share."""

import sys
from pathlib import Path

# Some parts are found by name, as replicas in other processes find them.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)
