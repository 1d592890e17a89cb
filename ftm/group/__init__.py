"""A group of replicas as the root has it: who is in it, who leads, and how that changes."""
