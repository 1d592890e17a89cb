"""Supervisors: who restarts whom, when and how often."""
