"""Reads an MCAP file with the two libraries that know ROS 2, each in its own way."""

from collections import Counter
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

Said = tuple[str, int, Any]  # topic, stamp in ns, message


def by_mcap(path: Path) -> list[Said]:
    """All messages in the order of the file, decoded by the definitions that are in the file."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        return [
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False)
        ]


def by_rosbags(path: Path) -> list[Said]:
    """All messages in the order of time, decoded by the definitions of ROS 2 Jazzy."""
    types = get_typestore(Stores.ROS2_JAZZY)
    with Reader(path) as reader:
        return [
            (connection.topic, stamp, types.deserialize_cdr(raw, connection.msgtype))
            for connection, stamp, raw in reader.messages()
        ]


def read_both(path: Path) -> list[Said]:
    """All messages in the order of the file, which is that of time; both libraries read the same."""
    first, second = by_rosbags(path), by_mcap(path)
    assert all(before[1] <= after[1] for before, after in pairwise(second))
    assert counts(first) == counts(second)
    for topic in counts(first):
        for (stamp, one), (other_stamp, other) in zip(of(first, topic), of(second, topic), strict=True):
            assert stamp == other_stamp
            assert same(one, other), f"{topic}: {one} or {other}"
    return second


def same(one: Any, other: Any) -> bool:
    """Whether a message of rosbags has the same fields as one of mcap."""
    if is_dataclass(one):
        names = [field.name for field in fields(one) if field.name[0].islower()]  # others are constants
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, np.asarray(other, one.dtype))
    return bool(one == other)


def of(said: list[Said], topic: str) -> list[tuple[int, Any]]:
    """Stamps and messages of a topic."""
    return [(stamp, message) for name, stamp, message in said if name == topic]


def counts(said: list[Said]) -> Counter[str]:
    return Counter(topic for topic, _, _ in said)
