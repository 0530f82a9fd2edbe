"""Every whole record of a damaged file, and one line on what is wrong with it."""

import io

import pytest
from mcap.records import Message, Metadata

from hilctl.recording.recovery_scan import Damage, RecoveryScan


@pytest.fixture
def data(make):
    stream = io.BytesIO()
    make.write(stream, [make.batch(200 * i, 4, seed=i) for i in range(4)])
    return stream.getvalue()


def salvaged(data):
    scan = RecoveryScan(io.BytesIO(data))
    return scan, list(scan.records())


def test_a_sound_file_has_no_damage(data):
    scan, records = salvaged(data)
    assert scan.sound
    assert scan.is_mcap
    assert sum(isinstance(record, Message) for record in records) > 4
    assert [r.name for r in records if isinstance(r, Metadata)] == ["hilctl.run", "hilctl.end"]


def test_what_is_no_mcap_file_holds_nothing():
    scan, records = salvaged(b"time,current\n" * 100)
    assert not scan.is_mcap
    assert records == []


@pytest.mark.parametrize(
    ("damages", "text"),
    [
        ([], "its end and index are missing"),
        ([Damage(9, 5, "index")], "its index is damaged or cut"),
        ([Damage(9, 5, "damaged record")], "damaged record at byte 9 (5 bytes)"),
        (
            [Damage(9, 5, "damaged chunk", 3)] * 4,
            "damaged chunk at byte 9 (5 bytes, 3 messages of it saved without a checksum), "
            "damaged chunk at byte 9 (5 bytes, 3 messages of it saved without a checksum) "
            "and 2 more",
        ),
    ],
)
def test_damages_are_described_in_one_line(damages, text):
    scan = RecoveryScan(io.BytesIO(b""))
    scan.damages = damages
    assert scan.describe() == text
