"""A replica: the process in which the protected actor lives, with the bricks around it."""
