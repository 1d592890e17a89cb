"""Actors, the messages they handle, and the path a message takes to them."""
