"""A recording that is taken away while it is written: what was in it is kept."""

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
    assert put_back(path, stream) == (path, "")
    assert not is_emptied(stream, 7)


def test_a_file_that_was_deleted_goes_on_in_a_copy(written):
    path, stream = written
    path.unlink()
    at, done = put_back(path, stream)
    go_on(stream)
    assert at == path
    assert "was deleted" in done
    assert path.read_bytes() == b"before after"
    assert put_back(path, stream) == (path, "")


def test_a_name_that_somebody_has_taken_is_left_to_him(written):
    path, stream = written
    path.unlink()
    path.write_bytes(b"mine")
    at, _ = put_back(path, stream)
    go_on(stream)
    assert at == path.with_name("run-2.mcap")
    assert (path.read_bytes(), at.read_bytes()) == (b"mine", b"before after")


def test_a_file_that_was_renamed_gets_its_name_back(written):
    path, stream = written
    moved = path.rename(path.with_name("moved.mcap"))
    at, done = put_back(path, stream)
    go_on(stream)
    assert at == path
    assert str(moved) in done
    assert path.read_bytes() == moved.read_bytes() == b"before after"


def test_a_renamed_file_whose_name_is_taken_stays_where_it_is(written):
    path, stream = written
    moved = path.rename(path.with_name("moved.mcap"))
    path.write_bytes(b"mine")
    at, done = put_back(path, stream)
    assert at == moved
    assert "stays there" in done
    assert path.read_bytes() == b"mine"


def test_a_folder_that_is_gone_is_an_error(written):
    """The samples can't be put back where there is no place for them: nothing is passed over."""
    path, stream = written
    path.unlink()
    with pytest.raises(FileNotFoundError):
        put_back(Path(path.parent, "gone", path.name), stream)


def test_a_file_that_was_emptied_is_found(written):
    path, stream = written
    path.open("wb").close()
    assert is_emptied(stream, 7)
    go_on(stream)
    assert path.stat().st_size == 12
    assert is_emptied(stream, 7)
