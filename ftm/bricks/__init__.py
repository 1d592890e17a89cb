"""Bricks: what mechanisms are made of, and how the bricks of two replicas talk."""
