"""Names of recordings that were not named, and where they go."""

import time
from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.run.start import checked_experiment, default_output, output_of

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
NOON = time.struct_time((2026, 1, 2, 12, 0, 5, 4, 2, 0))


def test_a_name_that_is_taken_gets_a_number(tmp_path):
    """Also one that a link leads nowhere from: nothing is written through it."""
    assert default_output("sine", tmp_path, NOON) == tmp_path / "sine-20260102-120005.mcap"
    (tmp_path / "sine-20260102-120005.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "sine-20260102-120005-2.mcap").touch()
    assert default_output("sine", tmp_path, NOON) == tmp_path / "sine-20260102-120005-3.mcap"


def test_the_folder_of_the_experiment_is_made(tmp_path):
    folder = tmp_path / "new" / "runs"
    checked = checked_experiment(DEMO, [f"recording.folder={folder}"])
    assert output_of(checked, tmp_path / "mine.mcap") == tmp_path / "mine.mcap"
    assert not folder.exists()
    assert output_of(checked, None).parent == folder
    assert folder.is_dir()


def test_a_folder_that_can_not_be_made_is_said(tmp_path):
    (tmp_path / "file").touch()
    checked = checked_experiment(DEMO, [f"recording.folder={tmp_path / 'file' / 'runs'}"])
    with pytest.raises(InputError, match="can't be made: Not a directory"):
        output_of(checked, None)
