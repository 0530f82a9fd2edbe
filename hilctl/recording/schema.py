"""Topics of a recording, and their protobuf schemas.

In a run of several axes each topic begins with the axis (``/x/samples``), so that applications can
open the recordings of all axes together.

A field number is never reused. :class:`hilctl.base.samples.Samples` has those of the columns.
"""

import re
from functools import cache
from typing import Any, TypeAlias

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from hilctl.base.samples import RECORDED_FIELDS

_FILE = "hilctl/recording.proto"
_PACKAGE = "hilctl"

_DOUBLE = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE
_UINT32 = descriptor_pb2.FieldDescriptorProto.TYPE_UINT32
_UINT64 = descriptor_pb2.FieldDescriptorProto.TYPE_UINT64
_SINT64 = descriptor_pb2.FieldDescriptorProto.TYPE_SINT64
_STRING = descriptor_pb2.FieldDescriptorProto.TYPE_STRING

TOPICS: dict[str, str] = {
    "/samples": "SampleBlock",
    "/ticks": "TickBlock",
    "/scope": "Sample",
    "/events": "Event",
}
"""Message name per topic, in package ``hilctl``."""
_OF_AXIS = re.compile(r"(/[a-z][a-z0-9_]*)?(/[a-z]+)")


def topic_of(axis: str, topic: str) -> str:
    """Return the topic of an axis; the topic itself for an empty name."""
    return f"/{axis}{topic}" if axis else topic


def split_topic(name: str) -> tuple[str, str]:
    """Return the axis of a topic, empty without one, and the topic without it."""
    found = _OF_AXIS.fullmatch(name)
    return ((found[1] or "").lstrip("/"), found[2]) if found else ("", name)


# name: (number, type, repeated); units are in the names
_Fields: TypeAlias = dict[str, tuple[int, Any, bool]]


def _columns(message: str, prefix: str = "", *, repeated: bool = True) -> _Fields:
    """Return the fields of the columns, numbered by one of their attributes; 0 omits a column."""
    numbered = {each.name: getattr(each, message) for each in RECORDED_FIELDS}
    return {
        prefix + name: (number, _DOUBLE, repeated) for name, number in numbered.items() if number
    }


_MESSAGES: dict[str, _Fields] = {
    "SampleBlock": {
        "tick0": (1, _UINT64, False),  # index of the first sample since the start of the run
        "n": (2, _UINT32, False),
        "dropped": (3, _UINT64, False),  # samples missing before this block
        "t_rel": (4, _DOUBLE, True),  # s since the start of the run
        "flags": (9, _UINT32, True),
        # In the first block and after a gap, to start a replay: the compensator's memory and the
        # command before it.
        "state": (14, _DOUBLE, True),
        "previous_command": (15, _DOUBLE, True),
        # Auxiliary channels: the values of each exchange, one exchange after the other.
        "aux": (19, _DOUBLE, True),
        **_columns("block"),
    },
    "TickBlock": {
        "first_sample": (1, _UINT64, True),
        "deadline_ns": (2, _SINT64, True),  # since the start of the run
        "late_ns": (3, _SINT64, True),
        "exchange_ns": (4, _SINT64, True),
    },
    "Sample": {
        "sample": (1, _UINT64, False),
        "t_rel": (2, _DOUBLE, False),
        "flags": (7, _UINT32, False),
        **_columns("scope", repeated=False),
    },
    "Event": {
        "sample": (1, _UINT64, False),
        "level": (2, _STRING, False),
        "code": (3, _STRING, False),
        "text": (4, _STRING, False),
        # The last samples up to it.
        "before_sample": (5, _UINT64, True),
        "before_flags": (10, _UINT32, True),
        **_columns("before", "before_"),
        # Values of the event by name.
        "value_names": (13, _STRING, True),
        "values": (14, _DOUBLE, True),
    },
}


@cache
def file_descriptor(*, lists_as_bytes: bool = False) -> descriptor_pb2.FileDescriptorProto:
    """Return the descriptor of all messages, or of their twins with ``bytes`` for packed lists."""
    file = descriptor_pb2.FileDescriptorProto(name=_FILE, package=_PACKAGE, syntax="proto3")
    for message_name, fields in _MESSAGES.items():
        message = file.message_type.add(name=message_name)
        for name, (number, kind, repeated) in sorted(fields.items(), key=lambda each: each[1]):
            field = message.field.add(name=name, number=number, type=kind)
            labels = descriptor_pb2.FieldDescriptorProto
            field.label = labels.LABEL_REPEATED if repeated else labels.LABEL_OPTIONAL
            if lists_as_bytes and repeated and kind in {_DOUBLE, _UINT32}:
                field.type, field.label = labels.TYPE_BYTES, labels.LABEL_OPTIONAL
    return file


def descriptor_set() -> bytes:
    """Return the serialized FileDescriptorSet, the schema of every topic."""
    return descriptor_pb2.FileDescriptorSet(file=[file_descriptor()]).SerializeToString()


@cache
def message_class(name: str, *, lists_as_bytes: bool = False) -> Any:
    """Return the class of a message, typed Any because its fields exist only at run time."""
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file_descriptor(lists_as_bytes=lists_as_bytes))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))
