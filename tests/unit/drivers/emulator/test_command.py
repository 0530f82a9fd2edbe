"""The command: words, places, and its end by a signal."""

import re
import signal

import pytest
from typer.testing import CliRunner

from hilctl.cli import app
from hilctl_drivers.emulator.command import serve
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.emulator.options import EmulatorOptions


@pytest.mark.parametrize(
    ("profile", "reader", "options", "places"),
    [
        ("adam_4024", "adam_4117", {}, r"(/dev/pts/\d+), unit 1 \1, unit 2"),
        ("adam_4024", "adam_4117", {"reader_unit_id": 7}, r"(/dev/\S+), unit 1 \1, unit 7"),
        ("adam_6224", "adam_6217", {}, r"127.0.0.1:(\d+), unit 1 127.0.0.1:(?!\1)\d+, unit 1"),
        ("kepco_bop", "agilent_34970a", {}, r"(/dev/pts/\d+) (?!\1)/dev/pts/\d+"),
    ],
)
def test_it_says_where_both_answer(profile, reader, options, places):
    """Each with its place, and its unit id where there is one; a signal ends it."""
    told: list[tuple[str, str]] = []

    def on_ready(name: str, address: str) -> None:
        told.append((name, address))
        if len(told) == 2:
            signal.raise_signal(signal.SIGTERM)

    serve(EmulatorOptions(profile, reader=reader, **options), on_ready)
    assert [name for name, _ in told] == [profile, reader]
    assert re.fullmatch(places, " ".join(address for _, address in told))


@pytest.mark.parametrize(
    "words",
    [
        ["kepco_bop", "--reader", "agilent_34970a", "--sensor", "AI102"],
        ["kepco_bop", "--sensor", "agilent_34970a:AI102"],
    ],
)
def test_options_become_the_emulator(words, tmp_path, monkeypatch):
    """What is not given has the default of :class:`EmulatorOptions`; a reader has two spellings."""
    asked = []
    monkeypatch.setattr("hilctl_drivers.emulator.command.serve", lambda *of: asked.append(of[0]))
    log = tmp_path / "log.jsonl"
    more = ["--log", str(log), "--fault", "cut@2", "--fault", "delay:0.3@1s", "--port", "5020"]
    ended = CliRunner().invoke(app, ["emulate", *words, *more])
    assert ended.exit_code == 0, ended.output
    assert asked == [
        EmulatorOptions(
            "kepco_bop",
            port=5020,
            log=log,
            faults=(parse_fault("cut@2"), parse_fault("delay:0.3@1s")),
            reader="agilent_34970a",
            sensor="AI102",
        )
    ]
