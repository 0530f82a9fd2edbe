"""Invalid input on the command line: one message, exit code 2, no files left."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from hilctl import cli

GOOD = """\
name: tiny
device: {kind: simulated_terfenol}
sample_rate_hz: 1000
block: 10
waveform: {kind: sine, unit: A, amplitude: 1.0, frequency_hz: 5.0, duration_s: 0.2}
compensator: none
limits: {peak_current_a: 2.0, slew_a_per_s: 500.0, stroke_um: [-75.0, 60.0]}
"""
MODEL = """\
model:
  kind: rdpi
  direct: 2.7
  weights: [2.3, 0.4]
  thresholds: [0.3, 0.6]
  output_range_um: [-12.0, 12.0]
"""
IN_UM = GOOD.replace("unit: A", "unit: um").replace(
    "compensator: none", "compensator: {model: model.yaml}"
)


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


Run = Callable[..., Ended]


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {
        path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working folder, and an empty folder for files in shared memory."""
    memory = tmp_path / "memory"
    memory.mkdir()
    monkeypatch.setenv("HILCTL_RUNS", str(memory))
    folder = tmp_path / "place"
    folder.mkdir()
    monkeypatch.chdir(folder)
    yield folder
    assert list(memory.iterdir()) == []


@pytest.fixture
def hilctl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command in this process."""

    def run(*arguments: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["hilctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        streams = capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return Ended(ended.value.code, streams.out, streams.err)

    return run


def check_refused(ended: Ended, message: str) -> None:
    """Check the properties of every rejection."""
    assert ended.code == 2
    assert "Traceback" not in ended.out + ended.err
    lines = ended.err.splitlines()
    assert lines
    assert all(line.startswith("hilctl: ") for line in lines)
    assert message in ended.err
    assert len(lines) == len(set(lines))


def refused_everywhere(hilctl: Run, place: Path, message: str, *arguments: object) -> None:
    """check, run and run --json reject alike and change no file."""
    before = contents(place)
    for command in (("check",), ("run",), ("run", "--output", "run.mcap")):
        ended = hilctl(*command, *arguments)
        check_refused(ended, message)
        assert ended.out == ""
        assert contents(place) == before
    for command in (("check", "--json"), ("run", "--json")):
        ended = hilctl(*command, *arguments)
        check_refused(ended, message)
        assert message in json.loads(ended.out)["error"]
        assert contents(place) == before


BROKEN: list[tuple[str, str, str]] = [
    ("malformed", GOOD.replace("60.0]}", "60.0}"), "x.yaml:7: is not readable YAML"),
    ("empty", "", "x.yaml:1: must hold a mapping of keys to values"),
    ("unknown key", GOOD + "limit: {}\n", "x.yaml:8: limit: unknown key (did you mean 'limits'?)"),
    (
        "wrong type",
        GOOD.replace("block: 10", "block: [10]"),
        "x.yaml:4: block: must be a whole number, got [10]",
    ),
    (
        "number that YAML reads as text",
        GOOD.replace("sample_rate_hz: 1000", "sample_rate_hz: 1_000"),
        "x.yaml:3: sample_rate_hz: must be a number, got '1_000' (write a plain number, such as "
        "1000, 0.5 or 1e-3)",
    ),
    (
        "not a number",
        GOOD.replace("amplitude: 1.0", "amplitude: .nan"),
        "x.yaml:5: waveform.amplitude: must be a finite number, got nan",
    ),
    (
        "command beyond the limits",
        GOOD.replace("amplitude: 1.0", "amplitude: 3.0"),
        "x.yaml:7: limits.peak_current_a: the run must stay within -2 to 2 A, got -3 to 3 A (1 A "
        "too much",
    ),
    (
        "frequency above half the rate",
        GOOD.replace("frequency_hz: 5.0", "frequency_hz: 500.0"),
        "x.yaml:5: waveform: sine: every frequency must be below half the sample rate, 500 Hz: 500 "
        "Hz",
    ),
    (
        "reference beyond the model",
        IN_UM.replace("amplitude: 1.0", "amplitude: 12.5"),
        "x.yaml:5: waveform: reference must stay within the range that compensator.model was "
        "identified on, -12 to 12 µm, got -12.5 to 12.5 µm (0.5 µm too far",
    ),
    (
        "unknown device",
        GOOD.replace("simulated_terfenol", "simulated_terfenal"),
        "x.yaml:2: device.kind: unknown device 'simulated_terfenal' (did you mean "
        "'simulated_terfenol'?)",
    ),
    (
        "missing model",
        IN_UM.replace("model.yaml", "lost.yaml"),
        "x.yaml:6: compensator.model: lost.yaml: no such file",
    ),
    (
        "missing waveform file",
        GOOD.replace(
            "{kind: sine, unit: A, amplitude: 1.0, frequency_hz: 5.0, duration_s: 0.2}",
            "{kind: file, unit: A, path: lost.csv}",
        ),
        "x.yaml:5: waveform: lost.csv: no such file",
    ),
]


@pytest.mark.parametrize(
    ("text", "message"), [case[1:] for case in BROKEN], ids=[case[0] for case in BROKEN]
)
def test_experiment(hilctl: Run, place: Path, text: str, message: str) -> None:
    """An invalid experiment is rejected with file, line, key, rule and value."""
    (place / "x.yaml").write_text(text)
    (place / "model.yaml").write_text(MODEL)
    refused_everywhere(hilctl, place, message, "x.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[2.3, 0.4]",
            "[2.3, -0.4]",
            "model.yaml:1: model: a_2 must be >= 0 for the inverse to exist: -0.4",
        ),
        ("direct: 2.7", "direct: 0", "model.yaml:1: model: a_0 must be > 0 for the inverse"),
        ("[0.3, 0.6]", "[0.6, 0.3]", "model.yaml:1: model: r must rise from 0"),
    ],
)
def test_model_that_can_not_be_inverted(
    hilctl: Run, place: Path, old: str, new: str, message: str
) -> None:
    """A model without an inverse is rejected with its file, condition and index."""
    (place / "x.yaml").write_text(IN_UM)
    (place / "model.yaml").write_text(MODEL.replace(old, new))
    refused_everywhere(hilctl, place, message, "x.yaml")


def test_missing_experiment(hilctl: Run, place: Path) -> None:
    """A missing experiment is named."""
    refused_everywhere(hilctl, place, "lost.yaml: no such file", "lost.yaml")


def test_folder_instead_of_an_experiment(hilctl: Run, place: Path) -> None:
    """A folder is rejected."""
    refused_everywhere(hilctl, place, "is not a file", place)


def test_binary_experiment(hilctl: Run, place: Path) -> None:
    """A binary file is rejected."""
    (place / "x.yaml").write_bytes(bytes(range(256)))
    refused_everywhere(hilctl, place, "x.yaml: is not UTF-8 text", "x.yaml")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("block=x", "--set block=x: block: must be a whole number, got 'x'"),
        ("blok=1", "--set blok=1: blok: unknown key (did you mean 'block'?)"),
        ("block", "--set block: must be dotted.key=value"),
        ("block=[", "--set block=[: block: is not readable YAML, got '['"),
    ],
)
def test_setting(hilctl: Run, place: Path, setting: str, message: str) -> None:
    """An invalid setting is rejected with its option."""
    (place / "x.yaml").write_text(GOOD)
    refused_everywhere(hilctl, place, message, "x.yaml", "--set", setting)


def test_every_problem_is_told(hilctl: Run, place: Path) -> None:
    """Each problem is one line, and one item in JSON."""
    (place / "x.yaml").write_text(
        GOOD.replace("block: 10", "block: 0.5").replace("unit: A", "unit: mA")
    )
    before = contents(place)
    ended = hilctl("run", "x.yaml", "--json")
    check_refused(ended, "x.yaml:4: block: must be a whole number, got 0.5")
    expected = [
        "x.yaml:4: block: must be a whole number, got 0.5",
        "x.yaml:5: waveform.unit: must be one of 'um', 'A' or 'V', got 'mA'",
    ]
    assert ended.err.splitlines() == [f"hilctl: {each}" for each in expected]
    assert json.loads(ended.out) == {"error": "\n".join(expected), "problems": expected}
    assert contents(place) == before


class TestOutput:
    """Recordings that can't be written."""

    @pytest.fixture(autouse=True)
    def experiment(self, place: Path) -> None:
        """Write a valid experiment and a regular file."""
        (place / "x.yaml").write_text(GOOD)
        (place / "regular").write_text("kept")

    @pytest.mark.parametrize(
        ("output", "message"),
        [
            ("lost/run.mcap", "lost/run.mcap: can't be written: No such file or directory"),
            ("regular/run.mcap", "regular/run.mcap: can't be written: Not a directory"),
            ("x" * 300, "can't be written: File name too long"),
        ],
    )
    @pytest.mark.parametrize("overwrite", [(), ("--overwrite",)])
    def test_unwritable(
        self, hilctl: Run, place: Path, output: str, message: str, overwrite: tuple[str, ...]
    ) -> None:
        """A recording that can't be created is rejected before anything moves."""
        before = contents(place)
        ended = hilctl("run", "x.yaml", "--output", output, *overwrite)
        check_refused(ended, message)
        assert contents(place) == before
        ended = hilctl("run", "x.yaml", "--json", "--output", output, *overwrite)
        check_refused(ended, message)
        assert message in json.loads(ended.out)["error"]
        assert contents(place) == before

    @pytest.mark.parametrize("overwrite", [(), ("--overwrite",)])
    def test_folder(self, hilctl: Run, place: Path, overwrite: tuple[str, ...]) -> None:
        """A folder is rejected as the recording and never replaced."""
        (place / "runs").mkdir()
        before = contents(place)
        ended = hilctl("run", "x.yaml", "--output", "runs", *overwrite)
        check_refused(ended, "hilctl: runs: ")
        assert contents(place) == before

    def test_existing(self, hilctl: Run, place: Path) -> None:
        """An existing recording is kept without --overwrite."""
        (place / "run.mcap").write_bytes(b"an older run")
        before = contents(place)
        ended = hilctl("run", "x.yaml", "--output", "run.mcap")
        check_refused(ended, "run.mcap: exists already: give another --output, or --overwrite")
        assert contents(place) == before

    def test_existing_is_kept_where_the_experiment_is_refused(
        self, hilctl: Run, place: Path
    ) -> None:
        """An existing recording survives an invalid experiment, even with --overwrite."""
        (place / "run.mcap").write_bytes(b"an older run")
        before = contents(place)
        ended = hilctl("run", "x.yaml", "--overwrite", "--output", "run.mcap", "--set", "block=0")
        check_refused(ended, "--set block=0: block: must be >= 1, got 0")
        assert contents(place) == before

    def test_folder_for_recordings(self, hilctl: Run, place: Path) -> None:
        """A recording folder that can't be created is rejected."""
        before = contents(place)
        ended = hilctl("run", "x.yaml", "--set", "recording.folder=regular/runs")
        check_refused(ended, "cannot create regular/runs")
        assert contents(place) == before


class TestOtherCommands:
    """Commands that read recordings."""

    @pytest.mark.parametrize(
        "arguments", [("report", "{}"), ("replay", "{}"), ("export", "{}", "out.csv")]
    )
    def test_recording(self, hilctl: Run, place: Path, arguments: tuple[str, ...]) -> None:
        """A missing or invalid recording is rejected by name."""
        (place / "folder.mcap").mkdir()
        (place / "text.mcap").write_text("no recording")
        before = contents(place)
        folder = "can't be read: Is a directory"
        if arguments[0] == "report":  # a folder stands for all of its recordings
            folder = "contains no recordings"
        for name, message in [
            ("lost.mcap", "lost.mcap: no such file"),
            ("folder.mcap", f"folder.mcap: {folder}"),
            ("text.mcap", "text.mcap: is not an MCAP file"),
        ]:
            filled = [argument.format(name) for argument in arguments]
            ended = hilctl(*filled)
            check_refused(ended, message)
            assert ended.out == ""
            ended = hilctl(*filled, "--json")
            check_refused(ended, message)
            assert message in json.loads(ended.out)["error"]
        assert contents(place) == before

    def test_schema(self, hilctl: Run, place: Path) -> None:
        """An unwritable schema file is rejected."""
        ended = hilctl("schema", "--output", "lost/schema.json")
        check_refused(ended, "lost/schema.json: can't be written: No such file or directory")
        assert contents(place) == {}

    def test_unknown_option(self, hilctl: Run, place: Path) -> None:
        """An unknown option ends with exit code 2."""
        ended = hilctl("run", "--speed", "11")
        assert ended.code == 2
        assert "--speed" in ended.err
        assert "Traceback" not in ended.err
        assert contents(place) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (GOOD.replace("60.0]}", "60.0}"), (), "x.yaml:7: is not readable YAML"),
        (
            GOOD.replace("amplitude: 1.0", "amplitude: .nan"), ("--json",),
            "x.yaml:5: waveform.amplitude: must be a finite number, got nan",
        ),
        (
            GOOD, ("--output", "x.yaml/run.mcap"),
            "x.yaml/run.mcap: can't be written: Not a directory",
        ),
    ],
    ids=["malformed", "not a number, for programs", "unwritable"],
)  # fmt: skip
def test_process(tmp_path: Path, text: str, arguments: tuple[str, ...], message: str) -> None:
    """A rejection in a separate process is a message and an exit code only."""
    (tmp_path / "x.yaml").write_text(text)
    before = contents(tmp_path)
    ended = subprocess.run(
        [sys.executable, "-m", "hilctl", "run", "x.yaml", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=240.0,
    )
    check_refused(Ended(ended.returncode, ended.stdout, ended.stderr), message)
    if "--json" in arguments:
        assert message in json.loads(ended.stdout)["error"]
    else:
        assert ended.stdout == ""
    assert contents(tmp_path) == before
