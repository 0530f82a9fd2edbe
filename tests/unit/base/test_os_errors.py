"""What is said of files and ports that can't be had: the system's words, and what to do."""

import errno
import os

import pytest

from hilctl.base.os_errors import (
    ADDRESS_REMEDIES,
    CONNECT_REMEDIES,
    PORT_REMEDIES,
    REMEDIES,
    no_such_file,
    reason,
)


@pytest.mark.parametrize("remedies", [REMEDIES, ADDRESS_REMEDIES, CONNECT_REMEDIES, PORT_REMEDIES])
def test_the_systems_words_come_first(remedies):
    for code, remedy in remedies.items():
        assert (
            reason(OSError(code, os.strerror(code)), remedies) == f"{os.strerror(code)} ({remedy})"
        )


def test_what_is_not_known_is_said_as_it_is():
    assert reason(OSError(errno.EIO, "Input/output error")) == "Input/output error"
    assert reason(TimeoutError("timed out")) == "timed out"


def test_the_file_that_is_likely_to_be_meant(tmp_path):
    (tmp_path / "terfenol_sine_6a.yaml").touch()
    meant = no_such_file(tmp_path / "terfenol_sine.yaml")
    assert meant.endswith(
        "terfenol_sine.yaml: no such file (did you mean 'terfenol_sine_6a.yaml'?)"
    )
    assert no_such_file(tmp_path / "other.csv").endswith("other.csv: no such file")
    lost = no_such_file(tmp_path / "lost" / "x.yaml")
    assert lost.endswith(f"(there is no folder {tmp_path / 'lost'})")
