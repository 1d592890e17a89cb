"""What a running system tells the tools that watch services: metrics for Prometheus, log fields, a dashboard's data."""
