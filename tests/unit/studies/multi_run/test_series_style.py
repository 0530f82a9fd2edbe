"""How runs are told apart."""

from matplotlib.colors import to_rgb

from hilctl.analysis.plot_style import WITH, WITHOUT
from hilctl.studies.multi_run.series_style import line_of, looks, spread
from hilctl.studies.multi_run.varied_parameter import WITHOUT_COMPENSATOR, VariedParameter

AMPLITUDE = VariedParameter("a", "amplitude", "A", (1.0, 2.0, 3.0))


def lightness(colour):
    return sum(w * c for w, c in zip((0.21, 0.72, 0.07), to_rgb(colour), strict=True))


def test_numbers_keep_their_order_in_grey():
    found = looks(AMPLITUDE, AMPLITUDE.values)
    shades = [lightness(found[value]["color"]) for value in AMPLITUDE.values]
    assert shades == sorted(shades)
    assert shades[2] - shades[0] > 0.35


def test_names_have_colours_and_signs_of_their_own():
    found = looks(None, ["none", "b", "c"])
    assert len({look["color"] for look in found.values()}) == 3
    assert len({look["marker"] for look in found.values()}) == 3
    assert "marker" not in line_of(found["b"])


def test_runs_without_a_compensator_look_as_on_the_page_of_a_single_run():
    """Whatever stands beside them, and whether they come as a value or by name."""
    kinds = VariedParameter("compensator", "compensator", "", ("none", "a", "b"))
    for found, plain in (
        (looks(kinds, kinds.values), "none"),
        (looks(None, [WITHOUT_COMPENSATOR, "a", "b"]), WITHOUT_COMPENSATOR),
    ):
        assert (found[plain]["color"], found["a"]["color"]) == (WITHOUT, WITH)
        assert found["b"]["color"] not in {WITHOUT, WITH}


def test_many_are_spread_with_both_ends():
    assert spread(list(range(20)), 4) == [0, 6, 13, 19]
    assert spread([1, 2], 7) == [1, 2]
