"""Entry points of installed packages."""

from hilctl.base.plugins import EXPORT_FORMATS, TABLE_READERS, registered
from hilctl.lab import mat_file


def test_the_lab_registers_matlab_files():
    assert registered(TABLE_READERS)["mat"].load() is mat_file.read
    assert registered(EXPORT_FORMATS)["mat"].load() is mat_file.MatFile


def test_an_unknown_group_is_empty():
    assert registered("hilctl.nothing") == {}
