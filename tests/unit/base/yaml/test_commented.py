"""Plain data with comments: read back the same, and each comment where it belongs."""

from hilctl.base.yaml.commented import commented
from hilctl.base.yaml.document import Document

DATA = {
    "name": "sine",
    "on": "yes",
    "device": {"kind": "a: b", "gain": -2.5, "none": None, "deep": {"x": 1, "list": [1.0, 2.0]}},
    "limits": {"drive_v": [0.0, 20.0]},
    "empty": {},
    "long": "a word and another " * 8,
}


def test_read_back_it_is_the_same():
    text = commented(DATA, {"device": "above", "device.gain": "behind", "long": "before"})
    read = Document("f.yaml", text).data
    assert read == {**DATA, "device": {**DATA["device"], "deep": {"x": 1, "list": (1.0, 2.0)}},
                    "limits": {"drive_v": (0.0, 20.0)}}  # fmt: skip


def test_each_comment_stands_with_its_value():
    comments = {"device": "all of it", "device.gain": "A/V", "limits.drive_v": "low, high"}
    lines = commented(DATA, comments).splitlines()
    assert "device:  # all of it" in lines
    assert "  gain: -2.5  # A/V" in lines
    assert "  drive_v: [0.0, 20.0]  # low, high" in lines
    assert sum("#" in line for line in lines) == len(comments)


def test_a_comment_of_a_text_over_several_lines_stands_above_it():
    lines = commented(DATA, {"long": "what it is for"}).splitlines()
    assert lines[lines.index("# what it is for") + 1].startswith("long: 'a word")
