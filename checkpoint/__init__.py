"""Crash recovery: snapshots, journals, stores and replay."""
