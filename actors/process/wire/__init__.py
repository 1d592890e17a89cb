"""What the root and an actor process say to each other: frames, their connection, and who may send which."""
