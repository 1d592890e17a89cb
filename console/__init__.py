"""The command line and the demo. The library itself never imports this folder."""
