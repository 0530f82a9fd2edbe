"""A recording that is taken away while it is written: what was in it is kept."""

import errno
from pathlib import Path

import pytest

from hilctl.run.kept_file import is_emptied, put_back


@pytest.fixture
def written(tmp_path):
    """An open file with some bytes, and its name."""
    path = tmp_path / "run.mcap"
    with path.open("xb") as stream:
        stream.write(b"before ")
        stream.flush()
        yield path, stream


def go_on(stream):
    stream.write(b"after")
    stream.flush()


def test_a_file_under_its_name_is_left_alone(written):
    path, stream = written
    assert put_back(path, stream.fileno()) == (path, "")
    assert not is_emptied(stream.fileno(), 7)


def test_a_file_that_was_deleted_goes_on_in_a_copy(written):
    path, stream = written
    path.unlink()
    at, done = put_back(path, stream.fileno())
    go_on(stream)
    assert at == path
    assert "was deleted" in done
    assert path.read_bytes() == b"before after"
    assert put_back(path, stream.fileno()) == (path, "")


def test_a_name_that_somebody_has_taken_is_left_to_him(written):
    path, stream = written
    path.unlink()
    path.write_bytes(b"mine")
    at, _ = put_back(path, stream.fileno())
    go_on(stream)
    assert at == path.with_name("run-2.mcap")
    assert (path.read_bytes(), at.read_bytes()) == (b"mine", b"before after")


def test_a_file_that_was_renamed_gets_its_name_back(written):
    path, stream = written
    moved = path.rename(path.with_name("moved.mcap"))
    at, done = put_back(path, stream.fileno())
    go_on(stream)
    assert at == path
    assert str(moved) in done
    assert path.read_bytes() == moved.read_bytes() == b"before after"


def test_a_renamed_file_whose_name_is_taken_stays_where_it_is(written):
    path, stream = written
    moved = path.rename(path.with_name("moved.mcap"))
    path.write_bytes(b"mine")
    at, done = put_back(path, stream.fileno())
    assert at == moved
    assert "stays there" in done
    assert path.read_bytes() == b"mine"


def test_a_folder_that_is_gone_is_an_error(written):
    """The samples can't be put back where there is no place for them: nothing is passed over."""
    path, stream = written
    path.unlink()
    with pytest.raises(FileNotFoundError):
        put_back(Path(path.parent, "gone", path.name), stream.fileno())


def test_a_file_that_was_emptied_is_found(written):
    path, stream = written
    path.open("wb").close()
    assert is_emptied(stream.fileno(), 7)
    go_on(stream)
    assert path.stat().st_size == 12
    assert is_emptied(stream.fileno(), 7)


def test_half_a_copy_is_not_left_behind(written, monkeypatch):
    """A full disk refuses it: the next attempt may find room under the same name."""
    path, stream = written
    path.unlink()

    def full(content, copy):
        copy.write(b"be")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("hilctl.run.kept_file.shutil.copyfileobj", full)
        with pytest.raises(OSError, match="No space left"):
            put_back(path, stream.fileno())
    assert not path.exists()
    assert put_back(path, stream.fileno())[0] == path
    assert path.read_bytes() == b"before "
