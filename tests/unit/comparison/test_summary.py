"""The table of a comparison: columns, dashes, and what its reader has to know."""

from types import SimpleNamespace

from hilctl.comparison.summary import headings, notes, table_rows, titles


def trial(frequency_hz, error_percent, limited=0):
    return SimpleNamespace(
        frequency_hz=frequency_hz, peak_error_percent=error_percent, limited_samples=limited
    )


def row(name, *trials, numbers=5, identify_s=1.5):
    error = SimpleNamespace(peak_percent=1.25, rms_percent=0.5)
    return SimpleNamespace(
        name=name, title=f"the {name}", numbers=numbers, identify_s=identify_s, inverse_ns=312.4,
        error=error, trials=trials,
    )  # fmt: skip


def comparison(*rows, device="a rig"):
    return SimpleNamespace(rows=rows, device=device)


def test_a_model_of_a_file_has_dashes_where_nothing_was_found():
    """Columns are those of the model that was tried most often."""
    found = comparison(
        row("duhem", trial(50.0, 0.75), trial(100.0, None)),
        row("m.yaml", numbers=None, identify_s=None),
    )
    assert headings(found)[-2:] == ["50 Hz", "100 Hz"]
    assert list(table_rows(found)) == [
        ["duhem", "5", "1.50", "312", "1.25", "0.50", "0.75", "-"],
        ["m.yaml", "-", "-", "312", "1.25", "0.50"],
    ]
    assert titles(found.rows) == [("duhem", "the duhem"), ("m.yaml", "the m.yaml")]


def test_a_trial_that_was_limited_has_a_star_and_a_note():
    limited = comparison(row("duhem", trial(50.0, 0.75, limited=3)))
    assert next(table_rows(limited))[-1] == "0.75*"
    assert notes(limited)[-1].startswith("*: the limiter")
    assert not any(text.startswith("*") for text in notes(comparison(row("d", trial(50.0, 1.0)))))


def test_a_real_device_is_said_to_have_no_trials():
    assert "not a simulated one" in notes(comparison(row("duhem"), device=""))[-1]
