"""Changes of gain and offset: one after another, each from where the one before has led."""

from dataclasses import dataclass, field
from mmap import mmap
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment.tuned import TunedForecast
from hilctl.loop.host import StraightLine, Tuning
from hilctl.run.changes import Changes, RequestedChange
from hilctl.run.shared_page import SIZE, Field, SharedPage, Stop

SAMPLES, RATE_HZ, BLOCK = 100_000, 1000.0, 10
LINE = StraightLine(0.1, -2.0)


@dataclass
class FakeWorker:
    """Answers when it is told to; keeps what it was asked."""

    asked: list = field(default_factory=list)
    answer: object = None
    gone: bool = False

    def begin(self, wanted):
        if self.gone:
            raise InputError("it is gone")
        self.asked.append(wanted)

    def result(self):
        answer, self.answer = self.answer, None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def approve(self, begins_at, heat_a2=0.0):
        """Let the change that was asked for last be within the limits."""
        wanted = self.asked[-1]
        share = wanted.inverse_share
        tuning = Tuning(wanted.gain, wanted.offset, wanted.samples, begins_at, share, LINE)
        self.answer = TunedForecast(tuning, 2.5, False, heat_a2)


@pytest.fixture
def page():
    made = SharedPage(mmap(-1, SIZE))
    made.put(Field.NEXT_SAMPLE, 500)
    return made


@pytest.fixture
def worker():
    return FakeWorker()


@pytest.fixture
def changes(page, worker):
    forecast = SimpleNamespace(samples=SAMPLES, heating_rms_a=2.0, line=LINE)
    limits = SimpleNamespace(tracking_error_um=None)
    config = SimpleNamespace(sample_rate_hz=RATE_HZ, block=BLOCK, limits=limits)
    loaded = SimpleNamespace(config=config, model=object())
    checked = SimpleNamespace(forecast=forecast, loaded=loaded)
    return Changes(checked, SimpleNamespace(ring=Path("ring")), page, worker)


def change(changes, gain=None, offset=None, over_s=2.0, inverse=None):
    made = RequestedChange(gain, offset, over_s, inverse)
    changes.add(made)
    changes.attend()
    return made


def take(page, at):
    """Let the loop take the change on the page, at a sample."""
    page.put(Field.NEXT_SAMPLE, at)
    page.put(Field.TUNE_TAKEN_AT, at)
    page.put(Field.TUNE_TAKEN, page.get(Field.TUNE_WANTED))


def test_a_change_reaches_the_loop_whole_once_it_is_worked_out(changes, page, worker):
    made = change(changes, gain=0.5)
    (wanted,) = worker.asked
    assert (wanted.gain, wanted.offset, wanted.samples, wanted.ring) == (0.5, 0.0, 2000, "ring")
    assert (wanted.tuner.gain, wanted.tuner_at, wanted.heat_a2) == (1.0, 0, 4.0)
    changes.attend()
    assert made.answer() is None
    assert page.get(Field.TUNE_WANTED) == 0
    worker.approve(600)
    changes.attend()
    assert made.answer() == {
        "gain": 0.5,
        "offset": 0.0,
        "inverse": "in",
        "over_s": 2.0,
        "begins_at_sample": 600,
        "checked_s": 2.5,
        "checked_to_the_end": False,
    }
    assert (page.get_float(Field.TUNE_GAIN), page.get_float(Field.TUNE_OFFSET)) == (0.5, 0.0)
    numbers = (Field.TUNE_SAMPLES, Field.TUNE_BEGINS_AT, Field.TUNE_WANTED)
    assert [page.get(each) for each in numbers] == [2000, 600, 1]
    assert (changes.gain, changes.offset) == (0.5, 0.0)


def test_the_second_of_two_follows_the_first(changes, page, worker):
    """It is not begun before the loop has taken the first, and begins where that stands then."""
    first, second = change(changes, gain=0.5), change(changes, offset=3.0)
    worker.approve(600, heat_a2=9.0)
    for _ in range(3):
        changes.attend()
    assert first.answer() is not None
    assert second.answer() is None
    assert len(worker.asked) == 1
    take(page, 610)
    changes.attend()
    wanted = worker.asked[1]
    assert (wanted.gain, wanted.offset, wanted.heat_a2) == (0.5, 3.0, 9.0)
    assert wanted.tuner_at == 610
    wanted.tuner.pass_over(1000)
    assert wanted.tuner.gain == pytest.approx(0.75)
    worker.approve(1700)
    changes.attend()
    assert page.get(Field.TUNE_WANTED) == 2
    assert second.answer()["gain"] == 0.5
    # A third one finds the second under way, from where that took over.
    take(page, 1610)
    change(changes, gain=1.0)
    assert worker.asked[2].tuner.gain == pytest.approx(0.75)
    assert worker.asked[2].offset == 3.0


def test_a_refusal_changes_nothing_and_the_next_has_its_turn(changes, page, worker):
    before = bytes(page.numbers)
    first, second = change(changes, gain=9.0), change(changes, offset=1.0)
    worker.answer = InputError("too much")
    changes.attend()
    with pytest.raises(InputError, match="set: too much"):
        first.answer()
    assert bytes(page.numbers) == before
    changes.attend()
    assert worker.asked[-1].gain == 1.0
    worker.gone = True
    change(changes, gain=2.0)
    worker.answer = InputError("it is gone")
    for _ in range(3):
        changes.attend()
    with pytest.raises(InputError, match="it is gone"):
        second.answer()


def test_what_the_loop_has_gone_by_is_worked_out_again_with_more_time(changes, page, worker):
    """Never put on the page too late; in the end it is refused."""
    made = change(changes, gain=0.5)
    for lead_s in (0.5, 1.0, 2.0):
        assert worker.asked[-1].lead_s == lead_s
        worker.approve(500 + BLOCK - 1)
        assert made.answer() is None
        changes.attend()
    assert len(worker.asked) == 3
    with pytest.raises(InputError, match="too busy"):
        made.answer()
    assert page.get(Field.TUNE_WANTED) == 0
    change(changes, gain=0.5)
    worker.approve(500 + BLOCK)
    changes.attend()
    assert page.get(Field.TUNE_WANTED) == 1


@pytest.mark.parametrize(
    ("number", "value", "said"),
    [
        (Field.STOP, Stop.CTRL_C, "on its way to the safe value"),
        (Field.NEXT_SAMPLE, SAMPLES, "the waveform is over"),
    ],
)
def test_the_end_of_the_run_refuses_all_that_wait(changes, page, worker, number, value, said):
    """Also where the loop has not taken the one before."""
    first, second, third = (change(changes, gain=0.1 * each) for each in (1, 2, 3))
    worker.approve(600)
    changes.attend()
    page.put(number, value)
    changes.attend()
    assert first.answer() is not None
    for each in (second, third):
        with pytest.raises(InputError, match=said):
            each.answer()
    with pytest.raises(InputError, match=said):
        change(changes, gain=1.0)


def test_the_end_of_the_run_refuses_what_is_being_worked_out(changes, page, worker):
    """What comes of it then is put nowhere."""
    made = change(changes, gain=0.5)
    worker.approve(600)
    page.put(Field.STOP, Stop.REQUEST)
    changes.attend()
    with pytest.raises(InputError, match="on its way"):
        made.answer()
    assert page.get(Field.TUNE_WANTED) == 0


def test_a_queue_that_is_full_takes_no_more(changes):
    """The first is being worked out, sixteen wait."""
    for _ in range(17):
        change(changes, gain=1.0)
    with pytest.raises(InputError, match="16 changes are waiting"):
        change(changes, gain=1.0)


def test_a_change_of_nothing_is_refused(changes):
    with pytest.raises(InputError, match="gain, offset or inverse is required"):
        change(changes)


def test_the_inverse_goes_out_and_stays_there_until_it_is_wanted_in(changes, page, worker):
    """A change of the gain in between leaves it where it is."""
    shares = [Field.TUNE_INVERSE_SHARE, Field.TUNE_LINE_SLOPE, Field.TUNE_LINE_AT_ZERO]
    for at, wanted, share in (
        (600, {"inverse": "out"}, 0.0),
        (700, {"gain": 0.5}, 0.0),
        (
            800,
            {"inverse": "in"},
            1.0,
        ),
    ):
        made = change(changes, **wanted)
        assert worker.asked[-1].inverse_share == share
        worker.approve(at)
        changes.attend()
        assert made.answer()["inverse"] == changes.inverse == ("in" if share else "out")
        assert [page.get_float(each) for each in shares] == [share, 0.1, -2.0]
        take(page, at)


def test_an_inverse_that_is_not_there_can_not_go_out(changes, page):
    changes._checked.loaded.model = None
    with pytest.raises(InputError, match="set: inverse: the experiment has no compensator"):
        change(changes, inverse="out")
    assert changes.inverse is None
    assert page.get(Field.TUNE_WANTED) == 0
