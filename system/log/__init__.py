"""The log: what operators want to see of the events, as records."""
