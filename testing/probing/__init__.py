"""The building blocks of probes, besides the probe itself."""
