"""Text files are read once, and not at all once the texts are given."""

import pytest

from hilctl.base.errors import InputError
from hilctl.base.files import TextFiles


def test_file_is_read_once(tmp_path):
    """What is asked for again is what was read first."""
    path = tmp_path / "model.yaml"
    path.write_text("first")
    files = TextFiles()
    assert files.read(path) == "first"
    path.write_text("second")
    assert files.read(path) == "first"


def test_given_texts_stand_for_the_disk(tmp_path, monkeypatch):
    """The other process finds the same texts by the same paths, from another folder too."""
    path = tmp_path / "model.yaml"
    path.write_text("first")
    monkeypatch.chdir(tmp_path)
    files = TextFiles()
    files.read(type(path)("model.yaml"))
    path.write_text("second")
    assert TextFiles(files.texts).read(path) == "first"


def test_nothing_else_is_read_where_texts_are_given(tmp_path):
    """A file that nobody has checked is refused."""
    path = tmp_path / "other.yaml"
    path.write_text("text")
    with pytest.raises(InputError, match="was not read when the experiment was checked"):
        TextFiles({}).read(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "is not a file"),
        (lambda path: path.write_bytes(b"\xff\xfe\x00"), "is not UTF-8 text"),
    ],
)
def test_unreadable_files_are_told(tmp_path, make, message):
    """Each reason has its message, with the path."""
    path = tmp_path / "thing"
    make(path)
    with pytest.raises(InputError, match=f"thing: {message}"):
        TextFiles().read(path)
