"""What is said of a sweep: medians of places, no change out of missing cells, hypercubes
in parts.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd

from starcal_uq.studies.findings import Sweep
from tests.helpers.studies import made_study

FIELDS, FRAMES = (5.0, 10.0, 20.0), (10, 100, 1000)


def test_medians_stand_at_their_places() -> None:
    study = made_study(
        {"fov_deg": FIELDS, "frames": FRAMES},
        lambda cell: {("f", "k1"): -0.9},
        seeds=4,
        jitter=0.05,
    )
    r = study.values("correlation", parameter="f", parameter_2="k1")
    table = pd.DataFrame({"fov_deg": study.data["fov_deg"], "frames": study.data["frames"], "r": r})
    by_place = table.groupby(["fov_deg", "frames"])["r"]
    expected = by_place.median().to_numpy().reshape(3, 3)
    np.testing.assert_allclose(study.sweep.over(r), expected, rtol=1e-12)
    lines = study.sweep.lines(r, "frames", "fov_deg")
    np.testing.assert_allclose(lines["median"], study.sweep.over(r))
    held = study.sweep.lines(r, "frames", at={"fov_deg": 20.0})
    np.testing.assert_allclose(held["median"], study.sweep.over(r)[2])


def test_missing_cells_do_not_pass_for_a_change() -> None:
    """Strong coupling in narrow fields only, and many frames only in wide ones: frames change
    nothing.
    """
    study = made_study(
        {"fov_deg": FIELDS, "frames": FRAMES},
        lambda cell: {("f", "k1"): -0.99 if cell["fov_deg"] < 20.0 else -0.5},
        failing=lambda cell: "lost" if cell["fov_deg"] < 20.0 and cell["frames"] == 1000 else "ok",
    )
    size = np.abs(study.values("correlation", parameter="f", parameter_2="k1"))
    curve = study.sweep.along(size, "frames")
    assert curve is not None and curve.change < 0.01
    # Medians over whatever there is would have said otherwise.
    assert np.ptp(study.sweep.over(size, dims=["frames"]).values) > 0.4
    (pair,) = study.sweep.coupled
    assert [cost.axis for cost in pair.decoupling()] == ["fov_deg"]


def test_chance_passes_for_a_change_once_in_a_thousand_times() -> None:
    """Numbers without any effect, 400 times for 2 and for 5 seeds; an effect of six standard
    deviations is seen.
    """
    rng = np.random.default_rng(7)
    step = np.repeat([0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0], 5)
    for seeds in (2, 5):
        sweep = made_study({"fov_deg": tuple(range(5, 13))}, lambda cell: {}, seeds=seeds).sweep
        curves = [sweep.along(rng.normal(size=8 * seeds), "fov_deg") for _ in range(400)]
        assert sum(curve is not None and curve.change > curve.chance for curve in curves) <= 3
    seen = sweep.along(rng.normal(size=40) + 6.0 * step, "fov_deg")
    assert seen is not None and seen.change > seen.chance


def test_a_hypercube_is_told_in_parts_that_are_judged_by_their_scatter() -> None:
    """An axis that acts is named; one that does not is not, although its parts differ by chance."""
    rng = np.random.default_rng(5)
    fields, noise = rng.uniform(5.0, 25.0, 120), rng.uniform(0.02, 0.2, 120)
    of_field = dict(
        zip(fields, np.linspace(0.99, 0.6, 120)[np.argsort(np.argsort(fields))], strict=True)
    )
    study = made_study(
        {"fov_deg": tuple(fields)},
        lambda cell: {("f", "k1"): -of_field[cell["fov_deg"]]},
        seeds=1,
        jitter=0.005,
    )
    data = study.data.assign_coords(sigma_px=("cell", noise))
    definition = dataclasses.replace(study.definition, sweep={}, latin={}, latin_n=0)
    assert definition.axes == {}
    sweep = Sweep(data, ("fov_deg", "sigma_px"), ("fov_deg", "sigma_px"))
    assert sweep.drawn == ("fov_deg", "sigma_px") and sweep.over(noise).shape == (6, 6)
    (pair,) = sweep.coupled
    assert {cost.axis: cost.matters for cost in pair.costs} == {"fov_deg": True, "sigma_px": False}
