"""The home of a recorded actor: what is accepted, in which order, and what has come of it. It outlives every life."""
