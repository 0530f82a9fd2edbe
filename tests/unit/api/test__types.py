"""Conversion of settings and paths."""

from pathlib import Path

import pytest

from hilctl.api._types import path_or_none, paths_of, texts_of


def test_values_become_texts_that_yaml_reads_back():
    given = {"a.b": 1e-7, "name": 'µ "x": y', "list": [1, None, True], "map": {"k": "v"}}
    texts = ["a.b=1e-07", 'name="µ \\"x\\": y"', "list=[1, null, true]", 'map={"k": "v"}']
    assert texts_of(given) == texts
    assert texts_of(("a=1", "b=2")) == ["a=1", "b=2"]
    with pytest.raises(TypeError):
        texts_of({"a": object()})


def test_one_path_or_several():
    assert paths_of("a") == paths_of(Path("a")) == paths_of(["a"]) == [Path("a")]
    assert paths_of(()) == []
    assert (path_or_none(None), path_or_none("x")) == (None, Path("x"))
