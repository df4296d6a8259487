"""The interaction study: who is biased by the distortion, where that outweighs noise, and that
nobody else is.
"""

import dataclasses

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import SamplingError, SettingError
from starcal_uq.paper.interaction import (
    HANDLING,
    OPTICS,
    Condition,
    InteractionStudy,
    crossing,
    deep_catalogue,
    estimates,
    interaction_study,
    solid_angle_sr,
    study_points,
)
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.simulation.frames import Campaign
from tests.helpers.scenes import camera, observations

SMALL = {
    "distortion_scales": (0.0, 0.5, 1.0),
    "fields_deg": (8.0, 10.0),
    "frames": (12, 24),
    "max_mags": (5.5, 6.0),
    "n_replicates": 2,
    "n_frames": 12,
    "seed": 3,
}
BIASED = ("least squares", "samaan")
COUPLED = ("three stages", "efficient")


@pytest.fixture(scope="module")
def study():
    return interaction_study(workers=0, **SMALL)


def value(study, axis, at, method, parameter, column):
    rows = study.points(axis, method, parameter)
    return float(rows[column][rows["value"] == at].iloc[0])


def test_crossing():
    at = np.array([1.0, 10.0, 100.0])
    assert crossing(at, np.array([0.1, 1.0, 10.0])) == ("above", pytest.approx(10.0))
    assert crossing(at, np.array([0.01, 0.1, 10.0])) == ("above", pytest.approx(np.sqrt(1000.0)))
    assert crossing(at, np.array([10.0, 0.1, 0.01])) == ("below", pytest.approx(np.sqrt(10.0)))
    assert crossing(at, np.array([2.0, 0.5, 2.0]))[0] == "above"
    for ratio, side in ((2.0, "always"), (0.5, "never")):
        found = crossing(at, np.full(3, ratio))
        assert found[0] == side and np.isnan(found[1])
    # From zero, where there is no logarithm.
    assert crossing(np.array([0.0, 4.0]), np.array([0.0, 2.0])) == ("above", pytest.approx(2.0))


def points(**changes):
    truth, start = sc.paper.paper_camera(), sc.paper.paper_start()
    fields = (5.0, 10.0, 40.0)
    sky = deep_catalogue(truth, 7.0, 6.0, fields)
    base = Condition(truth, start, Campaign(100, 10, 0.05, 6.0))
    return sky, base, study_points(base, sky, (0.0, 1.0, 60.0), fields, (10, 100), (5.0, 6.0, 7.0))


def test_the_axes_cross_in_the_paper():
    _, base, found = points()
    crossings = [(p.axis, p.value) for p in found if p.condition == base]
    assert crossings == [("distortion", 1.0), ("field", 10.0), ("frames", 100.0), ("stars", 6.0)]


def test_each_axis_varies_what_it_says_and_nothing_else():
    sky, base, found = points()
    for point in found:
        c = point.condition
        if point.axis != "distortion":
            assert c.corner_px == pytest.approx(base.corner_px, rel=1e-12)
        if point.axis != "frames":
            assert c.campaign.n_frames == 100
        if point.axis == "field":
            assert c.field_deg == pytest.approx(point.value)
            assert (c.truth.width_px, c.truth.pixel_um) == (1024, 12.0)
            # As many stars on average.
            density = np.sum(sky.mag <= c.campaign.max_mag) * solid_angle_sr(c.truth)
            assert density == pytest.approx(
                np.sum(sky.mag <= 6.0) * solid_angle_sr(base.truth), rel=2e-3
            )
            assert c.start.focal_mm / c.truth.focal_mm == pytest.approx(72.0 / 70.2262)
        else:
            assert c.truth.focal_mm == 70.2262
    corner = {p.value: p.condition.corner_px for p in found if p.axis == "distortion"}
    assert corner[0.0] == 0.0
    # k1 r^3 + k2 r^5 at the farthest corner.
    r = np.hypot(523.5, 530.5)
    assert corner[1.0] == pytest.approx(2e-10 * r**3 - 3.5e-15 * r**5)
    assert corner[60.0] == pytest.approx(60.0 * corner[1.0])
    least = [p.condition.campaign.min_stars for p in found if p.axis == "stars"]
    assert least == sorted(least) and least[1] == 10


def test_a_field_beyond_the_catalogue_says_so(monkeypatch):
    shallow = sc.load_catalogue(max_mag=6.0)
    monkeypatch.setattr("starcal_uq.paper.interaction.load_catalogue", lambda max_mag: shallow)
    with pytest.raises(SamplingError, match="too few for a field of 5 deg"):
        deep_catalogue(sc.paper.paper_camera(), 6.0, 6.0, (5.0,))


def test_shared_stages_are_the_methods():
    """One calibration stands for three methods: each of them, called by its name, gives the
    same.
    """
    obs = observations(n_frames=40)
    found = dict(zip(HANDLING, estimates(obs, sc.paper.paper_start(), 0.05), strict=True))
    options = {"samaan": RecursionOptions(sigma_px=0.05)}
    names = {"least squares": "least_squares", "samaan": "samaan", "three stages": "three_stage"}
    for label, name in (names | {"efficient": "efficient"}).items():
        cal = sc.calibrate(obs, sc.paper.paper_start(), method=name, recursion=options.get(name))
        np.testing.assert_allclose(found[label], cal.theta[:3], rtol=0.0, atol=1e-9)


def test_zero_distortion_gives_no_bias_and_distortion_does(study):
    rows = study.points("distortion", "efficient", "f")
    assert rows["corner_size_px"].iloc[0] == 0.0
    for method in HANDLING:
        for parameter in OPTICS:
            assert abs(value(study, "distortion", 0.0, method, parameter, "bias")) < 1e-4
            biased = abs(value(study, "distortion", 1.0, method, parameter, "bias")) > 0.1
            assert biased == (method in BIASED)
    for method in BIASED:
        # The paper's least squares: 70.211 mm against 70.2262.
        assert value(study, "distortion", 1.0, method, "f", "bias") == pytest.approx(-1.27, abs=0.2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start": camera("none")}, "give both the same model"),
        ({"truth": camera("none"), "start": camera("none")}, "with coefficients"),
    ],
)
def test_bad_settings_are_one_sentence(options, words):
    with pytest.raises((SamplingError, SettingError), match=words):
        interaction_study(**options)


def test_text_and_html(study):
    assert (
        "least squares, which ignores the distortion; samaan, which decouples the distortion"
        in study.text
    )
    assert "nowhere for three stages and efficient" in study.text
    html = study._repr_html_()
    assert html.count("<tr") == 1 + 4 * 3
    assert "everywhere" in html and "nowhere" in html
    assert len(study.thresholds) == 4 * 3 * (4 + 3)
    with pytest.raises(ValueError):
        study.threshold("distortion", "efficient", "f", "rmse")


def test_save_and_load_lose_nothing(study, tmp_path):
    path = tmp_path / "interaction.csv"
    study.save_csv(path)
    again = InteractionStudy.load_csv(path)
    assert again.table.equals(study.table)
    assert again.text == dataclasses.replace(study, provenance={}).text
    study.save_csv(path)
    assert [p.name for p in tmp_path.iterdir()] == ["interaction.csv"]


@pytest.fixture(scope="module")
def whole():
    """Fewer points and frames than by default, and more replicates."""
    return interaction_study(
        distortion_scales=(0.0, 0.01, 0.1, 1.0, 4.0),
        fields_deg=(5.0, 10.0, 40.0),
        frames=(10, 50, 300),
        max_mags=(5.0, 6.0, 7.0),
        n_replicates=12,
        n_frames=50,
        workers=0,
    )


@pytest.mark.slow
def test_ignoring_and_decoupling_cost_more_than_noise(whole):
    print(whole.text)
    for method in BIASED:
        t = whole.threshold("distortion", method, "f")
        # A hundredth of a pixel at the corner, for fifty frames.
        assert t.side == "above" and 0.005 < t.value < 0.05
        assert t.low < t.value < t.high
        for axis in ("field", "frames", "stars"):
            assert whole.threshold(axis, method, "f").side == "always"
        rows = whole.points("distortion", method, "f")
        rows = rows[rows["value"] > 0.0]
        slope = np.polyfit(np.log(rows["value"]), np.log(rows["bias"].abs()), 1)[0]
        assert slope == pytest.approx(1.0, abs=0.03)
        # The bias does not go away with more frames or stars.
        for axis in ("frames", "stars"):
            bias = whole.points(axis, method, "f")["bias"].to_numpy()
            np.testing.assert_allclose(bias, bias.mean(), rtol=0.15)


@pytest.mark.slow
def test_coupling_has_no_bias_anywhere(whole):
    rows = whole.table[whole.table["method"].isin(COUPLED)]
    assert rows["bias_over_noise"].max() < 1e-3
    assert {t.side for t in whole.thresholds if t.kind == "bias" and t.method in COUPLED} == {
        "never"
    }
    # Nor does noise make one, within what the replicates know.
    z = (rows["noise_shift"] / rows["noise_shift_se"]).abs()
    assert z.max() < 5.0
    assert z.median() < 1.2


@pytest.mark.slow
def test_spread_falls_with_frames_and_meets_the_bound(whole):
    for parameter in OPTICS:
        rows = whole.points("frames", "efficient", parameter)
        slope = np.polyfit(np.log(rows["n_frames"]), np.log(rows["spread"]), 1)[0]
        # The spread of 12 estimates is known to 21 %, its slope over a factor of 30 to 0.08.
        assert slope == pytest.approx(-0.5, abs=0.2)
    ratio = {}
    for method in COUPLED:
        rows = whole.table[
            (whole.table["method"] == method) & (whole.table["axis"] != "distortion")
        ]
        ratio[method] = float(np.sqrt(np.mean((rows["spread"] / rows["crlb"]) ** 2)))
    assert ratio["efficient"] == pytest.approx(1.0, abs=0.15)
    assert ratio["three stages"] > 1.05 * ratio["efficient"]


@pytest.mark.slow
def test_coupling_costs_where_there_is_no_distortion(whole):
    """Three times in the focal length, nothing in the principal point; it pays from hundredths of a
    pixel on.
    """
    price = {}
    for parameter in OPTICS:
        one, two = (
            value(whole, "distortion", 0.0, m, parameter, "crlb")
            for m in ("efficient", "least squares")
        )
        assert one == two
        spreads = [
            value(whole, "distortion", 0.0, m, parameter, "spread")
            for m in ("efficient", "least squares")
        ]
        price[parameter] = spreads[0] / spreads[1]
    assert price["f"] > 1.5
    assert price["x0"] < 1.5 and price["y0"] < 1.5
    assert whole.threshold("distortion", "least squares", "f", "rmse").value < 0.2
