"""What is needed to repeat a result, stored with every result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.core.types import FloatArray

# The name of this distribution: of its packages, its folders, its documents.
NAME = "starcal-uq"
_VERSIONED = (NAME, "numpy", "scipy", "casadi", "emcee", "arviz")
# What is taken of an entry that is missing, where it is not None.
_MISSING: AnyDict = {
    "created_utc": "",
    "settings": {},
    "versions": {},
    "dropped_frames": (),
    "partitions": {},
    "interval_dof": {},
    "student_t": {},
    "merge": {},
}


class Provenance(dict[str, Any]):
    """What is needed to repeat a result, as files hold it.

    Code reads the attributes, which are empty or None where an entry is missing; by key it reads as
    a dictionary. A changed record is another one.

    Attributes
    ----------
    created_utc : str
        Time of the result, UTC.
    seed : int or None
        Seed; None where nothing was drawn.
    settings : dict
        Settings by their names.
    data_sha256 : str or None
        Hash of the observations.
    versions : dict
        Versions of Python and of the packages that decide the numbers.
    fallback : dict or None
        Distortion model that the data do not determine, and the simpler one used.
    dropped_frames : sequence of int
        Frames that were left out because they repeat others.
    partitions : dict
        Files of partitioned observations, with hashes of the sample and of each file.
    noise_model : dict or None
        Noise model as plain values; None where there is one noise for all.
    interval_dof : dict
        Degrees of freedom of intervals by parameter, where they are not those of the fit.
    without_coma : dict or None
        Factors on sigmas, by parameter, that leave out the coma of noise.
    student_t : dict
        Tails of a robust calibration: degrees of freedom and what else was found.
    tail_weights : dict or None
        Estimate and factors on sigmas of stars that keep the weights of their tails.
    merge : dict
        Runs that a calibration was merged from, and their consistency.
    kernels : str or None
        What made sums over all stars: ``numpy``, or ``numba`` for compiled loops.
    """

    created_utc: str
    seed: int | None
    settings: AnyDict
    data_sha256: str | None
    versions: AnyDict
    fallback: AnyDict | None
    dropped_frames: Sequence[int]
    partitions: AnyDict
    noise_model: AnyDict | None
    interval_dof: AnyDict
    without_coma: AnyDict | None
    student_t: AnyDict
    tail_weights: AnyDict | None
    merge: AnyDict
    kernels: str | None

    def __getattr__(self, name: str) -> Any:
        if name not in Provenance.__annotations__:
            raise AttributeError(f"a provenance has no attribute {name!r}")
        return self.get(name, _MISSING.get(name))

    @classmethod
    def from_dict(cls, entries: Mapping[str, Any]) -> Provenance:
        """The record that a file holds."""
        return cls(entries)

    def adding(self, **entries: Any) -> Provenance:
        """The record with further entries."""
        return Provenance({**self, **entries})

    def with_settings(self, **changed: Any) -> Provenance:
        """The record with settings added or changed."""
        return self.adding(settings=self.settings | changed)

    @property
    def version(self) -> str:
        """Version of this package."""
        return self.versions.get("starcal_uq") or ""

    @property
    def likelihood(self) -> str:
        """Name of the likelihood of a calibration."""
        return str(self.settings.get("likelihood", "marginal"))

    @property
    def inflation(self) -> AnyDict | None:
        """Factors on sigmas, by parameter, that an earlier version widened a result by."""
        found: AnyDict | None = self.get("inflation", self.settings.get("inflation"))
        return found

    def software(self, *without: str) -> str:
        """Installed packages with their versions, in one line."""
        named = self.versions.items()
        return ", ".join(f"{n} {version}" for n, version in named if version and n not in without)


def in_order(factors: AnyDict | None, names: tuple[str, ...]) -> FloatArray | None:
    """Factors of a record as an array, in the order of these names; None where it has none."""
    import numpy as np

    return None if factors is None else np.array([factors[name] for name in names])


class Traced:
    """Base of results with a provenance, which may be given as plain values."""

    provenance: Provenance

    def __post_init__(self) -> None:
        object.__setattr__(self, "provenance", Provenance(self.provenance))


@lru_cache(maxsize=32)
def installed_version(distribution: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def installed_versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that decide the numbers; None for one that is not
    installed.
    """
    import platform

    # Read from the installed metadata: importing casadi or arviz to ask for its version would cost
    # a second.
    packages = {name.replace("-", "_"): installed_version(name) for name in _VERSIONED}
    return {"python": platform.python_version(), **packages}


def provenance(seed: int | None, settings: Mapping[str, Any], data_hash: str | None) -> Provenance:
    """What is needed to repeat a result that is made now; the seed is None where none was drawn."""
    return Provenance(
        created_utc=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        seed=seed,
        settings=dict(settings),
        data_sha256=data_hash,
        versions=installed_versions(),
    )


def data_hashes(provenance: Mapping[str, Any]) -> set[str]:
    """Hashes of all data that a result rests on: its own, of its partitions, and of the runs it was
    merged from.
    """
    record = Provenance(provenance)
    hashes = {str(value) for part in record.merge.get("parts", ()) for value in part["data_sha256"]}
    hashes |= set(record.partitions.get("data_sha256", ()))
    return hashes | {str(record.data_sha256)} if record.data_sha256 else hashes
