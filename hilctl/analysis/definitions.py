"""What the figures in reports mean, once for all pages."""

DEFINITIONS: tuple[tuple[str, str], ...] = (
    (
        "average cycle",
        "Mean of all whole steady cycles on bins of phase; every figure that is not raw is of it.",
    ),
    (
        "peak hysteresis",
        "Largest difference of displacement between a rising and a falling branch at one input, "
        "over the peak-to-peak displacement. The input is the reference where a compensator stands "
        "before the actuator, otherwise the command.",
    ),
    ("noise floor", "What sensor noise alone would make of the peak hysteresis."),
    ("loop area", "Area that displacement against input encloses."),
    (
        "peak and rms error",
        "Displacement less reference, offset included: largest magnitude, and root mean square, "
        "over the peak-to-peak displacement.",
    ),
    (
        "asymmetry",
        "Difference of the highest and the lowest displacement from rest, over the peak-to-peak.",
    ),
    (
        "model error",
        "Largest difference of measured displacement and what the model makes of the command, over "
        "the peak-to-peak displacement.",
    ),
    (
        "harmonics of the error",
        "Amplitudes of the error's steady part at multiples of the waveform's frequency.",
    ),
    ("r²", "Share of the variance that a straight line explains."),
    (
        "lateness",
        "Time from a tick's deadline to its wake-up; p99 is kept by all but one of 100 ticks.",
    ),
)


def definitions_of(*terms: str) -> list[tuple[str, str]]:
    """Return terms and meanings, in order."""
    return [each for each in DEFINITIONS if each[0] in terms]
