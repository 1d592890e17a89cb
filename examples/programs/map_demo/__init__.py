"""The parts of `demo.py`: a robot maps a building while the process that holds the map is killed, again and again.

The files, in the order in which they are worth reading: `actors` (what a user of holdfast writes), `demo_runs` (two
runs of the same system, one of them disturbed) with `questions` and `killer`, `report` (the verdict), `show` (three
ways to watch). `log`, `grid`, `planner` and `picture` know nothing of actors.
"""
