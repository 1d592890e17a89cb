"""Supervisors for a purpose: tasks, pools, partitions, registries and external programs."""
