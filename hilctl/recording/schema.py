"""Protobuf messages of a recording's topics, and the descriptors that make a file self-describing.

Field numbers are for ever: a number that was used once is not used again.
"""

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

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
"""Topic to message name; all are of package ``hilctl``."""

# name: (number, type, repeated); units are in the names, V replacing A for voltage-driven devices
_MESSAGES: dict[str, dict[str, tuple[int, Any, bool]]] = {
    "SampleBlock": {
        "tick0": (1, _UINT64, False),  # index of the first sample since the start of the run
        "n": (2, _UINT32, False),
        "dropped": (3, _UINT64, False),  # samples missing before this block
        "t_rel": (4, _DOUBLE, True),  # s since the start of the run
        "reference_um": (5, _DOUBLE, True),
        "wanted_a": (6, _DOUBLE, True),  # before the limiter
        "current_a": (7, _DOUBLE, True),  # put out
        "displacement_um": (8, _DOUBLE, True),
        "flags": (9, _UINT32, True),
        "measured_a": (10, _DOUBLE, True),
        "wanted_v": (11, _DOUBLE, True),
        "drive_v": (12, _DOUBLE, True),
        "measured_v": (13, _DOUBLE, True),
        # Where a block stands first or after a gap: the compensator's memory before it, and the
        # command before it, so that it can be replayed by itself.
        "state": (14, _DOUBLE, True),
        "previous_command": (15, _DOUBLE, True),
        "input_um": (16, _DOUBLE, True),  # what the compensator was fed, where not the reference
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
        "reference_um": (3, _DOUBLE, False),
        "wanted_a": (4, _DOUBLE, False),
        "current_a": (5, _DOUBLE, False),
        "displacement_um": (6, _DOUBLE, False),
        "flags": (7, _UINT32, False),
        "wanted_v": (8, _DOUBLE, False),
        "drive_v": (9, _DOUBLE, False),
    },
    "Event": {
        "sample": (1, _UINT64, False),
        "level": (2, _STRING, False),
        "code": (3, _STRING, False),
        "text": (4, _STRING, False),
        # The last samples up to it, so that one message tells what led there.
        "before_sample": (5, _UINT64, True),
        "before_reference_um": (6, _DOUBLE, True),
        "before_wanted_a": (7, _DOUBLE, True),
        "before_current_a": (8, _DOUBLE, True),
        "before_displacement_um": (9, _DOUBLE, True),
        "before_flags": (10, _UINT32, True),
        "before_wanted_v": (11, _DOUBLE, True),
        "before_drive_v": (12, _DOUBLE, True),
    },
}


@cache
def file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    """Return the descriptor of all messages."""
    file = descriptor_pb2.FileDescriptorProto(name=_FILE, package=_PACKAGE, syntax="proto3")
    for message_name, fields in _MESSAGES.items():
        message = file.message_type.add(name=message_name)
        for name, (number, kind, repeated) in fields.items():
            field = message.field.add(name=name, number=number, type=kind)
            labels = descriptor_pb2.FieldDescriptorProto
            field.label = labels.LABEL_REPEATED if repeated else labels.LABEL_OPTIONAL
    return file


def descriptor_set() -> bytes:
    """Return the serialized FileDescriptorSet that goes into the file as every topic's schema."""
    return descriptor_pb2.FileDescriptorSet(file=[file_descriptor()]).SerializeToString()


@cache
def message_class(name: str) -> type[Message]:
    """Return the class of a message by its name without the package."""
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file_descriptor())
    found: type[Message] = message_factory.GetMessageClass(
        pool.FindMessageTypeByName(f"{_PACKAGE}.{name}")
    )
    return found


def message(name: str) -> Any:
    """Return an empty message; typed Any, because its fields exist only at run time."""
    return message_class(name)()
