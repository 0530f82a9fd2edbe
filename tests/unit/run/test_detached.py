"""Runs in the background: where what they print goes."""

from hilctl.run.detached import free_log


def test_no_log_takes_the_place_of_another_file(tmp_path):
    output = tmp_path / "run.mcap"
    assert free_log(output) == tmp_path / "run.log"
    (tmp_path / "run.log").write_text("mine")
    (tmp_path / "run.2.log").symlink_to(tmp_path / "nowhere")
    assert free_log(output) == tmp_path / "run.3.log"
