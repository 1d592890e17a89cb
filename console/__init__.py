"""What a person sees of holdfast: the command line and its demo. The library itself never imports this folder."""
