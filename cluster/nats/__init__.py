"""NATS JetStream: the one folder that knows its client. It needs the extra `nats`: `pip install 'holdfast[nats]'`."""
