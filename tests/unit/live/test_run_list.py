"""Which runs a server shows, by their folders."""

from pathlib import Path

import pytest

from hilctl.live.run_list import RunList
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.start import checked_experiment

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


@pytest.fixture(scope="module")
def description():
    return RunDescription.of(checked_experiment(DEMO, []))


def first(runs):
    return runs[0] if runs else None


def begun(folder, description):
    description.write(folder.description)
    SampleRing.create(folder.ring, slots=16, block=50, state_size=1)


def test_a_run_is_found_as_it_starts_and_let_go_once_nobody_looks(description, tmp_path):
    feeds = RunList(first)
    feeds.look(0.0)
    assert feeds.feed(None) is None
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        begun(folder, description)
        feeds.look(0.5)
        assert feeds.feed(None) is None  # runs are looked for once a second
        feeds.look(1.0)
        feed = feeds.feed(folder.card.name)
        assert feed is feeds.feed(None)
        assert list(feeds) == [feed]
    feed.poll(1.0)
    assert feed.ended
    feeds.look(2.0, [None])
    assert list(feeds) == [feed]  # the main one stays until there is another
    with run_folder("other", tmp_path / "b.mcap", 12.0) as (folder, _):
        begun(folder, description)
        feeds.look(3.0)
        assert feeds.feed(None) is feeds.feed(folder.card.name)
        feeds.look(4.0)
        assert [each.folder for each in feeds] == [folder]


def test_a_run_that_is_still_being_started_is_asked_for_again(description, tmp_path):
    feeds = RunList(first)
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        feeds.look(0.0)
        assert feeds.feed(None) is None
        begun(folder, description)
        assert feeds.feed(None).folder == folder
