"""The commands that reach a running system: those that look at it, and those that change it."""
