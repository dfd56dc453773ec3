"""Streams: one policy that is asked again and again, whose answers are queues of actions."""
