"""Votes: what several runs of one request have in common, and what may be said against one."""
