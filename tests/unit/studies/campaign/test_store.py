"""A campaign's folder."""

import os

import pytest

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import TextFiles
from hilctl.experiment.preflight import check
from hilctl.run.start import RunKey
from hilctl.run.unpaced import run_unpaced
from hilctl.studies.campaign.store import (
    await_runs,
    campaign_folder,
    held_folder,
    last_begun,
    make_whole,
    new_recording,
    standing_runs,
)
from tests.unit.studies.campaign.conftest import CAMPAIGN


def never(seconds):
    raise AssertionError(seconds)


@pytest.fixture
def recorded(campaign, tmp_path):
    """Run the first step of a campaign into a file; return that, and what it is of."""

    def make(name):
        few = campaign()
        loaded = few.load(few.steps[0], TextFiles())
        run_unpaced(check(loaded), tmp_path / name)
        return tmp_path / name, RunKey.of(loaded)

    return make


def test_where_a_campaign_goes(campaign):
    assert str(campaign_folder(campaign())) == "recordings/few"
    assert str(campaign_folder(campaign(CAMPAIGN, "recording.folder=/lab"))) == "/lab/few"
    assert str(campaign_folder(campaign(CAMPAIGN + "set: {recording: {folder: day}}"))) == "day/few"
    assert str(campaign_folder(campaign(CAMPAIGN + "folder: /there"))) == "/there"
    few = campaign()
    few.experiment.unlink()
    with pytest.raises(ConfigError, match=r"few.yaml:2: experiment: "):
        campaign_folder(few)


def test_one_campaign_at_a_time(tmp_path):
    """Another one waits a little, for one that is just ending."""
    folder, waits = tmp_path / "runs", []
    with held_folder(folder, never):
        with (
            pytest.raises(InputError, match="another campaign"),
            held_folder(folder, waits.append),
        ):
            pass
        assert 3.0 < sum(waits) < 10.0
    with held_folder(folder, never):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can't be made"), held_folder(tmp_path / "file", never):
        pass


def test_a_refusal_leaves_no_folder_that_it_has_made(tmp_path):
    """Nothing is written where there is a mistake; what stood there before is somebody's."""
    (tmp_path / "mine").mkdir()
    for name in ("mine", "new/deep"):
        with pytest.raises(InputError, match="wrong"), held_folder(tmp_path / name, never):
            raise InputError("wrong")
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]


def test_only_completed_runs_stand(recorded, tmp_path):
    """By what they are of; not one that was cut short, and not other files."""
    path, key = recorded("a.mcap")
    again, _ = recorded("b.mcap")
    content = path.read_bytes()
    (tmp_path / "torn.mcap").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.mcap").write_text("no recording")
    assert standing_runs(tmp_path) == {key: [path, again]}
    assert last_begun(tmp_path) == again


def test_what_was_cut_short_is_made_whole(recorded, tmp_path):
    """It still counts for nothing, but any program can read it."""
    path, key = recorded("a.mcap")
    content = path.read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(content[: len(content) // 2])
    (tmp_path / "text.mcap").write_text("no recording")
    assert [text.startswith(f"{torn}: ") for text in make_whole(tmp_path)] == [True]
    assert make_whole(tmp_path) == []
    assert standing_runs(tmp_path) == {key: [path]}
    assert last_begun(tmp_path / "absent") is None


def test_what_was_killed_before_its_run_began_is_out_of_the_way(recorded, tmp_path):
    """Nobody should have to wonder about a file with nothing in it; other files stay."""
    path, _ = recorded("a.mcap")
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "head.mcap").write_bytes(path.read_bytes()[:20])
    (tmp_path / "text.mcap").write_text("no recording")
    assert len(make_whole(tmp_path)) == 2
    left = {each.name for each in tmp_path.iterdir() if each.suffix != ".yaml"}
    assert left == {"a.mcap", "head.mcap.torn", "text.mcap"}


def test_what_is_no_file_is_no_recording(recorded, tmp_path):
    """A folder, a pipe and a link that leads nowhere keep no campaign from going on."""
    path, key = recorded("a.mcap")
    (tmp_path / "b.mcap").mkdir()
    os.mkfifo(tmp_path / "c.mcap")
    (tmp_path / "d.mcap").symlink_to("nowhere")
    (tmp_path / "e.mcap").symlink_to("b.mcap")
    assert make_whole(tmp_path) == []
    assert standing_runs(tmp_path) == {key: [path]}
    assert last_begun(tmp_path) == path


def test_names_are_never_taken_twice(tmp_path):
    first = new_recording(tmp_path, "few", 7)
    assert first.name == "few-0007.mcap"
    first.symlink_to("nowhere")
    assert new_recording(tmp_path, "few", 7).name == "few-0007-2.mcap"


def test_a_run_that_records_there_is_waited_for(tmp_path, monkeypatch):
    """One whose supervisor lives is somebody's; one without ends soon."""

    class Run:
        card = type("Card", (), {"recording": str(tmp_path / "a.mcap"), "name": "a-1"})
        alive, supervised = True, False

    waits = []

    def wait(seconds):
        waits.append(seconds)
        Run.alive = len(waits) < 3

    monkeypatch.setattr("hilctl.studies.campaign.store.runs", lambda: [Run])
    await_runs(tmp_path / "other", never)
    await_runs(tmp_path, wait)
    assert len(waits) == 3
    Run.alive = Run.supervised = True
    with pytest.raises(InputError, match="a-1"):
        await_runs(tmp_path, never)
