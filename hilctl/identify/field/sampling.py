"""Which samples a fit takes as its rows, and how much each of them counts.

Errors of a model are much alike for as long as a loop goes on, so that its tenth cycle says little
that the first did not. Taken as they come along the command, nine rows of ten would be of fast full
strokes, and what plays there are would make up for what losses lack there, at the cost of all else.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.identify.field.design_matrix import swings

LEAST_SWING = 0.1  # of the stroke: smaller swings count as this one
TURN = 0.02  # of the stroke: what is no turn yet
AT_REST = 1e-4  # of the command's peak-to-peak: shorter steps count for less time than they took
REPEATED = 0.5  # exponent of how closely rows lie, by which each of them counts for less


@dataclass(frozen=True, slots=True)
class Motion:
    """How a record moves.

    Attributes:
        travel: float64[n], of the command since the sample before, of its peak-to-peak.
        step_s: float64[n], time since then.
        swing: float64[n], displacement between the turns around a sample, of the stroke.
        judged: First sample that counts.
    """

    travel: F64
    step_s: F64
    swing: F64
    judged: int

    @classmethod
    def of(
        cls,
        signals: tuple[F64, F64],
        step_s: F64,
        judged: int,
        reach: float,
        stroke_um: float,
    ) -> "Motion":
        """Return the motion of a command and a displacement.

        Args:
            signals: Command and displacement in um, float64[n] each.
            step_s: float64[n].
            judged: First sample that counts.
            reach: Half the command's peak-to-peak.
            stroke_um: Of the displacement.
        """
        command, displacement_um = signals
        swing = np.empty(command.size)
        swings(np.ascontiguousarray(displacement_um), TURN * stroke_um, swing)
        travel = np.abs(np.diff(command, prepend=command[:1])) / (2.0 * reach)
        return cls(travel, step_s, np.maximum(swing / stroke_um, LEAST_SWING), judged)

    def at(self, samples: I64) -> "Motion":
        """Return the motion at some samples alone, the first among them."""
        return Motion(
            np.diff(np.cumsum(self.travel)[samples], prepend=0.0),
            np.diff(np.cumsum(self.step_s)[samples], prepend=0.0),
            self.swing[samples],
            int(np.searchsorted(samples, self.judged)),
        )


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of some records.

    Attributes:
        samples: For each record, int64[N_i], rising.
        scale: float64[N], square root of each row's weight; of all the mean square is 1.
    """

    samples: tuple[I64, ...]
    scale: F64


def chosen(motions: Sequence[Motion], most: int) -> Rows:
    """Choose rows, as many for each swing as for each other one, and as many for each second.

    Their errors are of the swing around them, as what is judged is of its own peak-to-peak.

    Args:
        motions: The records.
        most: Rows.
    """
    swung = [motion.travel / motion.swing for motion in motions]
    passed = [m.step_s * np.minimum(m.travel / AT_REST, 1.0) for m in motions]
    samples, weights = [], []
    all_swung, all_passed = sum(map(np.sum, swung)), sum(map(np.sum, passed))
    for motion, swing, time in zip(motions, swung, passed, strict=True):
        place = np.cumsum(swing / all_swung + time / all_passed) * (0.5 * most)
        rows = 1 + np.flatnonzero(np.diff(np.floor(place)) > 0.0)
        rows = rows[rows >= motion.judged]
        close = (swing / all_swung + time / all_passed)[rows] * all_passed / motion.step_s[rows]
        samples.append(rows.astype(np.int64))
        weights.append(motion.swing[rows] ** -2.0 * close**-REPEATED)
    weight = np.concatenate(weights)
    return Rows(tuple(samples), np.sqrt(weight / weight.mean()))
