"""Bags of ROS 1 and 2, and ROS 2 MCAP files, read by rosbags, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

from protocol.errors import LogFolderError
from sitegrid.convert.recording import Topic, Value
from sitegrid.convert.ros_messages import JOINT_STATE, SURE, TYPES, Values, measures

T = TypeVar("T")
BAG, MCAP, SQLITE = b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\0"
WHOSE = "the wheels' speed, a receiver's, or a filter's"


class RosRecording:
    """A bag, by ROS' own type definitions; a bag's may be anything."""

    def __init__(self, path: Path, *, is_ros1: bool) -> None:
        self._path, self._is_ros1 = path, is_ros1
        self.unread: list[str] = []
        self._unstamped: set[str] = set()
        self.topics = list(self._guarded(self._survey()))

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of topics and joints, `TOPIC[joint,joint]`; unstamped ones at the recorder's time."""
        return self._guarded(self._values(wanted))

    def _values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        split = [(*split_joints(name), name, kind) for name, kind in wanted]
        with self._opened() as bag:
            those = [c for c in bag.connections if c.topic in {topic for topic, *_ in split} and self._is_known(c)]
            for c, recorded_ns, message in self._messages(bag, those):
                stamp_ns = recorded_ns if c.topic in self._unstamped else _stamp_ns(message)
                for topic, joints, name, kind in split:
                    if topic == c.topic:
                        yield _value(name, kind, stamp_ns, partial(TYPES[c.msgtype][kind][1], message, joints))

    def _survey(self) -> Iterator[Topic]:
        """Usable topics; the others go to `unread`."""
        with self._opened() as bag:
            for c in {c.topic: c for c in bag.connections}.values():
                if not self._is_known(c):
                    other = ", of a definition that is not that of ROS," if c.msgtype in TYPES else ""
                    self.unread.append(f"{c.topic}: {c.msgtype}{other} is not read")
                elif (first := next(self._messages(bag, [c]), None)) is None:
                    self.unread.append(f"{c.topic}: has no messages")
                else:
                    yield self._topic(c, first[2])

    def _topic(self, c: Any, message: Any) -> Topic:
        kinds = {kind: fields for kind, (fields, _) in TYPES[c.msgtype].items()}
        sure = (SURE[c.msgtype],) if c.msgtype in SURE else ()
        joints = tuple(message.name) if c.msgtype == JOINT_STATE else ()
        header, note = getattr(message, "header", None), ""
        if not _stamp_ns(message):
            self._unstamped.add(c.topic)
            note = "its messages have no stamps: the recorder's clock is taken"
        frame = getattr(message, "child_frame_id", header.frame_id if header else "")
        question = "" if sure or joints else WHOSE
        return Topic(c.topic, c.msgtype, kinds, sure, question, joints, frame, measures(message), note)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        reader: Any = Reader1(self._path) if self._is_ros1 else Reader2(self._path)
        reader.open()
        with closing(reader):
            yield reader

    def _messages(self, bag: Any, connections: Sequence[Any]) -> Iterator[tuple[Any, int, Any]]:
        """Connection, recorder's time [ns], message. Nothing without connections, where rosbags gives all."""
        read = getattr(_types(self._is_ros1), "deserialize_ros1" if self._is_ros1 else "deserialize_cdr")
        for connection, recorded_ns, data in bag.messages(connections=connections) if connections else ():
            yield connection, recorded_ns, read(data, connection.msgtype)

    def _is_known(self, connection: Any) -> bool:
        """Whether the type is supported, by ROS' own definition."""
        if (name := connection.msgtype) not in TYPES:
            return False
        types = _types(self._is_ros1)
        return connection.digest in ("", types.generate_msgdef(name)[1] if self._is_ros1 else types.hash_rihs01(name))

    def _guarded(self, items: Iterable[T]) -> Iterator[T]:
        """Handle rosbags, which raises anything on damaged bytes."""
        try:
            yield from items
        except ModuleNotFoundError:
            raise
        except Exception as error:
            why = f"cannot be read ({error or type(error).__name__}): is it whole? The recorder's own tools mend a bag"
            raise LogFolderError(self._path, why) from error


@cache
def _types(is_ros1: bool) -> Any:  # noqa: FBT001 - of a cache
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)


def split_joints(name: str) -> tuple[str, list[str]]:
    """Split `/joints[left,right]` into topic and joints."""
    topic, bracket, joints = name.partition("[")
    return topic, joints.rstrip("]").split(",") if bracket else []


def _value(name: str, kind: str, stamp_ns: int, made: Callable[[], Values]) -> Value:
    try:
        return Value(name, kind, stamp_ns, made()) if stamp_ns else Value(name, kind, 0, (), "no stamp")
    except ValueError as error:
        return Value(name, kind, stamp_ns, (), str(error))


def _stamp_ns(message: Any) -> int:
    """The header's time; 0 if missing or unset."""
    header = getattr(message, "header", None)
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec) if header else 0
