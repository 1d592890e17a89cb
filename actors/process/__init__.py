"""Actors in an OS process of their own."""
