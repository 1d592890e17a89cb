"""Monitoring: whether the mechanism in force still suits what there is."""
