"""Rows that effects of the calibration fill, and what a file states in their place."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest

from starcal_uq.budgeting.posterior import effect_rows, posterior_rows, without_effects
from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import COMMON, NEA, OF_EFFECTS, REST
from starcal_uq.core.settings import WEIGHING, EffectName
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.onboard_error import PARAMETERS, EffectError, OnboardError
from tests.budgeting.test_budget import POST, attitude, made

HELD = SimpleNamespace(**{**vars(POST), "effects": SimpleNamespace(names=("field", "zenith"))})


def share(name: str, common: float, rest: float, mean: float = 0.0) -> EffectError:
    """A share whose axes are alike, arcsec; `mean` is that of the common rotation."""
    turns = np.eye(3)
    return EffectError.of(
        name,
        (np.full(3, mean), common**2 * turns),
        (np.zeros(3), rest**2 * turns),
        np.zeros(3),
    )


def with_shares(*effects: EffectError, onboard: str = "model") -> AttitudeError:
    """An attitude error whose common rotation and rest are those of shares, in squares."""
    parameters = share(PARAMETERS, 4.0, 0.006)
    parts = (parameters, *(each for each in effects if each.name != "star"))
    common, rest = (
        np.sqrt(sum(getattr(part, name) ** 2 for part in parts))
        for name in ("common_arcsec", "rest_arcsec")
    )
    own = OnboardError(onboard, common, rest, np.hypot(common, rest), effects, parameters)
    return attitude(common_arcsec=common, rest_arcsec=rest, onboard=onboard, variants=(own,))


def sizes(rows: Any) -> dict[tuple[str, str], tuple[float, float]]:
    return {(row.name, row.axis): (row.mean_arcsec, row.sigma_arcsec) for row in rows}


def rows_of(made: Budget, name: str) -> list[Any]:
    return [row for row in made.rows if row.name == name]


EFFECTS = (
    share("field", 0.3, 0.2, mean=-0.5),
    share("temperature", 0.0, 3.0),
    share("epoch", 1.0, 0.4),
    share("frame", 0.1, 0.8),
    share("star", 0.0, 0.3),
)


def test_rows_add_up_to_the_attitude_error_and_nothing_counts_twice() -> None:
    error = with_shares(*EFFECTS)
    rows = (*posterior_rows(error, HELD), *effect_rows(error, HELD))
    found = sizes(rows)
    for axis, nea, rest in zip(
        ("pitch", "yaw", "roll"), error.nea_arcsec, error.rest_arcsec, strict=True
    ):
        own = ["field error", "thermo-elastic of the optics", "night-to-night change"]
        whole = sum(found[name, axis][1] ** 2 for name in (REST, *own, "frame-to-frame error"))
        assert whole == pytest.approx(rest**2)
        noise = found[NEA, axis][1] ** 2 + found["star catalogue", axis][1] ** 2
        assert noise == pytest.approx(nea**2)
        assert found[COMMON, axis] == (0.0, pytest.approx(4.0))
        assert found["field error, common rotation", axis] == (-0.5, pytest.approx(0.3))
    # Control: with effects left in the calibration's rows they would count twice.
    assert (without_effects(error).rest_arcsec < 0.1 * error.rest_arcsec).all()
    named = {row.name: row for row in rows}
    assert named["field error, common rotation"].absorbed_by_alignment == "yes"
    # Another night than that of the alignment keeps its own rotation.
    night = named["night-to-night change, common rotation"]
    assert night.absorbed_by_alignment == "in part"
    assert named["thermo-elastic of the optics"].ecss_class == "thermo-elastic"
    # What frames draw anew is no common rotation; without a common part there is no such row.
    assert "frame-to-frame error, common rotation" not in named
    assert "thermo-elastic of the optics, common rotation" not in named
    assert not named["refraction"].applies


def test_totals_hold_the_effects_and_the_alignment_absorbs_what_is_in_common() -> None:
    error = with_shares(*EFFECTS[:2])
    budget = made(attitude=error)
    after, before = (
        budget.total("X", scope, "mixed") for scope in ("after alignment", "before alignment")
    )
    sigma = np.hypot(error.rest_arcsec[0], error.nea_arcsec[0])
    assert after.sigma_arcsec == pytest.approx(sigma, rel=1e-4)
    assert (after.mean_arcsec, before.mean_arcsec) == (0.0, pytest.approx(-0.5))


def test_a_statement_of_the_file_replaces_what_was_computed(tmp_path) -> None:
    path = tmp_path / "budget.toml"
    path.write_text(
        """
        [[contributor]]
        name = "Field error"
        axis = "X"
        sigma_arcsec = 0.05
        provenance = "lens test"

        [[contributor]]
        name = "drift of focal length and distortion"
        axis = "all"
        sigma_arcsec = 0.7
        provenance = "thermal analysis"
        """,
        encoding="utf-8",
    )
    budget = made(attitude=with_shares(*EFFECTS[:2]), file=path)
    pitch, yaw, roll = rows_of(budget, "field error")
    assert (pitch.sigma_arcsec, pitch.source) == (0.05, "file")
    assert (yaw.source, roll.source) == ("posterior", "posterior")
    # The statement is of the whole effect.
    common = rows_of(budget, "field error, common rotation")
    assert [row.applies for row in common] == [False, True, True]
    replaced = "'field error' is as the file states it; the calibration gives 0.2"
    assert any(note.startswith(replaced) for note in budget.notes)
    twice = "'drift of focal length and distortion' is stated in the file, and 'thermo-elastic"
    assert any(note.startswith(twice) for note in budget.notes)


def test_every_effect_that_shifts_stars_has_a_row_that_a_file_may_state() -> None:
    assert set(OF_EFFECTS) == set(get_args(EffectName)) - set(WEIGHING)
    assert len({entry.name for entry in OF_EFFECTS.values()}) == len(OF_EFFECTS)


def test_an_attitude_error_without_shares_is_taken_whole() -> None:
    error = with_shares(*EFFECTS)
    (own,) = error.variants
    old = dataclasses.replace(error, variants=(dataclasses.replace(own, parameters=None),))
    assert without_effects(old) is old
    assert effect_rows(old, HELD) == ()
