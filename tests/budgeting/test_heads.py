"""The budget of two heads against errors that are drawn and weighed here, with NumPy alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import NEA, Contributor
from starcal_uq.budgeting.totals import totals
from starcal_uq.core.constants import AXES
from starcal_uq.core.errors import BudgetError, HeadError
from starcal_uq.core.provenance import Provenance

N = 400_000
RNG = np.random.default_rng(3)
# Boresights along Z and along X of the body.
TURNS = np.array([np.eye(3), [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]])
# Noise about pitch, yaw and roll, arcsec; in the first head roll leans on pitch.
NOISE = np.array([[1.0, 1.2, 8.0], [2.0, 2.0, 12.0]])
LEAN = np.array([[1.0, 0.0, 0.4], [0.0, 1.0, 0.0], [0.4, 0.0, 1.0]])
SHIFT, THERMAL, BRACKET = 5.0, np.array([2.0, 1.0]), np.array([0.8, 0.8, 1.5])
MEAN = 0.7
FILE = """
[[head]]
name = "A"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
run = "a"

[[head]]
name = "B"
rotation = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
run = "b"

[[contributor]]
name = "bracket"
ecss_class = "thermo-elastic"
axis = "cross-boresight"
sigma_arcsec = 0.8
interpretation = "temporal"
absorbed_by_alignment = "no"
provenance = "structure"

[[contributor]]
name = "bracket"
axis = "Z"
sigma_arcsec = 1.5
ecss_class = "thermo-elastic"
interpretation = "temporal"
absorbed_by_alignment = "no"
provenance = "structure"
"""


def rows(head: int) -> tuple[Contributor, ...]:
    """Noise, a uniform launch shift, and a thermal oscillation that moves X and Y together."""
    made = []
    for i, axis in enumerate(AXES):
        noise = Contributor(
            NEA, "temporal noise (NEA)", axis, 0.0, NOISE[head, i], interpretation="temporal",
            axis_correlation=tuple(LEAN[i]) if head == 0 else (), source="posterior",
            behaviour="white, 0.2 s",
        )  # fmt: skip
        shift = Contributor(
            "launch and settling shift", "bias", axis, MEAN, SHIFT, distribution="uniform",
            source="file", absorbed_by_alignment="yes",
        )  # fmt: skip
        made += [noise, shift]
    for size, axis in zip(THERMAL, AXES, strict=False):
        made.append(Contributor(
            "thermo-elastic distortion", "thermo-elastic", axis, 0.0, size, source="file",
            distribution="arcsine", interpretation="temporal", correlation_group="thermal",
            behaviour="periodic, 5880 s",
        ))  # fmt: skip
    made.append(Contributor("thermo-elastic distortion", "thermo-elastic", "roll"))
    return tuple(made)


def budget(head: int) -> Budget:
    found, _ = totals(rows(head), 0.997, n_samples=10_000)
    return Budget(rows(head), found, (), 0.997, "head", (), Provenance())


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("heads") / "heads.toml"
    path.write_text(FILE)
    return path


def simulated(weights: np.ndarray, bracket_apart: bool = False) -> dict[str, np.ndarray]:
    """Errors (3, N) of the body: before and after alignment."""
    errors = np.zeros((2, 3, N))
    for head, (turn, weight) in enumerate(zip(TURNS, weights, strict=True)):
        root = np.linalg.cholesky(LEAN if head == 0 else np.eye(3))
        own = NOISE[head][:, None] * (root @ RNG.standard_normal((3, N)))
        swing = np.sin(2.0 * np.pi * RNG.random(N))
        own[:2] += np.sqrt(2.0) * THERMAL[:, None] * swing
        shift = MEAN + SHIFT * np.sqrt(3.0) * RNG.uniform(-1.0, 1.0, (3, N))
        errors[0] += weight @ turn @ (own + shift)
        errors[1] += weight @ turn @ own
        if bracket_apart:
            errors += weight @ (BRACKET[:, None] * RNG.standard_normal((3, N)))
    if not bracket_apart:
        errors += BRACKET[:, None] * RNG.standard_normal((3, N))
    return dict(zip(("before alignment", "after alignment"), errors, strict=True))


def weights_of(noise: np.ndarray, lean: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    information = np.stack([
        turn @ np.linalg.inv(np.diag(s) @ own @ np.diag(s)) @ turn.T
        for turn, s, own in zip(TURNS, noise, lean, strict=True)
    ])  # fmt: skip
    return np.asarray(np.linalg.inv(information.sum(axis=0)) @ information)


BEST = weights_of(NOISE, (LEAN, np.eye(3)))


def departures(found: Budget, errors: dict[str, np.ndarray]) -> np.ndarray:
    """Sampled and stated sigma and bound over those simulated, less one."""
    ratios = []
    for scope, error in errors.items():
        for i, axis in enumerate(AXES):
            total = found.total(axis, scope)
            ratios.append(total.sigma_arcsec / error[i].std())
            ratios.append(total.sampled_arcsec / np.quantile(np.abs(error[i]), 0.997))
    return np.array(ratios) - 1.0


def test_budget_of_heads_is_that_of_drawn_errors(heads):
    found = sc.budgeting.array_budget(heads, [budget(0), budget(1)])
    assert np.abs(departures(found, simulated(BEST))).max() < 0.02
    for i, axis in enumerate(AXES):
        expected = MEAN * (BEST @ TURNS @ np.ones(3)).sum(axis=0)[i]
        assert found.total(axis, "before alignment").mean_arcsec == pytest.approx(expected)
    names = {row.name for row in found.rows}
    assert {f"A: {NEA}", f"B: {NEA}", "bracket", "B: launch and settling shift about X"} <= names
    # Nobody assessed the roll of the thermal distortion: it stays so where the body sees it.
    missing = {(row.name, row.axis) for row in found.rows if not row.assessed}
    assert ("A: thermo-elastic distortion about Z", "roll") in missing
    assert found.total("roll").at_least
    assert not any("weighed" in note for note in found.notes)


def test_what_nobody_assessed_is_said_once(heads):
    """A row that one head lacks is missing for that head, one that all lack for all of them."""
    silent = [Contributor("star catalogue", "FOV spatial", axis) for axis in AXES]
    stated = [
        dataclasses.replace(row, sigma_arcsec=1.0, mean_arcsec=0.0, source="file") for row in silent
    ]
    other = [Contributor("aberration residual", "aberration", axis) for axis in AXES]
    found = sc.budgeting.array_budget(heads, [
        dataclasses.replace(budget(0), rows=(*rows(0), *stated, *other)),
        dataclasses.replace(budget(1), rows=(*rows(1), *silent, *other)),
    ])  # fmt: skip
    names = [row.name for row in found.rows if not row.assessed]
    assert names.count("B: star catalogue") == names.count("aberration residual") == 3
    assert "A: star catalogue" not in names and "B: aberration residual" not in names
    # Its part of the first head counts: a head's weight is below one.
    assert 0.0 < {row.name: row.sigma_arcsec for row in found.rows}["A: star catalogue"] < 1.0


def test_a_common_row_is_not_averaged(heads):
    """The control: a bracket under each head by itself would be smaller."""
    found = sc.budgeting.array_budget(heads, [budget(0), budget(1)])
    assert np.abs(departures(found, simulated(BEST, bracket_apart=True))).max() > 0.04


def noise_alone():
    """Budgets of both heads with their centroid noise and nothing else."""
    kept = [tuple(row for row in rows(head) if row.name == NEA) for head in (0, 1)]
    return [Budget(own, (), (), 0.997, "", (), Provenance()) for own in kept]


def test_gaussian_rows_keep_their_correlation(heads, tmp_path: Path):
    """The covariance of the noise of both heads, seen from another frame."""
    path = tmp_path / "heads.toml"
    frame = '[frame.skew]\nrotation = [0.2, -0.3, 0.5, 0.7]\n\n[[requirement]]\nname = "R"\n'
    frame += 'axis = "X"\nlimit_arcsec = 9.0\nframe = "skew"\n'
    path.write_text(FILE.split("[[contributor]]")[0] + frame)
    found = sc.budgeting.array_budget(path, noise_alone())
    covariance = np.linalg.inv(sum(
        turn @ np.linalg.inv(np.diag(s) @ own @ np.diag(s)) @ turn.T
        for turn, s, own in zip(TURNS, NOISE, (LEAN, np.eye(3)), strict=True)
    ))  # fmt: skip
    x, y, z, w = np.array([0.2, -0.3, 0.5, 0.7]) / np.linalg.norm([0.2, -0.3, 0.5, 0.7])
    first = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    expected = np.sqrt(np.array(first) @ covariance @ first)
    assert found.outcomes[0].total.sigma_arcsec == pytest.approx(expected, rel=1e-9)
    for axis, sigma in zip(AXES, np.sqrt(np.diag(covariance)), strict=True):
        assert found.total(axis).sigma_arcsec == pytest.approx(sigma, rel=1e-9)


def test_other_weights_are_budgeted_and_named(heads, tmp_path: Path):
    """Software that takes the second head for the better one."""
    path = tmp_path / "heads.toml"
    aboard = np.array([[4.0, 4.0, 24.0], [1.0, 1.0, 6.0]])
    stated = FILE
    for text, sigma in zip(('run = "a"', 'run = "b"'), aboard, strict=True):
        stated = stated.replace(text, f"{text}\nweighed_arcsec = {sigma.tolist()}")
    path.write_text(stated)
    found = sc.budgeting.array_budget(path, [budget(0), budget(1)])
    errors = simulated(weights_of(aboard, (np.eye(3), np.eye(3))))
    assert np.abs(departures(found, errors)).max() < 0.02
    assert any("Heads are not weighed by their noise" in note for note in found.notes)
    assert np.abs(departures(found, simulated(BEST))).max() > 0.1


def test_indices_follow_what_heads_state_in_time(heads, tmp_path: Path):
    path = tmp_path / "heads.toml"
    index = '[[index]]\nkind = "MKE"\nwindow_seconds = 20.0\n'
    path.write_text(FILE.split("[[contributor]]")[0] + index)
    found = sc.budgeting.array_budget(path, noise_alone())
    one, mean = found.total("X"), found.total("X", index="MKE 20 s")
    assert mean.sigma_arcsec == pytest.approx(one.sigma_arcsec / 10.0)
    assert not mean.at_most


def test_saved_budgets_are_taken_from_run_folders(heads):
    for head, folder in enumerate("ab"):
        (heads.parent / folder).mkdir(exist_ok=True)
        budget(head).save(heads.parent / folder / "budget.csv")
    found = sc.budgeting.array_budget(heads)
    direct = sc.budgeting.array_budget(heads, [budget(0), budget(1)])
    assert found.total("roll") == direct.total("roll")
    out = heads.parent / "out.csv"
    found.save(out)
    pd.testing.assert_frame_equal(Budget.load(out).to_dataframe(), found.to_dataframe())


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (('run = "a"', ""), BudgetError, "head 'A': names no run"),
        (("[[contributor]]", "[[contributors]]"), BudgetError, "contributors is not known"),
        (('run = "b"', "weighed_arcsec = [1.0]"), HeadError, "write three positive numbers"),
        (('run = "b"', "weighed_arcsec = [1, 0, 1]"), HeadError, "write three positive numbers"),
    ],
)
def test_wrong_files_are_one_sentence(tmp_path: Path, change, error, words):
    path = tmp_path / "heads.toml"
    path.write_text(FILE.replace(*change))
    with pytest.raises(error, match=words):
        sc.budgeting.array_budget(path)


def test_budgets_that_cannot_be_fused_are_refused(heads):
    with pytest.raises(BudgetError, match="1 budgets for 2 heads"):
        sc.budgeting.array_budget(heads, [budget(0)])
    empty = Budget((), (), (), 0.997, "", (), Provenance())
    with pytest.raises(BudgetError, match="head 'A' holds no"):
        sc.budgeting.array_budget(heads, [empty, budget(1)])
