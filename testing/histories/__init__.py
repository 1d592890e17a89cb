"""Histories: what clients asked and what they heard, and whether that could have happened one after the other."""
