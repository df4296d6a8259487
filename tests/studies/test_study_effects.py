"""Studies of effects: what they cost, and which range of temperatures tells df/dT."""

from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import StudyError
from starcal_uq.planning.effects import PlannedEffects
from starcal_uq.planning.plan import plan
from starcal_uq.presentation.words.studies import study_tables
from starcal_uq.studies.definition import StudyDefinition
from starcal_uq.studies.result import Study
from tests.helpers.scenes import camera

SLOPE = ("df/dT [px/K]", "range of temperatures [K]")
HELD = ("none", "temperature=0.2", "frame=0.1,temperature=0.2")
OBSERVATION = {"max_mag": 6.0, "min_stars": 10, "sigma_px": 0.05}


def tables(**changed: object) -> dict[str, object]:
    sweep = {"effects": list(HELD), "temperature_range_c": [10.0, 40.0], "frames": [100, 400]}
    made = {"camera": camera().to_dict(), "observation": OBSERVATION, "sweep": sweep}
    return made | changed


@pytest.fixture(scope="module")
def study() -> Study:
    return sc.study(StudyDefinition.from_dict(tables()), workers=0)


def cells(study: Study, **where: object) -> np.ndarray:
    return np.all([study.data[name].values == value for name, value in where.items()], axis=0)


def test_a_cell_agrees_with_a_plan(study: Study) -> None:
    found = plan(
        camera(),
        sc.load_catalogue(max_mag=6.0),
        effects=PlannedEffects.parsed(HELD[2], 40.0),
        n_frames=(400,),
        n_geometries=300,
        sweeps=False,
    )
    row = found.forecast.to_dataframe().iloc[0]
    at = cells(study, effects=HELD[2], temperature_range_c=40.0, frames=400)
    assert study.values("sigma", parameter="f")[at] == pytest.approx(row["f_px"], rel=0.06)
    assert study.values("slope_f")[at] == pytest.approx(row["f_px_per_K"], rel=0.06)
    rest = study.values("frame_error_arcsec", axis="roll")[at]
    assert rest == pytest.approx(row["rest_roll_arcsec"], rel=0.1)
    # Control: without effects far more seems to be known.
    plain = cells(study, effects="none", temperature_range_c=40.0, frames=400)
    assert study.values("sigma", parameter="f")[plain] < 0.85 * row["f_px"]
    assert np.isnan(study.values("slope_f")[plain]).all()


def test_slopes_follow_the_range_and_the_frames(study: Study) -> None:
    slope = study.values("slope_f")
    at = {"effects": HELD[1]}
    narrow, wide = (slope[cells(study, temperature_range_c=k, **at)] for k in (10.0, 40.0))
    np.testing.assert_allclose(narrow / wide, 4.0, rtol=1e-6)
    few, many = (slope[cells(study, frames=n, **at)] for n in (100, 400))
    np.testing.assert_allclose(few / many, 2.0, rtol=0.1)


def test_the_question_is_answered(study: Study) -> None:
    """The tables say what effects cost, and which range of temperatures tells df/dT."""
    _, changes, medians = study_tables(study)
    rows = [dict(zip(medians.heads, row, strict=True)) for row in medians.rows[: len(HELD)]]
    assert [row["Value"] for row in rows] == list(HELD)
    assert [row["df/dT [px/K]"] == "–" for row in rows] == [True, False, False]
    assert float(rows[2]["Sigma f [px]"]) > 1.15 * float(rows[0]["Sigma f [px]"])
    (slope,) = (row for row in changes.rows if row[:2] == SLOPE)
    assert slope[3::2] == ("10", "40", "−1.00") and slope[6] == "4.0"
    # Control: a study that varies no effects says nothing of them.
    plain = tables(sweep={"frames": [100, 400]})
    other = sc.study(StudyDefinition.from_dict(plain), workers=0)
    for table in study_tables(other):
        assert "df/dT" not in " ".join((*table.heads, *(row[0] for row in table.rows)))


@pytest.mark.parametrize(
    ("sweep", "study", "words"),
    [
        ({"effects": ["none", "star"]}, {}, "the effect 'star' cannot be planned"),
        ({"effects": ["none", "field=x"]}, {}, "'field=x' is no effect with its scale"),
        ({"temperature_range_c": [0.0, 5.0]}, {}, "temperature_range_c is 0"),
        (
            {"effects": ["none", "field"]},
            {"mode": "simulate"},
            "effects is studied by Fisher information; set mode to 'fisher'",
        ),
    ],
)
def test_what_cannot_be_studied_is_one_sentence(sweep, study, words) -> None:
    with pytest.raises(StudyError, match=words):
        StudyDefinition.from_dict(tables(sweep=sweep, study=study))


def test_errors_of_stars_are_not_studied_beside_effects() -> None:
    own = OBSERVATION | {"direction_mas": 5.0}
    sweep = {"effects": ["none", "frame=0.1"], "frames": [50]}
    found = sc.study(StudyDefinition.from_dict(tables(observation=own, sweep=sweep)), workers=0)
    assert found.ok.tolist() == [True, False]
    assert "are not studied together" in next(iter(found.problems))


def test_an_epoch_needs_nights(tmp_path: Path) -> None:
    sweep = {"effects": ["epoch=0.1"], "nights": [1, 3]}
    found = sc.study(StudyDefinition.from_dict(tables(sweep=sweep)), workers=0)
    assert found.ok.tolist() == [False, True]
