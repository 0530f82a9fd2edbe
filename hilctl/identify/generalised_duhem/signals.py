"""Stages in a row for the search, and the field and displacement that they leave of a record."""

from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.identify.field.densities import Curve
from hilctl.identify.field.design_matrix import turning_points
from hilctl.identify.field.preprocess import Latest, Prepared
from hilctl.identify.field.sampling import Motion
from hilctl.identify.field.stages import (
    HIGH,
    LOW,
    STEP,
    Physical,
    Stages,
    physical,
    signals,
    stages_of,
)
from hilctl.identify.parallel import parallel_map

STAGES = ("field", "output", "decay", "growth", "bend", "excess", "radian", "damping", "delay")
POWERS = np.arange(1.0, 5.0)
FLUX = slice(len(STAGES), len(STAGES) + POWERS.size)
NAMES = (*STAGES, *(f"flux_{power:g}" for power in POWERS), "offset")
"""Of the row; the flux is exp(flux_1 n + flux_2 n^2 + ...) steep, n from -1 to 1 over the stroke,
and the offset, in half strokes, is of the displacement at rest from what the first samples say."""
_FLUX, _OFFSET = 2.0, 0.5  # bounds
_FLUX_NODES = 33


def _row(stages: Stages, flux: float, offset: float) -> F64:
    fluxes = np.full(POWERS.size, flux)
    return np.array([*(getattr(stages, name) for name in STAGES), *fluxes, offset])


LOWEST = _row(LOW, -_FLUX, -_OFFSET)
HIGHEST = _row(HIGH, _FLUX, _OFFSET)
STEPS = _row(STEP, 0.05, 0.005)
# Rods conduct. From a start with nearly no eddy currents, the lag of the field took their place for
# good: where they are 0 nothing says how the flux goes, and so nothing brings them back.
FIRST = _row(Stages(field=0.05, output=0.08, decay=0.005), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Path:
    """What is left of a record: points far enough apart, and all turning points.

    Attributes:
        field: float64[n], w.
        displacement_um: float64[n], y before structure and delay.
        motion: How the record moves, at these points.
    """

    field: F64
    displacement_um: F64
    motion: Motion


class Signals:
    """Field and displacement of all records.

    Args:
        data: The records.
    """

    def __init__(self, data: Prepared) -> None:
        self._data = data
        self._kept: tuple[I64, ...] = ()
        self._motions: tuple[Motion, ...] = ()
        self._paths: Latest[list[Path]] = Latest()
        measured = np.concatenate([run.derivatives[0] for run in data.runs])
        self._middle_um = 0.5 * float(measured.max() + measured.min())
        self._half_um = 0.5 * float(np.ptp(measured))

    def known(self, x: F64) -> Physical:
        """Return the stages of a row in s, um and the unit of the command."""
        given = dict(zip(STAGES, x.tolist(), strict=False))
        return physical(replace(Stages(), **given), self._data)

    def flux(self, x: F64) -> Curve:
        """Return the flux of a row, in um, by the displacement."""
        place = np.linspace(-1.0, 1.0, _FLUX_NODES)
        steep = np.exp(place[:, None] ** POWERS @ x[FLUX])
        flux = np.concatenate(([0.0], np.cumsum(steep[1:] + steep[:-1])))
        flux *= 2.0 * self._half_um / flux[-1]
        return Curve(flux, self._middle_um + self._half_um * place)

    def offset_um(self, x: F64, first_um: float) -> float:
        """Return the displacement at rest, from a first guess and what a row adds to it."""
        return first_um + float(x[-1]) * self._half_um

    def offset_in(self, offset_um: float, first_um: float) -> float:
        """Undo :meth:`offset_um`: return what a row holds; within its bounds."""
        return float(np.clip((offset_um - first_um) / self._half_um, -_OFFSET, _OFFSET))

    def row_of(self, known: Physical, other: F64) -> F64:
        """Return a row of stages, its flux and its offset as in one of other records."""
        stages = stages_of(known, self._data)
        return np.array([*(getattr(stages, name) for name in STAGES), *other[len(STAGES) :]])

    def choose(self, x: F64, way: float) -> None:
        """Choose the points of all paths, at most ``way`` of the command's span apart."""
        kept = []
        for field, _ in self._whole(x):
            out = np.empty(field.size, dtype=np.int64)
            count = turning_points(field, way * 2.0 * self._data.reach, out)
            kept.append(out[:count].copy())
        self._kept = tuple(kept)
        self._motions = tuple(
            run.motion.at(at) for run, at in zip(self._data.runs, kept, strict=True)
        )
        self._paths = Latest()

    def paths(self, x: F64) -> list[Path]:
        """Return what a row leaves of each record: not to be changed, nor does the offset do so."""
        return self._paths.of(x[:-1].tobytes(), lambda: self._left(x))

    def _left(self, x: F64) -> list[Path]:
        return [
            Path(np.ascontiguousarray(field[kept]), np.ascontiguousarray(y[kept]), motion)
            for (field, y), kept, motion in zip(
                self._whole(x), self._kept, self._motions, strict=True
            )
        ]

    def _whole(self, x: F64) -> list[tuple[F64, F64]]:
        known, flux = self.known(x), self.flux(x)
        span = 2.0 * self._data.reach
        return parallel_map(lambda run: signals(run, known, flux, span), self._data.runs)
