"""Attach and detach: the life of an actor moves into a group of replicas and out of it."""
