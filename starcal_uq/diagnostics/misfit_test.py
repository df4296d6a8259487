"""One test for structure in the residuals."""

from __future__ import annotations

from dataclasses import dataclass

from starcal_uq.core.formatting import plus_minus

# Fewest degrees of freedom of a test's noise.
LEAST_DOF = 10


@dataclass(frozen=True)
class Amplitude:
    """The amplitude of one shape that the residuals ask for.

    Attributes
    ----------
    name, unit : str
        Name and unit.
    value, sigma : float
        Estimate and standard error.
    """

    name: str
    unit: str
    value: float
    sigma: float

    def __str__(self) -> str:
        return f"{self.name} {plus_minus(self.value, self.sigma)} {self.unit}"


@dataclass(frozen=True)
class MisfitTest:
    """One test.

    Attributes
    ----------
    name, against : str
        Pattern that it looks for, and the quantity that the residuals are compared with.
    statistic : float
        F, or the standard normal z of a test for unequal noise.
    dof, dof_residual : int
        Degrees of freedom of F; `dof` is 0 for z.
    p_value : float
        Probability of a statistic at least this large if the model holds.
    p_holm : float
        p-value corrected for the number of tests (Holm 1979).
    size_px : float
        Root mean square per axis of the pattern found, its noise taken off, px; NaN for unequal
        noise.
    visible : float
        Share of the squared shapes that attitudes and parameters do not absorb; NaN for unequal
        noise.
    amplitudes : tuple of Amplitude
        Amplitudes, where they mean something by themselves.
    moved_sigma : float
        Largest change of a parameter if the shapes were fitted too, in its standard deviations; NaN
        where nothing is fitted.
    moved_name : str
        That parameter.
    moved_std : float
        Standard error of that change, in the same unit: large where shapes can hardly be separated
        from the parameter.
    share : float
        Share of the frames that it is made from.
    detectable_px : float
        Root mean square per axis of a pattern that the test finds nine times in ten, at level ALPHA
        of all tests together, px; NaN for unequal noise.
    """

    name: str
    against: str
    statistic: float
    dof: int
    dof_residual: int
    p_value: float
    p_holm: float
    size_px: float
    visible: float
    amplitudes: tuple[Amplitude, ...] = ()
    moved_sigma: float = float("nan")
    moved_name: str = ""
    detectable_px: float = float("nan")
    moved_std: float = float("nan")
    share: float = 1.0

    @property
    def is_of_noise(self) -> bool:
        """Whether it looks for unequal noise; otherwise for a pattern."""
        return self.dof == 0
