"""Quantiles and combination rules of the error budget."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from starcal_uq.budgeting.file import Requirement
from starcal_uq.budgeting.result import Outcome
from starcal_uq.budgeting.rows import GAUSSIAN_997, Contributor
from starcal_uq.budgeting.sampling import draw
from starcal_uq.budgeting.shapes import (
    half_width,
    one_axis_factor,
)
from starcal_uq.budgeting.totals import (
    Total,
    _heaviest,
    total,
    totals,
)


def row(name: str, sigma: float, axis: str = "pitch", **changes: object) -> Contributor:
    return Contributor(
        **{  # type: ignore[arg-type]
            **{
                "name": name,
                "ecss_class": "other",
                "axis": axis,
                "mean_arcsec": 0.0,
                "sigma_arcsec": sigma,
            },
            **{"source": "file", "provenance": "test"},
            **changes,
        }
    )


def both(name: str, sigma: float, **changes: object) -> list[Contributor]:
    return [row(name, sigma, axis, **changes) for axis in ("pitch", "yaw")]


def combined(
    rows: list[Contributor], axis: str = "pitch", confidence: float = 0.997, **changes: object
) -> Total:
    options = {"scope": "before alignment", "interpretation": "mixed", **changes}
    return total(rows, draw(rows, 200_000, 3), axis=axis, confidence=confidence, **options)  # type: ignore[arg-type]


def test_what_is_absorbed_in_part_leaves_a_limit_open() -> None:
    rows = [row("ground", 6.0, absorbed_by_alignment="in part"), row("noise", 1.0)]
    found = combined(rows, scope="after alignment")
    assert found.rule_arcsec == pytest.approx(math.sqrt(37.0) * one_axis_factor(0.997))
    # By the rule, or by sampling where that is less.
    assert found.rule_least_arcsec == pytest.approx(one_axis_factor(0.997), rel=0.01)
    assert found.rule_least_arcsec <= found.sampled_least_arcsec
    for limit, verdict in ((2.0, "violated"), (10.0, "open"), (20.0, "met")):
        assert Outcome(Requirement("R", "pitch", limit, 0.997), found).verdict == verdict
    # Control: before alignment it is there in full.
    before = Outcome(Requirement("R", "pitch", 10.0, 0.997, "before alignment"), combined(rows))
    assert before.verdict == "violated"


def nested(
    constant: list[tuple[str, float, np.ndarray]],
    noise: np.ndarray,
    confidence: float,
    rng: np.random.Generator,
    sizes: tuple[int, int] = (4000, 4000),
) -> float:
    """NumPy alone: quantile over moments for each of many sensors, and of these the quantile over
    sensors.

    Constants are a group, a sigma with the sign of its row, and a direction (axes,); noise is
    sigmas (axes,). Both are Gaussian, and rows of one group share their deviate.
    """
    drawn = {group: rng.standard_normal(sizes[0]) for group, _, _ in constant}
    sensors = sum(
        (sigma * drawn[group][:, None] * axis for group, sigma, axis in constant), start=np.zeros(1)
    )
    moments = noise * rng.standard_normal((sizes[1], len(noise)))
    place = int(confidence * sizes[1])
    reached = [np.partition(np.linalg.norm(own + moments, axis=1), place)[place] for own in sensors]
    return float(np.quantile(reached, confidence))


OPTICS = (("A", 3.0, "opt"), ("B", 4.0, "opt"), ("C", 2.0, "-opt"))


@pytest.mark.parametrize("axis", ["pitch", "cross-boresight"])
def test_signs_count_in_a_group_that_is_at_its_worst(axis: str) -> None:
    """A and B against C: one cause of 5 arcsec, and noise of 5."""
    axes = ["pitch"] if axis == "pitch" else ["pitch", "yaw"]
    rows = [
        row(name, sigma, one, correlation_group=group)
        for one in axes
        for name, sigma, group in OPTICS
    ]
    rows += [row("noise", 5.0, one, interpretation="temporal") for one in axes]
    found = combined(rows, axis, interpretation="temporal")
    along = np.ones(len(axes))
    signed = [("opt", 3.0, along), ("opt", 4.0, along), ("opt", -2.0, along)]
    drawn = nested(signed, 5.0 * along, 0.997, np.random.default_rng(5))
    one_cause = one_axis_factor(0.997) * 5.0 * math.sqrt(len(axes))
    assert (
        found.worst_arcsec
        == pytest.approx(one_cause)
        == pytest.approx(found.rule_arcsec - found.factor * 5.0)
    )
    assert found.sampled_least_arcsec == pytest.approx(drawn, rel=0.06)
    assert found.rule_least_arcsec <= found.sampled_least_arcsec
    limit = 1.2 * found.sampled_least_arcsec
    for judge in ("both", "rule", "sampling"):
        outcome = Outcome(
            Requirement("R", axis, limit, 0.997, "before alignment", "temporal", judge), found
        )
        assert outcome.verdict == "met" and outcome.least_arcsec < limit
    # Control: without the sign of C, nested draws and the budget agree that the limit is violated.
    plain = [
        dataclasses.replace(entry, correlation_group=entry.correlation_group.lstrip("-"))
        for entry in rows
    ]
    unsigned = [(group, abs(sigma), direction) for group, sigma, direction in signed]
    assert nested(unsigned, 5.0 * along, 0.997, np.random.default_rng(5)) > limit
    assert combined(plain, axis, interpretation="temporal").sampled_least_arcsec > limit


def test_a_quantile_beyond_the_samples_is_not_known() -> None:
    rows = [row("noise", 6.6, tail_997=3.9)]
    found = combined(rows, confidence=0.9999999)
    assert math.isnan(found.sampled_arcsec) and found.unresolved and math.isnan(found.larger_arcsec)
    assert "200000 samples do not resolve" in found.explanation
    # Negative control: the largest of so many samples is far below the quantile, and known where 20
    # lie beyond.
    true = 6.6 * half_width("gaussian", 0.9999999, 3.9)
    assert np.abs(draw(rows, 200_000, 3).sums["before alignment", "ensemble"]).max() < 0.9 * true
    resolved = combined(rows, confidence=0.9999)
    assert (
        abs(resolved.sampled_arcsec - 6.6 * half_width("gaussian", 0.9999, 3.9))
        < 4.0 * resolved.sampled_se_arcsec
    )
    # What has no spread needs no samples.
    assert (
        combined([row("shift", 0.0, mean_arcsec=2.0)], confidence=0.9999999).sampled_arcsec == 2.0
    )
    nothing = combined([row("one", 0.0), row("other", 0.0)])
    assert (nothing.dominant, nothing.dominant_share, nothing.rule_arcsec) == ("", 0.0, 0.0)
    assert nothing.explanation.startswith("No error is left")


def test_the_combination_of_a_row_is_said() -> None:
    for group, words in (
        ("", "in squares"),
        ("heat", "linear within group 'heat', then in squares"),
        ("- heat", "linear within group 'heat', then in squares (against the others)"),
    ):
        assert row("bend", 1.0, correlation_group=group).combination == words
    assert row("bend", 1.0, source="not assessed").combination == "not in the totals"


CORRELATION = np.array([[1.0, 0.3, -0.1], [0.3, 1.0, 0.8], [-0.1, 0.8, 1.0]])
# The payload looks along the sensor's -X, turned by 20 degrees.
TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
ROLLED = np.array(
    [[np.cos(0.35), np.sin(0.35), 0.0], [-np.sin(0.35), np.cos(0.35), 0.0], [0.0, 0.0, 1.0]]
)
PAYLOAD = ROLLED @ TURN


def correlated(sigmas: tuple[float, float, float]) -> list[Contributor]:
    lines = [tuple(float(value) for value in line) for line in CORRELATION]
    return [
        row("calibration", sigma, axis, axis_correlation=line)
        for sigma, axis, line in zip(sigmas, ("pitch", "yaw", "roll"), lines, strict=True)
    ]


@pytest.mark.parametrize(
    ("rotation", "axis"), [(None, "pitch"), (TURN, "cross-boresight"), (PAYLOAD, "pitch")]
)
def test_totals_of_correlated_axes_in_any_frame_against_monte_carlo(rotation, axis):
    rng = np.random.default_rng(6)
    rows = [
        *correlated((4.0, 5.0, 3.0)),
        row("shift", 2.0, "yaw", distribution="uniform", mean_arcsec=1.0),
    ]
    found = combined(rows, axis, 0.95, rotation=rotation)
    errors = rng.multivariate_normal(
        np.zeros(3), CORRELATION * np.outer([4.0, 5.0, 3.0], [4.0, 5.0, 3.0]), 400_000
    )
    errors[:, 1] += 1.0 + 2.0 * rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), len(errors))
    turned = errors @ (np.eye(3) if rotation is None else rotation).T
    size = np.abs(turned[:, 0]) if axis == "pitch" else np.hypot(turned[:, 0], turned[:, 1])
    assert found.sampled_arcsec == pytest.approx(np.quantile(size, 0.95), rel=0.01)
    # Control: axes taken as independent, as the totals were before.
    apart = combined(
        [dataclasses.replace(r, axis_correlation=()) for r in rows], axis, 0.95, rotation=rotation
    )
    if rotation is TURN:
        assert apart.sampled_arcsec < 0.97 * found.sampled_arcsec
        assert apart.rule_arcsec < 0.97 * found.rule_arcsec
    # Control: the axes of another frame.
    if rotation is PAYLOAD:
        assert abs(combined(rows, axis, 0.95).sampled_arcsec / found.sampled_arcsec - 1.0) > 0.05


def test_what_is_missing_on_an_axis_is_missing_wherever_it_is_seen() -> None:
    rows = [
        row("noise", 1.0),
        row("noise", 1.0, "yaw"),
        Contributor("pixel", "pixel spatial", "roll"),
    ]
    assert not combined(rows, "cross-boresight").at_least
    assert combined(rows, "pitch", rotation=TURN).not_assessed == ("pixel",)
    assert not combined(rows, "yaw", rotation=TURN).at_least


@pytest.mark.parametrize("coupled", [(0, 1), (1, 2), (0, 2), ()])
def test_sampled_totals_do_not_follow_the_rounding_of_a_correlation(coupled):
    # Eigenvectors of a matrix with an axis of its own change their signs with the last digit.
    exact = np.eye(3)
    if coupled:
        exact[coupled, coupled[::-1]] = 0.9
    rounding = 1e-13 * np.array([[0.0, 1.0, -1.0], [1.0, 0.0, 1.0], [-1.0, 1.0, 0.0]])

    def sampled(correlation: np.ndarray) -> np.ndarray:
        rows = [
            row("calibration", sigma, axis, axis_correlation=tuple(map(float, line)))
            for sigma, axis, line in zip(
                (4.0, 3.0, 6.0), ("pitch", "yaw", "roll"), correlation, strict=True
            )
        ]
        return np.array([one.sampled_arcsec for one in totals(rows, 0.95, n_samples=20_000)[0]])

    reference = sampled(exact)
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(sampled(exact + sign * rounding), reference, rtol=1e-9)
    # Control: what a correlation changes is seen.
    assert np.abs(sampled(exact + 1e11 * rounding) / reference - 1.0).max() > 1e-4


def test_the_heaviest_tail_weighs_its_size() -> None:
    large, long = row("large", 10.0, tail_997=3.2), row("long", 8.0, tail_997=4.5)
    assert _heaviest([large, long]) is long
    assert _heaviest([large, row("small", 0.1, tail_997=4.5)]) is large
    assert _heaviest([row("noise", 10.0, tail_997=GAUSSIAN_997)]) is None
