"""What is needed to repeat a result, stored with every result."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from starcal_uq.core.types import AnyDict

# The name of this distribution: of its packages, its folders, its documents.
NAME = "starcal-uq"
_VERSIONED = (NAME, "numpy", "scipy", "casadi", "emcee", "arviz")


@lru_cache(maxsize=32)
def installed_version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def provenance(
    seed: int | None, settings: Mapping[str, Any], data_hash: str | None
) -> dict[str, Any]:
    """What is needed to repeat a result: time, seed (None where none was drawn), settings, data
    hash and versions.

    The versions are those of Python and of the packages that decide the numbers; None for one that
    is not installed.
    """
    versions: dict[str, str | None] = {"python": platform.python_version()}
    # Read from the installed metadata: importing casadi or arviz to ask for its version would cost
    # a second.
    versions.update({name.replace("-", "_"): installed_version(name) for name in _VERSIONED})
    return {
        "created_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "seed": seed,
        "settings": dict(settings),
        "data_sha256": data_hash,
        "versions": versions,
    }


def data_hashes(provenance: AnyDict) -> set[str]:
    """Hashes of all data that a result rests on: its own, of its partitions, and of the runs it was
    merged from.
    """
    parts = provenance.get("merge", {}).get("parts", [])
    hashes = {str(value) for part in parts for value in part["data_sha256"]}
    hashes |= set(provenance.get("partitions", {}).get("data_sha256", ()))
    return hashes | {str(provenance["data_sha256"])} if provenance.get("data_sha256") else hashes
