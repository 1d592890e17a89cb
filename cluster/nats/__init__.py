"""The engine for several machines over NATS JetStream (extra `holdfast[nats]`)."""
