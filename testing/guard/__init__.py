"""The guard: what tests did wrong with messages and replies, and what they left behind."""
