"""Is a printed number reproduced? Its distance from what an experiment gives over seeds, reading by
reading.

A printed number is one draw of an experiment. Under a reading that is right it lies among our own
draws: its distance from their mean, over the spread that a new draw has around an estimated mean,
is a z of order one. Error sizes are compared on a logarithmic scale, since they cannot be negative.
Rounding adds its own variance, a twelfth of the last place squared.

A printed digit is noise when 95 % of the draws cover all ten values that it can have: whoever ran
the experiment again would find another digit there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from starcal_uq.core.types import FloatArray, floats
from starcal_uq.maths.intervals import HALF_WIDTH_95, mean_and_sd
from starcal_uq.paper.published import Printed

# Of 24 numbers under the right reading, one in fifteen tables has one beyond.
MAX_Z = 3.0
# A reading other than the main one explains a number only if it would have refused most others.
MAX_CHANCE = 0.25
# Relative scatter of sums that are the same numbers.
_ROUNDING = 1e-12


class Outcome(Enum):
    """What became of a printed number; the value says it in words."""

    REPRODUCED = "reproduced"
    WITHIN_NOISE = "within noise"
    AGAINST_TEXT = "only against the text"
    BY_CHOICE = "only by choice of reading"
    NOT_REPRODUCED = "not reproduced"


class Trial(NamedTuple):
    """A printed number under one reading, which the paper's text allows (`faithful`) or not.

    `mean` and `spread` are of the n draws; of error sizes, the geometric mean and the spread of the
    logarithm times it. `z` is the distance of the printed number from `middle` over `scale`, the
    standard deviation of a new draw with rounding; these are of the logarithm for error sizes.
    `noise_digits` of the printed digits are noise.
    """

    reading: str
    faithful: bool
    n: int
    mean: float
    spread: float
    middle: float
    scale: float
    z: float
    noise_digits: int

    @property
    def accepted(self) -> bool:
        """Whether the number may be a draw of this experiment."""
        return abs(self.z) <= MAX_Z


@dataclass(frozen=True)
class Judged:
    """A printed number and every reading tried, the main one first."""

    printed: Printed
    trials: tuple[Trial, ...]

    @property
    def main(self) -> Trial:
        """The reading that follows the text most closely."""
        return self.trials[0]

    @property
    def best(self) -> Trial:
        """The main reading if it accepts the number, else the closest of those that do, faithful
        ones first.

        Where none does, the closest of all.
        """
        if self.main.accepted:
            return self.main
        accepted = [t for t in self.trials if t.accepted]
        faithful = [t for t in accepted if t.faithful]
        if accepted:
            # Of those that differ by less than a standard deviation, the first: it departs least
            # from the main one.
            return min(faithful or accepted, key=lambda t: int(abs(t.z)))
        return min(self.trials, key=lambda t: abs(t.z))

    @property
    def noise_digits(self) -> int:
        """Printed digits that are noise: under the best reading if it accepts the number, else
        under the main one.
        """
        return self.best.noise_digits if self.best.accepted else self.main.noise_digits

    @property
    def outcome(self) -> Outcome:
        """The verdict on the number."""
        best = self.best
        if not best.accepted:
            return Outcome.NOT_REPRODUCED
        if self.by_chance > MAX_CHANCE:
            return Outcome.BY_CHOICE
        if not best.faithful:
            return Outcome.AGAINST_TEXT
        return Outcome.WITHIN_NOISE if best.noise_digits else Outcome.REPRODUCED

    @property
    def by_chance(self) -> float:
        """How easily some reading accepts a number that the main one does not: a guard against
        trying too many.

        The share of numbers no farther from the main reading than the printed one that are accepted
        by a reading as sharp as the best one, and as faithful. NaN where the main reading accepts
        the number, or none does.
        """
        best, main = self.best, self.main
        if main.accepted or not best.accepted:
            return float("nan")
        reach = abs(main.z) * main.scale
        low, high = main.middle - reach, main.middle + reach
        rivals = [
            t for t in self.trials if t.scale <= best.scale and (t.faithful or not best.faithful)
        ]
        covered, edge = 0.0, low
        for t in sorted(rivals, key=lambda t: t.middle - MAX_Z * t.scale):
            first = max(t.middle - MAX_Z * t.scale, edge)
            last = min(t.middle + MAX_Z * t.scale, high)
            covered += max(last - first, 0.0)
            edge = max(edge, last)
        return covered / (high - low)


def trial(
    number: Printed, reading: str, faithful: bool, draws: FloatArray | Sequence[float]
) -> Trial:
    """Compare a printed number with draws (n,) of a reading, of which two must be finite (else
    ValueError).
    """
    values = floats(draws)
    values = values[np.isfinite(values)]
    n = len(values)
    if n < 2:
        raise ValueError(
            f"the reading {reading!r} has {n} finite draws of {number.quantity}; a spread needs "
            "two."
        )
    step = number.unit_in_last_place
    if number.is_error_size:
        logs = np.log(np.maximum(values, np.finfo(float).tiny))
        middle, width = mean_and_sd(logs)
        rounding = step / number.value
        distance = float(np.log(number.value)) - middle
        mean = float(np.exp(middle))
        spread = mean * width
        covered = mean * 2.0 * float(np.sinh(HALF_WIDTH_95 * width))
    else:
        mean, spread = mean_and_sd(values)
        middle, width, rounding, distance = mean, spread, step, number.value - mean
        covered = 2.0 * HALF_WIDTH_95 * spread
    if spread <= _ROUNDING * abs(mean):
        # What does not depend on the seed has no spread, whatever the last bits say.
        width, spread, covered = 0.0, 0.0, 0.0
    scale = float(np.sqrt(width**2 * (1.0 + 1.0 / n) + rounding**2 / 12.0))
    return Trial(
        reading,
        faithful,
        n,
        mean,
        spread,
        middle,
        scale,
        distance / scale,
        _noise_digits(number, covered),
    )


def _noise_digits(number: Printed, covered: float) -> int:
    digits = number.text.lower().partition("e")[0].lstrip("-").replace(".", "").lstrip("0")
    places = number.unit_in_last_place * 10.0 ** np.arange(len(digits))
    return int(np.sum(covered >= 10.0 * places))
