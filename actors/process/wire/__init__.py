"""The wire between the root and actor processes: frames, connections, and who may send which."""
