"""Numbers, texts and events between loop and supervisor."""

import json
from dataclasses import asdict
from mmap import mmap

import pytest

from hilctl.base.events import Event
from hilctl.loop.safe_output import LoopOutcome
from hilctl.machine.procfs import ProcessUsage
from hilctl.run.shared.shared_page import SIZE, PageField, PageSlot, Phase, SharedPage, Stop


@pytest.fixture
def sides():
    memory = mmap(-1, SIZE)
    return SharedPage(memory), SharedPage(memory)


def test_each_text_has_its_own_slot(sides):
    one, other = sides
    for place in PageSlot:
        one.write_text(place, f"{place.name}: öffnen")
    assert [other.read_text(place) for place in PageSlot] == [f"{p.name}: öffnen" for p in PageSlot]
    one.write_text(PageSlot.SET_UP, "µ" * 10_000)
    assert set(other.read_text(PageSlot.SET_UP)) == {"µ"}
    assert other.read_text(PageSlot.OUTCOME) == "OUTCOME: öffnen"
    one.write_text(PageSlot.ERROR, "\udcff/e.yaml: no such file")  # of a name that is not UTF-8
    assert other.read_text(PageSlot.ERROR) == r"\udcff/e.yaml: no such file"


def test_events_are_read_once_and_truncated(sides):
    one, other = sides
    for sample in range(40):
        one.push_event(Event(sample, "error", "test", "ü" * 1000, {"number": 0.5}))
    events = other.pop_events()
    assert [event.sample for event in events] == list(range(32))
    assert set(events[0].text) == {"ü"}
    assert events[0].values == {"number": 0.5}
    assert one.get(PageField.EVENTS_LOST) == 8
    one.push_event(Event(41, "info", "test", "no room yet"))
    other.release_events()
    one.push_event(Event(42, "info", "test", "room"))
    assert [event.sample for event in other.pop_events()] == [42]


def test_outcome_counts_only_at_the_end(sides):
    one, other = sides
    outcome = LoopOutcome("stopped", "stopped by a test", 7, "confirmed")
    one.write_text(PageSlot.OUTCOME, json.dumps(asdict(outcome)))
    assert other.outcome() is None
    one.put(PageField.PHASE, Phase.ENDED)
    assert other.outcome() == outcome
    one.write_text(PageSlot.OUTCOME, '{"code": "sto')
    assert other.outcome() is None


def test_values_that_do_not_fit_are_omitted(sides):
    one, other = sides
    values = {f"weight_{number}": 1.0 / 3.0 for number in range(500)}
    one.push_event(Event(1, "info", "test", "text", values))
    (event,) = other.pop_events()
    assert (event.code, event.text, event.values) == ("test", "text", {})


def test_observer_reads_the_newest_events_without_consuming_them(sides):
    one, other = sides
    for number in range(3):
        one.push_event(Event(number, "info", f"e{number}", ""))
    events, after = other.look_at_events(1)
    assert ([event.code for event in events], after) == (["e1", "e2"], 3)
    assert other.look_at_events(after) == ([], 3)
    assert len(one.pop_events()) == 3


def test_notes_are_read_by_all_and_the_oldest_are_dropped(sides):
    one, other = sides
    for number in range(40):
        one.leave_note(Event(number, "info", "mark", f"{number} " + "x" * 2000))
    notes, after = other.look_at_notes(0)
    assert [note.sample for note in notes] == list(range(9, 40))
    assert (after, other.look_at_notes(after)) == (40, ([], 40))
    one.leave_note(Event(40, "info", "mark", "more"))
    assert [note.text for note in other.look_at_notes(after)[0]] == ["more"]


def test_resource_usage_is_shared(sides):
    """The usage of a loop that died early is unknown."""
    one, other = sides
    assert other.usage() is None
    usage = ProcessUsage(98_000_000, 1_500, 12, 3, 4)
    one.leave_usage(usage)
    assert other.usage() == usage


@pytest.mark.parametrize(
    ("phase", "go", "stop", "state"),
    [
        (Phase.READY, 0, 0, "ready"),
        (Phase.READY, 1, 0, "waiting"),
        (Phase.READY, 1, Stop.REQUEST, "stopping"),
        (Phase.RUNNING, 1, 0, "running"),
    ],
)
def test_state(sides, phase, go, stop, state):
    one, other = sides
    for field, value in ((PageField.PHASE, phase), (PageField.GO, go), (PageField.STOP, stop)):
        one.put(field, value)
    assert other.state() == state
