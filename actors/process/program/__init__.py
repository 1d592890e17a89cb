"""External programs, each under a small process that owns it."""
