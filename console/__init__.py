"""What a person sees of holdfast: the command line and the demo. The library itself never imports this folder."""
