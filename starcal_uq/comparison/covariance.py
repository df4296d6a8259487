"""Which covariance the difference of two estimates has, given what their data have in common.

- Different data: the covariances add.
- The same data, or data of which one set holds the other: if one estimator is efficient under the
  model of both, its errors are uncorrelated with the difference, whose covariance is then that of
  the other estimator *minus* that of the efficient one (Hausman 1978, Econometrica 46(6),
  1251-1271).
- Everything else: the correlation of the two estimates is not known from their covariances, and
  there is no p-value.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import is_special_case
from starcal_uq.core.findings import clause
from starcal_uq.core.provenance import data_hashes
from starcal_uq.inference.priors import GaussianPriors
from starcal_uq.observations.repeats import shared
from starcal_uq.observations.splits import shared_frames

if TYPE_CHECKING:
    from starcal_uq.observations.repeats import Fingerprints
    from starcal_uq.observations.table import Observations

INDEPENDENT = "independent"
SAME = "same"
A_IN_B = "A within B"
B_IN_A = "B within A"
OVERLAP = "overlapping"
# What the covariance of a difference rests on, or why there is none.
Basis = Enum(
    "Basis",
    "UNCHECKED INDEPENDENT OVERLAPPING SAME WITHIN NONE_EFFICIENT NONE_WITHIN ONE_ESTIMATE "
    "RICHER_OR_FEWER",
)


@dataclass(frozen=True)
class Rule:
    """How the covariance of the difference follows from those of the two estimates: their sum with
    `signs`, if known.

    `data` is ``independent``, ``same``, ``A within B``, ``B within A`` or ``overlapping``; `words`
    are the rule, or why there is none.
    """

    data: str
    signs: tuple[float, float] | None
    words: str


def difference_rule(
    a: Any,
    b: Any,
    labels: tuple[str, str],
    same_data: bool | None,
    observations: tuple[Observations, Observations] | None,
    fingerprints: tuple[Fingerprints | None, Fingerprints | None] = (None, None),
) -> Rule:
    """The rule for two calibrations or posteriors with their labels.

    `same_data` overrules what hashes and frames say. In the `observations`, the frames that each
    rests on, shared ones are looked for; by `fingerprints` images that were measured again are found
    as well.
    """
    data, seen = _relation(a, b, same_data, observations, fingerprints)
    if data == INDEPENDENT:
        code = Basis.UNCHECKED if seen is None else Basis.INDEPENDENT
        return Rule(data, (1.0, 1.0), clause(code))
    if data == OVERLAP:
        return Rule(data, None, clause(Basis.OVERLAPPING, n_frames=seen))
    signs = _hausman(a, b, data)
    if signs is None:
        return Rule(data, None, clause(_why_none(a, b, data)))
    efficient, other = labels if signs == (-1.0, 1.0) else labels[::-1]
    both = is_efficient(a) and is_efficient(b)
    code = Basis.SAME if data == SAME else Basis.WITHIN
    return Rule(data, signs, clause(code, efficient=efficient, other=other, both=both))


def _relation(
    a: Any,
    b: Any,
    same_data: bool | None,
    observations: tuple[Observations, Observations] | None,
    fingerprints: tuple[Fingerprints | None, Fingerprints | None],
) -> tuple[str, int | None]:
    """What the data have in common, and how many frames they were seen to share; None where that
    was not asked.
    """
    if same_data is not None:
        return (SAME if same_data else INDEPENDENT), 0
    first, second = data_hashes(a.provenance), data_hashes(b.provenance)
    if _prior_hashes(a) & second or _prior_hashes(b) & first:
        return OVERLAP, None
    if first and first == second:
        return SAME, None
    if first & second:
        return OVERLAP, None
    a_marks, b_marks = fingerprints
    common: int | None = None
    if observations is not None:
        common, sizes = shared_frames(*observations), [obs.n_frames for obs in observations]
    if a_marks is not None and b_marks is not None and not common:
        # The same pixels are the same data; the same image measured again has another error, though
        # nearly the same.
        pairs, sizes = shared(a_marks, b_marks), [len(a_marks.sizes), len(b_marks.sizes)]
        common = len(np.unique(pairs[:, 0]))
        if common and not a_marks.equal(b_marks, pairs):
            return OVERLAP, common
    if not common:
        return INDEPENDENT, common
    if common == sizes[0]:
        return (SAME if common == sizes[1] else A_IN_B), common
    return (B_IN_A if common == sizes[1] else OVERLAP), common


def _prior_hashes(result: Any) -> set[str]:
    """Hashes of the data behind a prior that came from another run."""
    priors = getattr(result, "priors", None)
    return (
        set(priors.source.get("data_sha256", ())) if isinstance(priors, GaussianPriors) else set()
    )


def _hausman(a: Any, b: Any, data: str) -> tuple[float, float] | None:
    """Signs of the covariances, minus for the efficient estimate."""
    a_first = data != A_IN_B and _efficient_beside(a, b)
    b_first = data != B_IN_A and _efficient_beside(b, a)
    if a_first == b_first:
        return None
    return (-1.0, 1.0) if a_first else (1.0, -1.0)


def _efficient_beside(one: Any, other: Any) -> bool:
    """True if `one` reaches the Cramer-Rao bound of a model that is within that of `other`."""
    return is_efficient(one) and _within(one, other)


def _within(one: Any, other: Any) -> bool:
    """True if the distortion model of `one` is that of `other` with some coefficients zero, or
    none.
    """
    return is_special_case(one.camera.distortion, other.camera.distortion)


def is_efficient(result: Any) -> bool:
    """True for estimates by the attitude-marginalised Gaussian likelihood, where frames scatter as
    it says.
    """
    if result.provenance.inflation is not None or getattr(result, "coma_factors", None) is not None:
        return False
    diagnostics = getattr(result, "diagnostics", None)
    if diagnostics is not None:
        return bool(diagnostics.likelihood == "marginal")
    return bool(result.method == "efficient" and result.provenance.likelihood == "marginal")


def _why_none(a: Any, b: Any, data: str) -> Basis:
    if not (is_efficient(a) or is_efficient(b)):
        return Basis.NONE_EFFICIENT
    if not (_within(a, b) or _within(b, a)):
        return Basis.NONE_WITHIN
    if data == SAME and a.camera.distortion == b.camera.distortion:
        return Basis.ONE_ESTIMATE
    return Basis.RICHER_OR_FEWER
