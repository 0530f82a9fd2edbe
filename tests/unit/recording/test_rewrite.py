"""A survey of what a file holds, and the sound file that is made of it."""

import io

import pytest
from mcap.reader import make_reader

from hilctl.recording.recovery_scan import RecoveryScan
from hilctl.recording.rewrite import Rewritten, Survey


@pytest.fixture
def torn(make):
    """A recording of 400 samples, cut behind its last chunk."""
    stream = io.BytesIO()
    make.write(stream, [make.batch(0, 8)], finish=False)
    return stream


def resaved(survey, **finish):
    out = io.BytesIO()
    saved = Rewritten(out, survey)
    saved.copy(RecoveryScan(survey.scan._stream).records())
    reason = saved.finish(**{"end": None, "ended_at": 0, **finish})
    facts = {m.name: m.metadata for m in make_reader(io.BytesIO(out.getvalue())).iter_metadata()}
    return saved, reason, facts["hilctl.end"]


def test_a_survey_counts_what_is_whole(torn):
    survey = Survey(torn)
    assert (survey.samples, survey.next_sample) == (400, 400)
    assert survey.run["compensator"] == "rdpi"
    assert survey.end == {}
    assert not survey.scan.sound


def test_what_is_not_known_is_said(torn):
    """Without a record of the end nobody knows what was exchanged behind the last sample."""
    saved, reason, end = resaved(Survey(torn))
    assert saved.missing == 0
    assert "the last sample is 399" in reason
    assert "at most the last unflushed interval" in reason
    assert (end["code"], end["recorded_samples"]) == ("recovered", "400")


def test_what_is_known_to_be_missing_is_counted(torn):
    """The loop's own count of what it exchanged goes before the file."""
    saved, reason, end = resaved(Survey(torn), end={"code": "fault", "reason": "x"}, ended_at=450)
    assert saved.missing == 50
    assert "50 samples known to be missing" in reason
    assert (end["code"], end["missing_samples"]) == ("fault", "50")


def test_a_run_that_lost_nothing_says_so(torn):
    _, reason, _ = resaved(Survey(torn), ended_at=400)
    assert reason.endswith("no sample is lost")
