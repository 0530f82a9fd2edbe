"""What is shown of a device that was probed."""

from hilctl.cli.probe_view import print_probed
from hilctl.run.probe import Probed

PROBED = Probed(
    "rig", "a [bold] device", 1000.0, "", "a message takes up to 0.3 s", {"firmware": "[1.2]"},
    2.8e20, None, "A", ("too far",),
)  # fmt: skip


def test_what_a_device_says_is_no_markup(capsys):
    """Brackets of its own stay as they are; reading, output and faults are there."""
    print_probed(PROBED)
    shown = capsys.readouterr().out
    assert "rig answers: a [bold] device\n" in shown
    assert "firmware: [1.2]" in shown
    assert "at most 1000 samples a second\n" in shown
    assert "reads 2.8e+20 µm" in shown
    assert "what it puts out is not known" in shown
    assert "safe value: a message takes up to 0.3 s" in shown
    assert "wrong: too far" in shown
