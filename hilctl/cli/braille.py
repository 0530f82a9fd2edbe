"""Curves in braille dots, two by four a character, for a terminal."""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64


@dataclass(frozen=True, slots=True)
class BrailleCurve:
    """One curve.

    Attributes:
        x: float64[n].
        y: float64[n]; what is not finite is left out.
        colour: Name of its colour.
    """

    x: F64
    y: F64
    colour: str


def envelope(x: F64, low: F64, high: F64, columns: int) -> tuple[F64, F64]:
    """Return points that go from lowest to highest in each of at most ``columns`` columns.

    Args:
        x: float64[n].
        low: float64[n], lowest value of each bucket; NaN where it is empty.
        high: float64[n], highest.
        columns: Columns that there are to draw in; no spike is lost among them.
    """
    there = np.isfinite(low) & np.isfinite(high)
    x, low, high = x[there], low[there], high[there]
    if not x.size:
        return x, low
    starts = np.unique(np.linspace(0, x.size, min(columns, x.size), endpoint=False).astype(int))
    ends = np.array((np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)))
    # Every other column downwards: the line from one to the next stays short.
    ends[:, 1::2] = ends[::-1, 1::2].copy()
    return np.repeat(x[starts], 2), ends.T.ravel()


def plot(
    curves: list[BrailleCurve], width: int, height: int, title: str, *, coloured: bool
) -> list[str]:
    """Return curves with their axes as lines of a terminal.

    Args:
        curves: The curves; the first is drawn first.
        width: Columns of it all.
        height: Lines of it all.
        title: Stands above.
        coloured: Whether the lines have colours in them.

    Returns:
        ``height`` lines, ``width`` columns each.
    """
    from plotext import figure, marker  # a quarter of a second: only where something is drawn

    figure.clear()
    figure.subplots(1, 1)
    figure.plot_size(width, height)
    figure.theme("colorless")
    drawn = []
    for curve in curves:
        there = np.isfinite(curve.x) & np.isfinite(curve.y)
        if there.any():
            x, y = curve.x[there], curve.y[there]
            dots = marker("braille", curve.colour if coloured else None)
            signal = figure.signal(x.tolist(), y.tolist(), marker=dots)
            signal.lines()
            figure.draw(signal)
            drawn.append((x, y))
    for axis, row, most in (("x", 0, width // 12), ("y", 1, height // 3)):
        if drawn:
            ticks = round_ticks(np.concatenate([each[row] for each in drawn]), most)
            figure.ruler(axis).lim(float(ticks[0]), float(ticks[-1]))
            figure.ruler(axis).ticks(ticks.tolist(), [f"{each:.4g}" for each in ticks])
    figure.title(title)
    lines = str(figure.build().string(colorless=not coloured)).split("\n")[:height]
    return [*lines, *[" " * width] * (height - len(lines))]


def round_ticks(values: F64, most: int) -> F64:
    """Return round numbers around values (float64[n], n > 0), about ``most`` of them.

    A little more or less of the values moves none of them.
    """
    low, high = float(values.min()), float(values.max())
    wanted = (high - low or max(abs(high), 1.0)) / max(1, most)
    power = 10.0 ** math.floor(math.log10(wanted))
    step = power * next(each for each in (1.0, 2.0, 5.0, 10.0) if each * power >= 0.999 * wanted)
    first = math.floor(low / step)
    last = max(first + 1, math.ceil(high / step))
    ticks: F64 = np.arange(first, last + 1, dtype=np.float64) * np.float64(step)
    return ticks
