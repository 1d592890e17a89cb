"""What probes are made of, beside the probe itself."""
