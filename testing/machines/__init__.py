"""Machines of Hypothesis over a running system, whose schedule is drawn and shrunk with the rules."""
