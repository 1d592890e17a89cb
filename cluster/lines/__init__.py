"""Lines between systems: refs, asks, topics and watches across them, over a transport that may lose and repeat."""
