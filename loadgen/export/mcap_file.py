"""An MCAP file of ROS 2 messages in CDR (profile `ros2`), which Foxglove, Rerun and `ros2 bag` read.

Only this file imports mcap and rosbags. What is written is chosen in `ros_topics`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from offboard.common.errors import ConfigError, MissingExtra
from offboard.ros2.converters import Library

try:
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError as error:
    raise MissingExtra("--mcap", "mcap") from error


class McapFile:
    """Writes messages by topic, in the order of their stamps. `count` is the number of messages so far."""

    def __init__(self, file: IO[bytes]) -> None:
        self.count = 0
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self.library = Library(self._types.types.__getitem__, lambda values: values)
        self._writer = Writer(file)
        self._writer.start(profile="ros2", library="offboard")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Add a message that was made with `library`. All messages of a topic have one type."""
        name = message.__msgtype__
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=self._schema(name)
            )
        data = bytes(self._types.serialize_cdr(message, name))
        self._writer.add_message(self._channels[topic], stamp_ns, data, publish_time=stamp_ns)
        self.count += 1

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            text, _ = self._types.generate_msgdef(name, ros_version=2)
            self._schemas[name] = self._writer.register_schema(name, "ros2msg", data=text.encode())
        return self._schemas[name]


@contextmanager
def new_mcap(path: Path) -> Iterator[McapFile]:
    """A file that is at `path` once it is whole; after an error nothing is left of it."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with fresh.open("wb") as file:
                mcap = McapFile(file)
                yield mcap
                mcap.finish()
            fresh.replace(path)
        finally:
            fresh.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--mcap: {path} cannot be written: {error.strerror}") from error
