"""The composition root: `ActorSystem` and `run` hand the parts to each other."""
