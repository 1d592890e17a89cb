"""Snapshots: when one is due, how it is written, kept and read back."""
