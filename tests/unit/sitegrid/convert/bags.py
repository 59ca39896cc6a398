"""Bags of synthetic drives, written by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

T0 = 1_750_000_000_000_000_000
STEP_NS = 100_000_001
LATE_NS = 7_000_000  # from stamp to recorder
FORMS = ("bag", "sqlite3", "mcap")
Said = tuple[int, dict[str, Any]]  # recorder's time [ns], message fields


@cache
def types(form: str) -> Any:
    return get_typestore(Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_HUMBLE)


def write_bag(folder: Path, form: str, topics: dict[str, tuple[str, Sequence[Said]]]) -> Path:
    """A bag of messages by topic; returns the converter's input."""
    store, path = types(form), folder / f"drive.{form}"
    plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if form == "bag" else Writer2(path, version=9, storage_plugin=plugin) as writer:
        for topic, (name, said) in topics.items():
            connection = writer.add_connection(topic, name, typestore=store)
            for recorded_ns, fields in said:
                message = made(store, name, fields)
                write = store.serialize_ros1 if form == "bag" else store.serialize_cdr
                writer.write(connection, recorded_ns, write(message, name))
    return path


def made(store: Any, name: str, given: dict[str, Any]) -> Any:
    """A message with these fields, zeros elsewhere."""
    values = {}
    for field, (node, detail) in store.fielddefs[name][1]:
        if node == Nodetype.NAME:
            values[field] = made(store, detail, given.get(field, {}))
        elif node == Nodetype.BASE:
            values[field] = given.get(field, "" if detail[0] == "string" else 0.0 if "float" in detail[0] else 0)
        else:
            values[field] = given.get(field, np.zeros(detail[1]))
    return store.types[name](**values)


def header(stamp_ns: int, frame: str = "") -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}
