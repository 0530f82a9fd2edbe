"""The settings of a fit: defaults of each kind, what belongs to which, and what is reported."""

import pytest
from pydantic import ValidationError

from hilctl.lab.identify.settings import (
    FitSettings,
    IdentifySettings,
    TableSettings,
    setting_rows,
)


def test_published_choices_of_a_kind_are_its_defaults():
    """Sections 3.4.2, 5.3 and 6.4."""
    assert FitSettings(kind="ppi").plays == 10
    rdpi = FitSettings(kind="rdpi")
    assert (rdpi.plays, rdpi.weights, rdpi.weight_by, rdpi.points) == (4, "free", "hysteresis", 400)
    omega = FitSettings()
    assert (omega.plays, omega.deadbands, omega.weights) == (12, 8, "exponential")
    assert FitSettings(kind="rdpi", plays=6).plays == 6


@pytest.mark.parametrize(("choices", "reason"), [
    ({"kind": "integrated", "lines": 8}, "not of integrated"),
    ({"kind": "ppi", "deadbands": 8}, "not of ppi"),
    ({"kind": "integrated", "deadbands": 0}, "greater than or equal to 1"),
    ({"kind": "staged", "weights": "exponential"}, "not of staged"),
    ({"kind": "staged", "creep": True}, "not of staged"),
    ({"kind": "kp", "plays": 4}, "not of kp"),
])  # fmt: skip
def test_impossible_choices_are_refused(choices, reason):
    with pytest.raises(ValidationError, match=reason):
        FitSettings(**choices)


def test_auto_is_a_lag():
    settings = IdentifySettings(kind="ppi", table={"lag_samples": "auto"})  # type: ignore[arg-type]
    assert settings.table.find_lag
    assert settings.changes() == "table.find_lag=true"


def test_the_unit_is_that_of_the_recordings():
    assert IdentifySettings(kind="ppi").unit("A") == "A"
    assert IdentifySettings(kind="ppi").unit(None) == "V"
    assert IdentifySettings(kind="rdpi").unit(None) == "A"


def test_rows_have_defaults_limits_and_kinds():
    rows = {name: rest for name, *rest in setting_rows()}
    assert rows["plays"][0].startswith("12, 20 for staged, 4 for rdpi")
    assert rows["plays"][1] == "1 to 200"
    assert rows["weights"][1] == "exponential, free"
    assert rows["turning_um"][:2] == ["-", ""]
    assert rows["lines"][2] == "preisach"
    assert "table.time_column" in rows


def test_a_unit_with_a_prefix_is_refused_with_its_factor():
    with pytest.raises(ValidationError, match=r"for mV set V, and command_scale 0\.001"):
        TableSettings(unit="mV")
