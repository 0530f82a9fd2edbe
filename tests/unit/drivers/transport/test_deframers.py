"""Messages out of a stream in any pieces, and the way back after rubbish."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl_drivers.transport.deframers import DelimitedSplitter, PrefixedSplitter
from hilctl_drivers.transport.links import CorruptError


def text(part):
    if b"x" in part:
        raise CorruptError("an x")
    return bytes(part)


def lines(*, skip_empty=False):
    return DelimitedSplitter(text, b"\r\n", 8, skip_empty=skip_empty)


def size_at(buffer, at):
    """A length, which must be at least 1, then as many bytes."""
    if len(buffer) == at:
        return 0
    if not 1 <= buffer[at] <= 4:
        raise CorruptError(f"length {buffer[at]}")
    return 1 + buffer[at]


def frames():
    return PrefixedSplitter(size_at, lambda frame: text(frame[1:]))


def said(found):
    return [str(each) if isinstance(each, CorruptError) else each for each in found]


@given(st.lists(st.integers(1, 5)))
def test_any_cut_gives_the_same_messages(sizes):
    data, split = b"ab\r\ncd\r\n\r\ne\r\n", lines()
    found, at = [], 0
    for size in [*sizes, len(data)]:
        found += split.feed(data[at : at + size])
        at += size
    assert found == [b"ab", b"cd", b"", b"e"]


def test_empty_messages_can_be_left_out():
    assert lines(skip_empty=True).feed(b"\r\n\r\na\r\n") == [b"a"]


def test_one_bad_message_costs_no_other():
    assert said(lines().feed(b"a\r\nx\r\nb\r\n")) == [b"a", "an x", b"b"]


def test_what_never_ends_is_told_once_and_dropped():
    """Memory stays small, and the message after the next end is whole."""
    split = lines()
    found = [each for _ in range(100) for each in split.feed(b"z" * 10)]
    assert said(found) == ["no end within 8 bytes"]
    assert len(split._buffer) <= 12
    assert split.feed(b"zz\r\nok\r\n") == [b"ok"]


@pytest.mark.parametrize("make", [lines, frames])
def test_reset_forgets_what_has_begun(make):
    split = make()
    split.feed(b"\x03a")
    split.reset()
    assert split.feed(b"\x01b\r\n" if make is frames else b"b\r\n")[0] == b"b"


def test_frames_find_their_way_back_byte_by_byte():
    """A stretch of rubbish is told once, however long, and again only behind a good frame."""
    split = frames()
    assert split.feed(b"\x02ab\x03cd") == [b"ab"]
    assert split.feed(b"e") == [b"cde"]
    found = said(split.feed(b"\x00\x09\x07\x01k\x00\x01m"))
    assert found == ["length 0", b"k", "length 0", b"m"]
