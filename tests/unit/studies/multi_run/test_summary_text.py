"""What came out, in a line or two."""

from dataclasses import replace

from hilctl.studies.multi_run.summary_text import headline


def test_best_worst_and_trends_of_loops(crossed):
    assert headline(crossed) == [
        "6 runs, all completed.",
        "Peak hysteresis 11.0 % (10 Hz, 3 A) to 30.0 % (200 Hz, 3 A).",
        "With frequency, peak-to-peak does not change; peak hysteresis rises.",
        "The loop's area is linear in frequency (r² 1.0000).",
        "With amplitude, peak-to-peak rises; peak hysteresis does not change.",
    ]


def test_failures_come_first(crossed):
    broken = replace(crossed.runs[2], result="fault: the coil is hot")
    later = replace(crossed.runs[5], result="planned")
    series = replace(crossed, runs=(*crossed.runs[:2], broken, *crossed.runs[3:5], later))
    assert headline(series)[0] == (
        "4 of 6 runs completed, 1 failed: 200 Hz, 3 A (fault: the coil is hot), 1 still to come."
    )


def test_before_and_after(compensated):
    text = " ".join(headline(compensated))
    assert (
        "Peak hysteresis without compensator 20.0 to 21.0 %, worst at 100 Hz; "
        "with omega 2.01 to 3.00 %, worst at 100 Hz."
    ) in text


def test_resonances(crossed):
    runs = [
        replace(run, figures=replace(run.figures, natural_hz=2300.0 / n, damping_ratio=0.12))
        for n, run in enumerate(crossed.runs, 1)
    ]
    text = " ".join(headline(replace(crossed, runs=tuple(runs))))
    assert "Natural frequency 383 Hz (200 Hz, 6 A) to 2300 Hz (10 Hz, 3 A)." in text
