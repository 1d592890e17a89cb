"""Schedules: what decides a simulated run, how schedules are searched, shrunk, repeated and drawn."""
