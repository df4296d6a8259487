"""The result of planning a calibration: forecast, frames needed, and what else would change them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starcal_uq.camera.camera import Camera
from starcal_uq.core.formatting import significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.planning.forecast import Forecast

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

    from starcal_uq.planning.check import ForecastCheck
    from starcal_uq.planning.frame_choice_result import FrameChoice


@dataclass(frozen=True)
class Need:
    """Frames that keep a target, for one part of the attitude error.

    Attributes
    ----------
    scope : str
        Part of the error: ``common``, ``rest``, ``calibration`` or ``total``.
    frames : int or None
        Fewest frames that keep it on average over campaigns; None where no number does.
    frames_surely : int or None
        Fewest frames with which 95 % of the campaigns keep it.
    floor_arcsec : float
        What no number of frames goes below.
    """

    scope: str
    frames: int | None
    frames_surely: int | None
    floor_arcsec: float

    @property
    def words(self) -> str:
        """`frames` to three digits, rounded up, as it is printed; or why there is no number."""
        from starcal_uq.presentation.words.planning import need_words

        return need_words(self, self.frames)


@dataclass(frozen=True, eq=False)
class Plan:
    """What a calibration will give, before any data.

    Attributes
    ----------
    camera : Camera
        The sheet.
    sigma_px : float
        Centroid noise, px per axis; root mean square over the stars where it depends on magnitude.
    max_mag : float
        Faintest magnitude.
    min_stars : int
        Least stars in a frame.
    mean_stars : float
        Stars in a frame on average.
    sky_fraction : float
        Part of random attitudes that show `min_stars`.
    forecast : Forecast
        Against number of frames.
    nea_arcsec : (3,) array
        Noise-equivalent angle of single frames, 1 sigma per axis, root mean square over frames.
    confidence : float
        Of two-axis errors.
    scope : str
        Part of the attitude error that the radius of the forecast is of.
    target_arcsec : float or None
        Two-axis error across the boresight that is asked for.
    needs : tuple of Need
        Frames that keep the target, for each part of the error; empty without a target.
    sweeps : pandas.DataFrame or None
        The same forecast with another magnitude limit, noise or part of the detector.
    seed : int
        Of the drawn geometries.
    provenance : dict
        Versions, settings and time.
    """

    camera: Camera
    sigma_px: float
    max_mag: float
    min_stars: int
    mean_stars: float
    sky_fraction: float
    forecast: Forecast
    nea_arcsec: FloatArray
    confidence: float
    scope: str
    target_arcsec: float | None
    needs: tuple[Need, ...]
    sweeps: pd.DataFrame | None
    seed: int
    provenance: AnyDict

    @property
    def frames_needed(self) -> int | None:
        """Fewest frames that keep the target on average, in the scope asked for; None without one."""
        return None if self.need is None else self.need.frames

    @property
    def need(self) -> Need | None:
        """Frames for the target in the scope asked for; None without a target."""
        return next((need for need in self.needs if need.scope == self.scope), None)

    @property
    def verdict(self) -> str:
        """What was found, in plain words."""
        from starcal_uq.presentation.words.planning import verdict

        return verdict(self)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per number of frames.

        Columns are ``n_frames``; 1 sigma of every parameter, of the displacement that its distortion error causes in
        the farthest corner, and per axis of common rotation, rest and NEA; ``noise_relative``, the relative standard
        error of the noise; and ``radius_arcsec``, the two-axis error at the confidence, with the range of 90 % of the
        campaigns.
        """
        table = self.forecast.to_dataframe()
        place = int(table.columns.get_loc("noise_relative"))
        for axis, value in zip(("pitch", "yaw", "roll"), self.nea_arcsec, strict=True):
            table.insert(place, f"nea_{axis}_arcsec", float(value))
            place += 1
        return table

    def plot_forecast(self, **options: Any) -> Any:
        """Attitude error against number of frames; `starcal_uq.presentation.figures.planning.plot_forecast`."""
        from starcal_uq.presentation.figures.planning import plot_forecast

        return plot_forecast(self, **options)

    def plot_sweeps(self, **options: Any) -> Any:
        """Magnitude limit, noise and field: `starcal_uq.presentation.figures.planning.plot_plan_sweeps`."""
        from starcal_uq.presentation.figures.planning import plot_plan_sweeps

        return plot_plan_sweeps(self, **options)

    def save(
        self,
        folder: str | os.PathLike[str],
        *,
        choice: FrameChoice | None = None,
        check: ForecastCheck | None = None,
    ) -> Path:
        """Write ``plan.html`` (self-contained), ``plan.csv``, ``sweeps.csv``, ``plan.json`` and figures to a folder.

        Parameters
        ----------
        folder : path
            Made if it is missing; files in it are overwritten.
        choice : FrameChoice, optional
            Frames to take, for the page and ``frames.csv``.
        check : ForecastCheck, optional
            Forecast against simulation, for the page and ``check.csv``.

        Returns
        -------
        Path
            Of the page.
        """
        from starcal_uq.presentation.pages.planning import write_plan

        return write_plan(self, folder, choice, check)

    def _repr_html_(self) -> str:
        from html import escape

        shown = ["n_frames", "x0_px", "f_mm", "common_pitch_arcsec", "rest_pitch_arcsec", "nea_pitch_arcsec"]
        table = self.to_dataframe()[[*shown, "radius_arcsec"]]
        html = table.to_html(index=False, float_format=lambda v: significant(v, 3), border=0)
        return f"<p><b>Plan</b>: {escape(self.verdict)}</p>{html}"
