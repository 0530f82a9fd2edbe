"""Conversion of paths."""

from pathlib import Path

from hilctl.api._types import path_or_none, paths_of


def test_one_path_or_several():
    assert paths_of("a") == paths_of(Path("a")) == paths_of(["a"]) == [Path("a")]
    assert paths_of(()) == []
    assert (path_or_none(None), path_or_none("x")) == (None, Path("x"))
