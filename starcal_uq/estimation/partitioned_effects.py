"""Effects of partitioned observations: their sums, pass by pass, and what they leave of each file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.effects import Around, Rest, TableStars, shown_by
from starcal_uq.likelihood.compressed import GramSums
from starcal_uq.likelihood.effect_sums import EffectLikelihood, EffectSums, Products
from starcal_uq.likelihood.effects import Effect
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import Extent
from starcal_uq.likelihood.sums import sum_of
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.files import column_behind
from starcal_uq.observations.partitions import Partition, PartitionedObservations, PartitionReader
from starcal_uq.observations.table import Observations, joined_columns

# Columns that effects go by, beyond those of every estimate.
_COVARIATES = {
    "zenith": "time_utc",
    "temperature": "temperature_c",
    "time": "time_utc",
    "epoch": "time_utc",
    "magnitude": "mag",
}
# Stars whose effects are taken off at once.
_STARS_AT_ONCE = 4_000


class Total(Protocol):
    """A pass: the sum over all files of what a picklable function makes of each."""

    def __call__(self, one: Callable[[Partition], Any], together: Callable[[Any], Any]) -> Any:
        """The sum of all results, by `together`."""


@dataclass(frozen=True)
class Files:
    """How files are read for effects, and the estimate that their sums are taken around."""

    reader: PartitionReader
    around: Around
    extent: Extent

    def stars(self, part: Partition) -> TableStars:
        """The stars of a file."""
        return TableStars(self.reader.load(part), self.around, None, self.extent)


def _below(zeniths: Zeniths | None, obs: Observations) -> Zeniths | None:
    return None if zeniths is None else zeniths.seen_in(obs)


def _extent(reader: PartitionReader, part: Partition) -> Extent:
    return Extent.of(reader.load(part))


def _linear(
    files: Files, names: Sequence[str], zeniths: Zeniths | None, part: Partition
) -> Products:
    stars = files.stars(part)
    return stars.linear(names, _below(zeniths, stars.obs)).total


def _expanded(
    files: Files,
    names: Sequence[str],
    zeniths: Zeniths | None,
    theta: FloatArray,
    whitening: FloatArray,
    sigma: float,
    part: Partition,
) -> tuple[GramSums, Products]:
    stars = files.stars(part)
    below = _below(zeniths, stars.obs)
    plain, sums = stars.expanded(names, below, theta, whitening, sigma)
    return plain, sums.total


def _together(parts: Sequence[tuple[GramSums, Products]]) -> tuple[GramSums, Products]:
    return sum_of([part[0] for part in parts]), Products.joined([part[1] for part in parts])


class FileStars:
    """All stars of partitions, of which `obs` is a sample; see `effects.Stars`."""

    def __init__(
        self,
        parts: PartitionedObservations,
        obs: Observations,
        around: Around,
        dof: int,
        wanted: Sequence[str],
        total: Total,
    ) -> None:
        asked = _COVARIATES if "auto" in wanted else wanted
        names = sorted({_COVARIATES[name] for name in asked if name in _COVARIATES})
        names = [name for name in names if name in obs.columns]
        _check_columns(parts, names)
        reader = replace(parts.reader, also=tuple(names))
        found = total(partial(_extent, reader), Extent.joined) if names else Extent.of(obs)
        self.obs, self.dof, self.extent = obs, dof, found
        self.files, self._total = Files(reader, around, found), total
        self._sample = TableStars(obs, around, None, found)

    def effects(self, zeniths: Zeniths | None) -> dict[str, Effect]:
        """As `effects.Stars`; their columns are those of the sample."""
        return self._sample.effects(zeniths)

    def _sums(
        self, names: Sequence[str], zeniths: Zeniths | None, place: int, products: Products
    ) -> EffectSums:
        known, at = self.effects(zeniths), self.files.around
        sums = EffectSums([known[n] for n in names], at.theta, at.sigma, place, apart=False)
        sums.parts.append(products)
        return sums

    def linear(self, names: Sequence[str], zeniths: Zeniths | None) -> EffectSums:
        """As `effects.Stars`."""
        found = self._total(partial(_linear, self.files, names, zeniths), Products.joined)
        return self._sums(names, zeniths, -1, found)

    def expanded(
        self,
        names: Sequence[str],
        zeniths: Zeniths | None,
        theta: FloatArray,
        whitening: FloatArray,
        sigma: float,
    ) -> tuple[GramSums, EffectSums]:
        """As `effects.Stars`."""
        at = names, zeniths, theta, whitening, sigma
        plain, products = self._total(partial(_expanded, self.files, *at), _together)
        return plain, self._sums(names, zeniths, 0, products)


def _check_columns(parts: PartitionedObservations, names: Sequence[str]) -> None:
    """Columns that effects go by must be in all files, or in none where they are declared for all
    stars.
    """
    for name in names:
        own = [column_behind(parts.reader.columns.get(name, name), p.names) for p in parts.parts]
        held = [column in part.names for column, part in zip(own, parts.parts, strict=True)]
        if any(held) and not all(held):
            lacking = held.index(False)
            raise ObservationError(
                f"{parts.parts[lacking].path}: column {own[lacking]} ({COLUMNS[name].description}) "
                "is missing, and other files have it; write it to all files, or to none.",
                column=own[lacking],
            )


@dataclass(frozen=True)
class Beside:
    """What effects that are estimated leave of a file.

    `camera`, `sigma`: the estimate beside them.
    """

    files: Files
    effects: Effects
    theta: FloatArray
    sigma: float

    def rests(self, part: Partition) -> list[tuple[Observations, Rest]]:
        """Some frames at a time: the table, and what is left of it."""
        obs = self.files.reader.load(part)
        n = max(1, obs.n_frames * _STARS_AT_ONCE // obs.n_stars)
        edges = obs.frame_starts[np.append(np.arange(0, obs.n_frames, n), obs.n_frames)]
        found = []
        for first, last in pairwise(edges):
            columns = {name: values[first:last] for name, values in obs.columns.items()}
            some = replace(obs, **columns)
            found.append((some, self._rest(some)))
        return found

    def _rest(self, obs: Observations) -> Rest:
        held, at = self.effects, self.files.around
        held = replace(held, zeniths=_below(held.zeniths, obs))
        likelihood = MarginalLikelihood(obs, at.camera.distortion)
        exact = EffectLikelihood(
            likelihood.frames,
            at.camera.distortion,
            held.of(obs, at.camera),
            held.ratio(self.sigma),
            self.theta,
            likelihood.start_rotations(self.theta),
            self.sigma,
            held.coefficients,
        )
        return Rest.of(exact, self.theta)

    def cleared(self, rests: Sequence[tuple[Observations, Rest]]) -> Observations:
        """The table where the camera of the estimate alone would show its stars."""
        camera = self.files.around.camera.with_theta(self.theta)
        tables = [shown_by(some, camera, rest.rotations, rest.residuals_px) for some, rest in rests]
        return Observations(**joined_columns(tables), meta=tables[0].meta)
