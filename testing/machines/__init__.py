"""State machines of Hypothesis over a running system; the schedule is drawn and shrunk with the rules."""
