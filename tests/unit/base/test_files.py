"""Text files are read once, or not at all if the texts are given; files are written completely."""

import errno
import os
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.base.files import (
    ADDRESS_REMEDIES,
    CONNECT_REMEDIES,
    PORT_REMEDIES,
    REMEDIES,
    TextFiles,
    check_writable,
    no_such_file,
    read_text,
    reason,
    sync_folder,
    write_file,
    write_text,
)


def test_file_is_read_once(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text("first")
    files = TextFiles()
    assert files.read(path) == "first"
    path.write_text("second")
    assert files.read(path) == "first"


def test_given_texts_replace_the_files(tmp_path, monkeypatch):
    path = tmp_path / "model.yaml"
    path.write_text("first")
    monkeypatch.chdir(tmp_path)
    files = TextFiles()
    files.read(type(path)("model.yaml"))
    path.write_text("second")
    assert TextFiles(files.texts).read(path) == "first"


def test_files_without_a_given_text_are_refused(tmp_path):
    path = tmp_path / "other.yaml"
    path.write_text("text")
    with pytest.raises(InputError, match=r"other\.yaml"):
        TextFiles({}).read(path)


@pytest.mark.parametrize(("make", "message"), [
    (lambda path: None, "no such file"),
    (lambda path: path.mkdir(), "is not a file"),
    (lambda path: path.write_bytes(b"\xff\xfe\x00"), "is not UTF-8 text"),
])  # fmt: skip
def test_unreadable_files_are_refused(tmp_path, make, message):
    path = tmp_path / "thing"
    make(path)
    with pytest.raises(InputError, match=f"thing: {message}"):
        TextFiles().read(path)


def test_a_text_too_large_is_not_read(tmp_path):
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        stream.truncate(20_000_000)
    with pytest.raises(InputError, match=r"20 MB.* 17 MB"):
        read_text(path)


class TestWriting:
    def test_new_file(self, tmp_path):
        path = tmp_path / "out.txt"
        plain = tmp_path / "plain"
        plain.touch()
        write_text(path, "prüf μm\n", overwrite=False)
        assert path.read_bytes() == "prüf μm\n".encode()
        assert path.stat().st_mode == plain.stat().st_mode
        assert sorted(tmp_path.iterdir()) == [path, plain]

    def test_what_exists_is_kept_or_replaced(self, tmp_path):
        path = tmp_path / "out.txt"
        path.write_text("precious")
        link = tmp_path / "link"
        link.symlink_to(path.name)
        for name in (path, link):
            with pytest.raises(InputError, match="or overwrite"):
                write_text(name, "new", overwrite=False)
            with pytest.raises(InputError, match="exists already"):
                check_writable(name, overwrite=False)
            check_writable(name, overwrite=True)
        assert path.read_text() == "precious"
        write_text(link, "new", overwrite=True)
        assert path.read_text() == "new"
        assert link.is_symlink()
        assert sorted(tmp_path.iterdir()) == [link, path]

    def test_folder_is_not_overwritten(self, tmp_path):
        with pytest.raises(InputError, match="is a folder"):
            write_text(tmp_path, "new", overwrite=False)

    @pytest.mark.parametrize("links", [True, False])
    def test_file_created_meanwhile_is_kept(self, tmp_path, monkeypatch, links):
        path = tmp_path / "out.txt"
        if not links:
            monkeypatch.setattr(Path, "hardlink_to", _refuse)

        def write(stream):
            stream.write(b"mine")
            path.write_text("theirs")

        with pytest.raises(InputError, match=r"out\.txt"):
            write_file(path, write, overwrite=False)
        assert path.read_text() == "theirs"
        assert list(tmp_path.iterdir()) == [path]

    def test_without_hard_links(self, tmp_path, monkeypatch):
        monkeypatch.setattr(Path, "hardlink_to", _refuse)
        write_text(tmp_path / "out.txt", "text", overwrite=False)
        assert (tmp_path / "out.txt").read_text() == "text"
        monkeypatch.setattr(Path, "replace", _refuse)
        with pytest.raises(InputError, match=r"other\.txt: .*: Operation"):
            write_text(tmp_path / "other.txt", "text", overwrite=False)
        assert [each.name for each in tmp_path.iterdir()] == ["out.txt"]

    @pytest.mark.parametrize("overwrite", [True, False])
    @pytest.mark.parametrize(
        "error", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError()]
    )
    def test_interrupted_write_leaves_nothing(self, tmp_path, overwrite, error):
        path = tmp_path / "out.txt"
        if overwrite:
            path.write_text("precious")

        def write(stream):
            stream.write(b"half of it")
            stream.flush()
            assert path.exists() == overwrite
            raise error

        wanted = InputError if isinstance(error, OSError) else type(error)
        with pytest.raises(wanted) as caught:
            write_file(path, write, overwrite=overwrite)
        if wanted is InputError:
            assert str(caught.value).startswith(f"{path}: cannot be written: No space left")
        left = [each.read_text() for each in tmp_path.iterdir()]
        assert left == (["precious"] if overwrite else [])

    def test_failed_sync_leaves_nothing(self, tmp_path, monkeypatch):
        monkeypatch.setattr(os, "fsync", _refuse)
        with pytest.raises(
            InputError, match=r"out\.txt: cannot be written: Operation not permitted"
        ):
            write_text(tmp_path / "out.txt", "text", overwrite=False)
        assert list(tmp_path.iterdir()) == []

    def test_folder_that_cannot_be_synced_is_an_error(self, tmp_path, monkeypatch):
        for number in (errno.EINVAL, errno.EIO):
            monkeypatch.setattr(os, "fsync", partial(_refuse_by, number))
            refused = pytest.raises(OSError, match="Input/output")
            with refused if number == errno.EIO else nullcontext():
                sync_folder(tmp_path)

    def test_special_files_are_not_replaced(self, tmp_path):
        os.mkfifo(tmp_path / "pipe")
        for path in (tmp_path, tmp_path / "pipe"):
            with pytest.raises(InputError, match="cannot be written: Not a regular file"):
                write_text(path, "text", overwrite=True)
        assert (tmp_path / "pipe").is_fifo()

    @pytest.mark.parametrize(
        ("name", "reason"),
        [("lost/out.txt", "No such file or directory"), ("plain/out.txt", "Not a directory"),
         ("x" * 300, "File name too long")],
    )  # fmt: skip
    @pytest.mark.parametrize("overwrite", [True, False])
    def test_unwritable_places_are_refused(self, tmp_path, name, reason, overwrite):
        (tmp_path / "plain").touch()
        with pytest.raises(InputError, match=f"cannot be written: {reason}") as caught:
            write_text(tmp_path / name, "text", overwrite=overwrite)
        assert str(caught.value).startswith(str(tmp_path / name))

    def test_long_names(self, tmp_path):
        write_text(tmp_path / ("x" * 255), "text", overwrite=False)
        write_text(tmp_path / ("x" * 255), "again", overwrite=True)


def _refuse_by(number, _):
    raise OSError(number, os.strerror(number))


def _refuse(*_arguments):
    raise PermissionError(1, "Operation not permitted")


@pytest.mark.parametrize("name", ["folder", "fifo", "null", "missing/out.txt", "x" * 300])
def test_unwritable_output_is_refused_in_advance(tmp_path, name):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "null").symlink_to("/dev/null")
    before = sorted(tmp_path.iterdir())
    said = []
    for write in (check_writable, partial(write_text, text="new")):
        with pytest.raises(InputError, match=f"{name}: cannot be written") as refused:
            write(tmp_path / name, overwrite=True)
        said.append(str(refused.value))
    assert said[0] == said[1]
    assert sorted(tmp_path.iterdir()) == before


def test_writable_output_is_not_touched(tmp_path):
    (tmp_path / "old.txt").write_text("old")
    check_writable(tmp_path / "old.txt", overwrite=True)
    check_writable(tmp_path / "new.txt", overwrite=False)
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("old.txt", "old")]


@pytest.mark.parametrize("remedies", [REMEDIES, ADDRESS_REMEDIES, CONNECT_REMEDIES, PORT_REMEDIES])
def test_reason_begins_with_the_text_of_the_system(remedies):
    for code, remedy in remedies.items():
        for error in (OSError(code, os.strerror(code)), OSError(code, "words of a library")):
            assert reason(error, remedies) == f"{os.strerror(code)} ({remedy})"


def test_unknown_error_is_its_text():
    assert reason(OSError(errno.EIO, "Input/output error")) == "Input/output error"
    assert reason(TimeoutError("timed out")) == "timed out"


def test_similar_file_is_suggested(tmp_path):
    (tmp_path / "terfenol_sine_6a.yaml").touch()
    meant = no_such_file(tmp_path / "terfenol_sine.yaml")
    assert meant.endswith(
        "terfenol_sine.yaml: no such file (did you mean 'terfenol_sine_6a.yaml'?)"
    )
    assert "terfenol_sine_6a.yaml" in no_such_file(tmp_path / "terfenol_sine_6a")
    for name in ("other.csv", "terfenol_sine_6a.html"):
        assert no_such_file(tmp_path / name).endswith(f"{name}: no such file")
    (tmp_path / "link.csv").symlink_to("gone.csv")
    assert no_such_file(tmp_path / "link.csv").endswith("(it is a link to gone.csv)")
    lost = no_such_file(tmp_path / "lost" / "x.yaml")
    assert lost.endswith(f"(there is no folder {tmp_path / 'lost'})")
