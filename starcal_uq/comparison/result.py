"""What differs between two calibrated cameras, and whether chance explains it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.records import read_json, to_plain, write_json
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.types import AnyDict, FloatArray, PathLike
from starcal_uq.maths.linear import root_diagonal

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class CameraComparison(Shown):
    """Directions of camera B minus directions of camera A at the same pixels, best rotation
    removed.

    p-values are NaN, and uncertainties of the difference too, where the covariance of the
    difference is not known.

    Attributes
    ----------
    labels : (str, str)
        Names of A and B.
    models : (str, str)
        Distortion models of the two.
    data : str
        Relation of their data: ``independent``, ``same``, ``A within B``, ``B within A``,
        ``overlapping``.
    rule : str
        How the covariance of the difference was had, in words, or why it is not known.
    level : float
        Probability at most of a false alarm of `verdict`.
    x_px, y_px : (n,) array
        Grid over the detector, px.
    difference_arcsec : (n, n, 2) array
        Difference of directions along camera X and Y after the rotation was removed.
    difference_px : (n, n, 2) array
        Difference as the shift of the image point in camera A, px.
    sigma_arcsec : (n, n) array
        Root mean square length that the joint uncertainty gives the difference at each pixel.
    ratio : (n, n) array
        Length of the difference, in the directions that were tested, over `sigma_arcsec`.
    rotation_arcsec : (3,) array
        Rotation removed: pitch, yaw, roll of an attitude by B minus that by A.
    rotation_covariance_arcsec2 : (3, 3) array
        Covariance of the rotation, arcsec^2.
    rms_arcsec, rms_px, expected_rms_arcsec : float
        Root mean square length over the detector area, and what the joint uncertainty gives on
        average.
    largest_arcsec, largest_px : float
        Largest length over the grid.
    p_map : float
        Probability of a larger mean square over the detector if both cameras were the same.
    p_parameters : float
        The same for the squared Mahalanobis length of the whole difference, `statistic`; NaN, like
        `p_worst`, where the covariance is not known well enough direction by direction.
    statistic : float
        Chi-square, or r times F, of the whole difference; NaN where `p_parameters` is.
    n_directions : int
        Independent directions r in which the two can differ and were compared.
    p_worst, p_worst_error : float
        Probability of a largest `ratio` over the grid beyond the one here, and its Monte Carlo
        standard error.
    worst_x_px, worst_y_px, worst_ratio : float
        Place where that ratio is largest, px, and the ratio there.
    outside_arcsec : float
        Root mean square of what no error of the parameters explains: models that cannot agree.
    parameter_names, parameter_units : tuple of str
        The q parameters that mean the same in both models.
    theta_a, theta_b, sd_a, sd_b, sd_difference : (q,) array
        Estimates of both, standard deviations, and that of the difference.
    messages : tuple of str
        Sentences that should be known when reading this.
    provenance : Provenance
        Provenance of both results, by ``a`` and ``b``, and the settings of the comparison.
    """

    labels: tuple[str, str]
    models: tuple[str, str]
    data: str
    rule: str
    level: float
    x_px: FloatArray
    y_px: FloatArray
    difference_arcsec: FloatArray
    difference_px: FloatArray
    sigma_arcsec: FloatArray
    ratio: FloatArray
    rotation_arcsec: FloatArray
    rotation_covariance_arcsec2: FloatArray
    rms_arcsec: float
    rms_px: float
    expected_rms_arcsec: float
    largest_arcsec: float
    largest_px: float
    p_map: float
    p_parameters: float
    statistic: float
    n_directions: int
    p_worst: float
    p_worst_error: float
    worst_x_px: float
    worst_y_px: float
    worst_ratio: float
    outside_arcsec: float
    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    theta_a: FloatArray
    theta_b: FloatArray
    sd_a: FloatArray
    sd_b: FloatArray
    sd_difference: FloatArray
    messages: tuple[str, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)

    SHAPES: ClassVar = """
        x: x_px
        y: y_px
        y x: sigma_arcsec ratio
        y x 2: difference_arcsec difference_px
        3: rotation_arcsec
        3 3: rotation_covariance_arcsec2
        q: parameter_names parameter_units theta_a theta_b sd_a sd_b sd_difference
    """

    @property
    def tested(self) -> bool:
        """False if the covariance of the difference is unknown."""
        return bool(np.isfinite(self.p_map))

    @property
    def verdict(self) -> str:
        """``agree``, ``maps differ``, ``parameters differ`` or ``not tested``.

        Each of the two p-values is compared with half the level, so that both together keep it.
        """
        if not self.tested:
            return "not tested"
        if self.p_map < 0.5 * self.level:
            return "maps differ"
        return "parameters differ" if self.p_parameters < 0.5 * self.level else "agree"

    @property
    def agree(self) -> bool | None:
        """True if chance explains all differences, False if not, None if this was not tested."""
        return None if not self.tested else self.verdict == "agree"

    @property
    def rotation_sigma_arcsec(self) -> FloatArray:
        """Standard deviations (3,) of the rotation."""
        return root_diagonal(self.rotation_covariance_arcsec2)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per quantity: ``quantity``, ``unit``, ``difference``, ``expected``, ``ratio``,
        ``p_value``.

        ``expected`` is one standard deviation, or for the map the root mean square that the
        uncertainties give.
        """
        import pandas as pd

        rows = [
            (f"rotation, {axis}", "arcsec", float(value), float(sigma), np.nan)
            for axis, value, sigma in zip(
                AXES, self.rotation_arcsec, self.rotation_sigma_arcsec, strict=True
            )
        ]
        rows.append(("map, rms", "arcsec", self.rms_arcsec, self.expected_rms_arcsec, self.p_map))
        sigma = float(self.sigma_arcsec[self._worst_index])
        rows.append(
            (
                "map, where it stands out most",
                "arcsec",
                self.worst_ratio * sigma,
                sigma,
                self.p_worst,
            )
            if self.tested
            else ("map, largest", "arcsec", self.largest_arcsec, np.nan, np.nan)
        )
        rows += [
            (name, unit, float(b - a), float(sd), np.nan)
            for name, unit, a, b, sd in zip(
                self.parameter_names,
                self.parameter_units,
                self.theta_a,
                self.theta_b,
                self.sd_difference,
                strict=True,
            )
        ]
        if np.isfinite(self.p_parameters):
            rows.append(
                (
                    "all parameters",
                    "chi-square",
                    self.statistic,
                    float(self.n_directions),
                    self.p_parameters,
                )
            )
        table = pd.DataFrame(
            rows, columns=["quantity", "unit", "difference", "expected", "p_value"]
        )
        expected = table["expected"].where(table["expected"] > 0.0)
        table.insert(4, "ratio", table["difference"] / expected)
        return table

    @property
    def _worst_index(self) -> tuple[int, int]:
        if not self.tested:
            return 0, 0
        return (
            int(np.argmin(np.abs(self.y_px - self.worst_y_px))),
            int(np.argmin(np.abs(self.x_px - self.worst_x_px))),
        )

    def field_dataframe(self) -> pd.DataFrame:
        """One row per grid pixel: place, difference in px and arcsec, its length, and the expected
        length.
        """
        import pandas as pd

        x, y = np.meshgrid(self.x_px, self.y_px)
        return pd.DataFrame(
            {
                "x_px": x.ravel(),
                "y_px": y.ravel(),
                "dx_px": self.difference_px[..., 0].ravel(),
                "dy_px": self.difference_px[..., 1].ravel(),
                "dx_arcsec": self.difference_arcsec[..., 0].ravel(),
                "dy_arcsec": self.difference_arcsec[..., 1].ravel(),
                "length_arcsec": np.linalg.norm(self.difference_arcsec, axis=-1).ravel(),
                "expected_arcsec": self.sigma_arcsec.ravel(),
            }
        )

    def save(self, path: PathLike) -> None:
        """Write everything as JSON, atomically; overwritten."""
        write_json(self.to_dict(), path)

    def to_dict(self) -> AnyDict:
        """Plain values, for JSON; NaN is null."""
        return {"verdict": self.verdict, **to_plain(self, null=True)}

    @classmethod
    def load(cls, path: PathLike) -> CameraComparison:
        """Read ``comparison.json``, or the folder that holds it, without loss.

        Raises
        ------
        RunFolderError
            If it is missing or is not a comparison.
        """
        path = Path(path)
        if path.is_dir():
            path = path / "comparison.json"
        remedy = Remedy("compare", ("RUN_A", "RUN_B"), {"out": "DIR"}, "to write it")
        return read_json(cls, path, "a comparison of cameras", remedy)
