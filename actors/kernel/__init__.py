"""The kernel: an actor, its mailbox, the path a message takes to it, and the loop that runs its turns."""
