"""Effects of partitioned observations: their sums, pass by pass, and what they leave of each file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.effects import Around, Rest, Stars, shown_by
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.likelihood.compressed import GramSums
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.effect_sums import EffectSums, Products
from starcal_uq.likelihood.effects import run_shifts
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import Extent
from starcal_uq.likelihood.sums import sum_of
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.files import column_behind
from starcal_uq.observations.partitions import Partition, PartitionedObservations, PartitionReader
from starcal_uq.observations.table import Observations

# Columns that effects go by, beyond those of every estimate.
_COVARIATES = {
    "zenith": "time_utc",
    "temperature": "temperature_c",
    "time": "time_utc",
    "epoch": "time_utc",
    "magnitude": "mag",
}


# A pass: the sum over all files of what a picklable function makes of each, by another one.
Total: TypeAlias = Callable[[Callable[[Partition], Any], Callable[[Any], Any]], Any]


@dataclass(frozen=True)
class Files:
    """How files are read for effects, and the estimate that their sums are taken around."""

    reader: PartitionReader
    around: Around
    extent: Extent


def _below(zeniths: Zeniths | None, obs: Observations) -> Zeniths | None:
    return None if zeniths is None else zeniths.seen_in(obs)


def _extent(reader: PartitionReader, part: Partition) -> Extent:
    return Extent.of(reader.load(part))


def _made(
    files: Files,
    names: Sequence[str],
    zeniths: Zeniths | None,
    at: Around,
    part: Partition,
) -> tuple[list[GramSums], Products]:
    stars = Stars(files.reader.load(part), files.around, None, files.extent)
    plain, sums = stars.made(names, _below(zeniths, stars.obs), at)
    return [] if plain is None else [plain], sums.total


def _together(
    parts: Sequence[tuple[list[GramSums], Products]],
) -> tuple[list[GramSums], Products]:
    plain = [one for part in parts for one in part[0]]
    return [sum_of(plain)] if plain else [], Products.joined([part[1] for part in parts])


class FileStars(Stars):
    """All stars of partitions, of which `obs` is a sample."""

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
        super().__init__(obs, around, None, found)
        self.dof, self._total = dof, total
        self.files = Files(reader, around, found)

    def made(
        self, names: Sequence[str], zeniths: Zeniths | None, at: Around
    ) -> tuple[GramSums | None, EffectSums]:
        plain, products = self._total(partial(_made, self.files, names, zeniths, at), _together)
        return next(iter(plain), None), self.sums(names, zeniths, at, products)


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

    `theta` (p,), `sigma`: the estimate beside them.
    """

    files: Files
    effects: Effects
    theta: FloatArray
    sigma: float

    def cleared(
        self, part: Partition, scale: FloatArray
    ) -> tuple[Observations, FrameNormals | None]:
        """The table where the camera of the estimate alone would show its stars; and where frames
        have coefficients, what they leave of what each says about the parameters, in these units
        (p,).
        """
        obs, at = self.files.reader.load(part), self.files.around
        held = replace(self.effects, zeniths=_below(self.effects.zeniths, obs))
        effects = held.of(obs, at.camera)
        run = [(e, held.coefficients[held.at(e.name)]) for e in effects if e.grouping == "run"]
        if run:
            x, y = run_shifts(MarginalLikelihood(obs, at.camera.distortion), run, self.theta)
            obs = replace(obs, x_px=obs.x_px - x, y_px=obs.y_px - y)
        local = [effect for effect in effects if effect.grouping != "run"]
        if not local:
            return obs, None
        model = at.camera.distortion
        likelihood = MarginalLikelihood(obs, model)
        exact = EffectLikelihood(
            likelihood.frames,
            model,
            local,
            held.ratio(self.sigma),
            self.theta,
            likelihood.start_rotations(self.theta),
            self.sigma,
        )
        rest, camera = Rest.of(exact, self.theta), at.camera.with_theta(self.theta)
        table = shown_by(obs, camera, rest.rotations, rest.residuals_px)
        return table, FrameNormals.beside(exact, self.theta, scale)
