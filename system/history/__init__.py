"""The history of a system: what happened to whom, kept within bounds, and what follows from it in plain words."""
