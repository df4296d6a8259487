"""Every number of a propagated attitude error a second time: attitudes by singular values,
responses by differences.
"""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from starcal_uq.core.constants import AXES, TOTAL_AXES
from starcal_uq.core.records import to_plain
from starcal_uq.observations.splits import frame_sample
from starcal_uq.observations.table import Observations
from starcal_uq.propagation import propagate as propagating
from starcal_uq.propagation import sampled as through
from starcal_uq.propagation.attitude_error import (
    CONTRIBUTORS,
    AttitudeError,
)
from starcal_uq.propagation.coupling import coupling
from starcal_uq.propagation.distortion import distortion_curve
from starcal_uq.propagation.field import field_map
from starcal_uq.propagation.onboard_error import EffectError, OnboardError
from starcal_uq.propagation.propagate import propagate
from tests.propagation.test_alignment import ARCSEC, POST, THETA, directions, skies, table

SEED, SAMPLES = 5, 4000


def attitudes(
    theta: np.ndarray, pixels: np.ndarray, obs: Observations, weights: np.ndarray
) -> Rotation:
    """The best attitudes of all frames."""
    products = (weights[:, None] * directions(theta, pixels))[:, :, None] * obs.directions_icrs[
        :, None
    ]
    u, _, vt = np.linalg.svd(np.add.reduceat(products, obs.frame_starts[:-1], axis=0))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return Rotation.from_matrix(u @ vt)


class Second:
    """What frames say of a camera: their rotations and their first-order responses, by central
    differences.
    """

    def __init__(self, post: Any, obs: Observations) -> None:
        self.post, self.obs = post, obs
        sigma = np.mean(post.sigma_draws) * (
            np.ones(len(obs)) if obs.sigma_px is None else obs.sigma_px
        )
        self.noise = np.sqrt(sigma**2 + post.star_error_px**2)
        self.weights = np.ones(len(obs)) if obs.sigma_px is None else obs.sigma_px**-2.0
        self.reference = attitudes(post.mean, obs.xy, obs, self.weights)
        steps = 1e-3 * np.sqrt(np.diag(post.covariance))
        columns = [
            (self.phi(post.mean + e) - self.phi(post.mean - e)) / (2.0 * step)
            for step, e in zip(steps, np.diag(steps), strict=True)
        ]
        self.response = np.stack(columns, axis=-1)
        frame = np.repeat(np.arange(obs.n_frames), np.diff(obs.frame_starts))
        self.by_star = np.zeros((2, len(obs), 3))
        # Stars of one place in their frames are moved together.
        place = np.arange(len(obs)) - obs.frame_starts[frame]
        for axis in range(2):
            for each in range(place.max() + 1):
                moved = np.where((place == each)[:, None], 1e-3 * np.eye(2)[axis], 0.0)
                slope = (
                    self.phi(post.mean, obs.xy + moved) - self.phi(post.mean, obs.xy - moved)
                ) / 2e-3
                chosen = place == each
                self.by_star[axis, chosen] = slope[frame[chosen]] * self.noise[chosen, None]
        self.covariance = np.zeros((obs.n_frames, 3, 3))
        np.add.at(self.covariance, frame, np.einsum("ani,anj->nij", self.by_star, self.by_star))
        information = np.linalg.inv(self.covariance)
        self.aligned = np.linalg.inv(information.sum(axis=0))
        self.shares = self.aligned @ information

    def phi(self, theta: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:
        """Left rotation vectors (K, 3) from the attitudes at the mean, rad."""
        turned = attitudes(theta, self.obs.xy if pixels is None else pixels, self.obs, self.weights)
        return (turned * self.reference.inv()).as_rotvec()


def widths(errors: np.ndarray) -> np.ndarray:
    e = np.abs(errors.reshape(-1, 3))
    return ARCSEC * np.quantile(
        np.column_stack((e, np.linalg.norm(e[:, :2], axis=1))), [0.95, 0.997], axis=0
    )


def second(
    post: Any, obs: Observations, align: Observations, n_draws: int, limit: int
) -> dict[str, Any]:
    """Fields of an `AttitudeError` as its module describes them."""
    draws = post.thin(n_draws, SEED)[:, :-1]
    shift = draws - post.mean
    every, other = Second(post, obs), Second(post, align)
    some, places = frame_sample(obs, limit, SEED)
    few, few_other = Second(post, some), Second(post, frame_sample(align, limit, SEED)[0])
    K, own = post.covariance, np.cov(draws, rowvar=False)
    together = np.einsum("kij,kjp->ip", other.shares, other.response)
    sampled_together = np.einsum("kij,kjp->ip", few_other.shares, few_other.response)
    apart, few_apart = every.response - together, few.response - sampled_together

    def first(response: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        return np.einsum("...ip,pq,...iq->...i", response, covariance, response)

    phi = np.array([few.phi(theta) for theta in draws])
    common = np.array(
        [np.einsum("kij,kj->i", few_other.shares, few_other.phi(theta)) for theta in draws]
    )
    rest = phi - common[:, None]

    def beyond(values: np.ndarray, response: np.ndarray) -> np.ndarray:
        return values.var(axis=0, ddof=1) - first(response, own)

    def over(values: np.ndarray) -> np.ndarray:
        found = np.repeat(values.mean(axis=0)[None], obs.n_frames, axis=0)
        found[places] = values
        return found

    sigma_common = np.sqrt(first(together, K) + beyond(common, sampled_together))
    rest_variance = first(apart, K) + over(beyond(rest, few_apart))
    total = np.sqrt(np.mean(first(every.response, K) + over(beyond(phi, few.response)), axis=0))
    steady = np.sqrt(
        first(apart.mean(axis=0), K) + beyond(rest.mean(axis=1), few_apart.mean(axis=0))
    )
    sigma_rest = np.sqrt(rest_variance.mean(axis=0))
    # Forty draws with noise, which does something of its own, and something together with the
    # camera.
    n = min(40, len(draws))
    e = np.random.default_rng(SEED).standard_normal((n, len(some), 2))
    noisy = [some.xy + few.noise[:, None] * own_noise for own_noise in e]
    alone = np.array([few.phi(post.mean, xy) for xy in noisy])
    both = np.array([few.phi(theta, xy) for theta, xy in zip(draws, noisy, strict=False)])
    met = both - phi[:n] - alone
    linear = np.add.reduceat(
        np.einsum("dna,ani->dni", e, few.by_star), some.frame_starts[:-1], axis=1
    )
    excess = np.mean(alone**2 - linear**2, axis=(0, 1))
    variances = np.diagonal(every.covariance, axis1=1, axis2=2)
    nea = np.sqrt(variances.mean(axis=0) + excess)
    root = np.linalg.cholesky(every.covariance)
    white = np.random.default_rng(SEED).standard_normal(
        (SAMPLES // obs.n_frames, obs.n_frames, 3, 1)
    )
    rng = np.random.default_rng(SEED)
    drawn, framed = (
        rng.integers(len(post.theta_draws), size=SAMPLES),
        rng.integers(obs.n_frames, size=SAMPLES),
    )
    deviations = post.theta_draws - post.mean
    commons, rests = (
        deviations @ together.T,
        np.einsum("np,nip->ni", deviations[drawn], apart[framed]),
    )
    commons *= sigma_common / np.sqrt(np.mean(commons**2, axis=0))
    rests *= sigma_rest / np.sqrt(np.mean(rests**2, axis=0))
    parts = (root @ white, commons, rests, rests + commons[drawn], met)
    half = np.stack([widths(part) for part in parts], axis=1)

    def covariance(matrices: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        mean = matrices.mean(axis=0)
        size = np.sqrt(np.diag(mean))
        return mean / np.outer(size, size) * np.outer(sigma, sigma) * ARCSEC**2

    def spread(response: np.ndarray) -> np.ndarray:
        return response @ K @ np.swapaxes(response, -1, -2)

    return {
        "nea_arcsec": nea * ARCSEC,
        "common_arcsec": sigma_common * ARCSEC,
        "rest_arcsec": sigma_rest * ARCSEC,
        "p95_arcsec": half[0],
        "p997_arcsec": half[1],
        "analytic_nea_arcsec": np.sqrt(variances.mean(axis=0)) * ARCSEC,
        "analytic_common_arcsec": np.sqrt(first(together, K)) * ARCSEC,
        "analytic_rest_arcsec": np.sqrt(first(apart, K).mean(axis=0)) * ARCSEC,
        "n_draws": len(draws),
        "n_frames": obs.n_frames,
        "common_draws_arcsec": (common + shift @ (together - sampled_together).T) * ARCSEC,
        "rest_rms_per_frame_arcsec": np.sqrt(rest_variance) * ARCSEC,
        "nea_per_frame_arcsec": np.sqrt(variances) * ARCSEC,
        "interaction_arcsec": np.sqrt(np.mean(met**2, axis=(0, 1))) * ARCSEC,
        "frames": "observed frames",
        "misfit": None,
        "total_arcsec": total * ARCSEC,
        "analytic_total_arcsec": np.sqrt(first(every.response, K).mean(axis=0)) * ARCSEC,
        "rest_constant_arcsec": steady * ARCSEC,
        "covariance_arcsec2": np.stack(
            [
                covariance(every.covariance, nea),
                covariance(spread(together)[None], sigma_common),
                covariance(spread(apart), sigma_rest),
                covariance(spread(every.response), total),
                np.mean(met[..., None] * met[..., None, :], axis=(0, 1)) * ARCSEC**2,
            ]
        ),
        "alignment_covariance_arcsec2": other.aligned * ARCSEC**2,
        "n_sampled_frames": len(places),
    }


def wide(**changes: Any) -> Any:
    """A camera so uncertain, and so noisy, that first order misses per cents."""
    centred = POST.theta_draws[:200] - POST.theta_draws[:200].mean(axis=0)
    theta = THETA + [50.0, 50.0, 30.0, 20.0, 20.0] * centred
    post = SimpleNamespace(**{**vars(POST), "star_error_px": 10.0, **changes})
    post.theta_draws, post.mean, post.covariance = (
        theta,
        theta.mean(axis=0),
        np.cov(theta, rowvar=False),
    )
    post.sigma_draws = np.linspace(15.0, 25.0, 200)
    post.draws = np.column_stack((theta, post.sigma_draws))
    post.thin = lambda n, seed: post.draws[np.random.default_rng(seed).permutation(200)[:n]]
    return post


def frames(seed: int, stars: tuple[int, ...], stated: bool) -> Observations:
    rng = np.random.default_rng(seed)
    made = table([pixels for n in stars for pixels in skies(rng, 1, n)])
    return dataclasses.replace(made, sigma_px=rng.uniform(0.5, 1.5, len(made))) if stated else made


@pytest.mark.parametrize(
    ("stated", "alignment", "limit"), [(False, "observed", 300), (True, "table", 3)]
)
def test_all_of_an_attitude_error_is_that_of_a_second_make(
    monkeypatch: pytest.MonkeyPatch, stated: bool, alignment: str, limit: int
) -> None:
    monkeypatch.setattr(propagating, "_SAMPLES", SAMPLES)
    monkeypatch.setattr(through, "_SAMPLED_FRAMES", limit)
    monkeypatch.setattr(through, "_FEWEST_FRAMES", min(limit, 30))
    post = wide(sigma_name="sigma_scale" if stated else "sigma")
    obs, other = frames(1, (9, 7, 11, 8), stated), frames(2, (10, 8, 9, 7, 12), stated)
    align = obs if alignment == "observed" else other
    found = propagate(
        post, obs, n_draws=45, seed=SEED, alignment="observed" if align is obs else align
    )
    expected = second(post, obs, align, 45, limit)
    assert found.seen is obs and found.aligned is align
    assert found.alignment == ("4 frames (the same)" if align is obs else "5 frames (given)")
    for name, value in expected.items():
        made = getattr(found, name)
        if isinstance(value, np.ndarray):
            # Single draws and covariances come close to zero.
            near: Any = 2e-5 * np.abs(value).max(axis=0) if name == "common_draws_arcsec" else 0.0
            if "covariance" in name:
                size = np.sqrt(np.diagonal(value, axis1=-2, axis2=-1))
                near = 2e-5 * size[..., None] * size[..., None, :]
            assert np.all(np.abs(made - value) <= 2e-5 * np.abs(value) + near), (name, made, value)
        else:
            assert made == value, name
    # Control: first order alone is another number.
    for name in ("nea", "common", "rest", "total"):
        ratio = getattr(found, f"{name}_arcsec") / getattr(found, f"analytic_{name}_arcsec")
        assert np.max(np.abs(ratio - 1.0)) > 2e-3, name


def test_how_many_frames_go_through_quest(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as hold 20,000 stars, between 30 and 300."""
    monkeypatch.setattr(through, "frame_sample", lambda obs, limit, seed: (obs, limit))
    for n_frames, n_stars, limit in (
        (1_000, 10_000, 300),
        (1_000_000, 100_000_000, 200),
        (1_000_000, 100_000_001, 199),
        (1_000, 1_000_000, 30),
    ):
        assert through._few(SimpleNamespace(n_frames=n_frames, n_stars=n_stars), 0)[1] == limit  # type: ignore[arg-type]


def test_a_camera_without_error_leaves_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(propagating, "_SAMPLES", 40_000)
    post = wide()
    post.theta_draws = np.tile(post.mean, (200, 1))
    post.draws[:, :-1], post.covariance = post.mean, np.zeros((5, 5))
    found = propagate(post, frames(1, (9,), False), n_draws=5)
    for name in (
        "common_arcsec",
        "rest_arcsec",
        "total_arcsec",
        "rest_constant_arcsec",
        "interaction_arcsec",
    ):
        np.testing.assert_allclose(getattr(found, name), 0.0, rtol=0, atol=1e-6)
    assert np.all(np.abs(found.covariance_arcsec2[1:]) < 1e-12)
    # One frame is Gaussian.
    ratio = np.stack((found.p95_arcsec, found.p997_arcsec))[:, 0, :3] / found.analytic_nea_arcsec
    np.testing.assert_allclose(ratio, norm.isf([[0.025] * 3, [0.0015] * 3]), rtol=0.04)


def test_ratios_of_next_to_nothing_are_none() -> None:
    sampled = np.array([[2e-6, 5e-7, 3.0], [0.0, 2.0, 2.0], [1.0, 1.0, 0.0]])
    first = np.array([[1e-6, 9e-7, 2.0], [0.0, 1.0, 4.0], [1.0, 0.0, 1.0]])
    made = AttitudeError(*sampled, *(np.ones((5, 4)),) * 2, *first, 10, 20)
    ratio = made.agreement.ratio
    np.testing.assert_allclose(ratio, [[2.0, np.nan, 1.5], [np.nan, 2.0, 0.5], [1.0, np.nan, 0.0]])
    assert "the sampled values hold" in made.agreement.text
    assert made.agreement.largest == 1.0 and made.agreement.contributors == CONTRIBUTORS[:3]
    table = made.agreement.to_dataframe()
    assert table["contributor"].tolist() == [name for name in CONTRIBUTORS[:3] for _ in AXES]
    assert table["axis"].tolist() == [*AXES] * 3
    np.testing.assert_array_equal(table["sampled_over_first_order"], ratio.ravel())
    nothing = AttitudeError(*np.zeros((3, 3)), *(np.zeros((5, 4)),) * 2, *np.zeros((3, 3)), 10, 20)
    assert nothing.agreement.largest == 0.0


def test_a_file_holds_each_number_in_its_column(tmp_path: Path) -> None:
    """Written with a misfit, read by pandas alone; and back again to every field."""
    rng = np.random.default_rng(3)
    sizes, analytic = rng.uniform(1.0, 2.0, (5, 3)), rng.uniform(1.0, 2.0, (4, 3))
    root = rng.standard_normal((6, 3, 3))
    matrices = root @ np.swapaxes(root, 1, 2)
    made = AttitudeError(
        *(
            sizes[0],
            sizes[1],
            sizes[2],
            rng.uniform(2.0, 3.0, (5, 4)),
            rng.uniform(3.0, 4.0, (5, 4)),
        ),
        *(analytic[0], analytic[1], analytic[2]),
        n_draws=31,
        n_frames=41,
        n_sampled_frames=17,
        interaction_arcsec=sizes[4],
        frames="a night",
        total_arcsec=sizes[3],
        analytic_total_arcsec=analytic[3],
        rest_constant_arcsec=rng.uniform(0.0, 1.0, 3),
        covariance_arcsec2=matrices[:5],
        alignment="9 frames",
        alignment_covariance_arcsec2=matrices[5],
        misfit=OnboardError(
            "model",
            *rng.uniform(0.0, 1.0, (3, 3)),
            (EffectError("field", *rng.uniform(0.0, 1.0, (2, 3))),),
        ),
    )
    made.save(tmp_path / "attitude.csv")
    table = pd.read_csv(tmp_path / "attitude.csv", dtype=str, keep_default_na=False)
    again = AttitudeError.load(tmp_path / "attitude.csv")
    for field in dataclasses.fields(AttitudeError):
        one, other = getattr(made, field.name), getattr(again, field.name)
        if field.name != "misfit":
            np.testing.assert_array_equal(one, other, err_msg=field.name)
            assert type(one) is type(other), field.name
    assert json.dumps(to_plain(again.misfit)) == json.dumps(to_plain(made.misfit))
    pd.testing.assert_frame_equal(again.to_dataframe(), made.to_dataframe(), check_exact=True)

    def across(values: np.ndarray) -> np.ndarray:
        return np.append(values, np.sqrt(0.5 * (values[0] ** 2 + values[1] ** 2)))

    zero = np.zeros(3)
    expected: dict[str, Any] = {
        "contributor": np.repeat(CONTRIBUTORS, 4),
        "axis": TOTAL_AXES * 5,
        "if_model_holds_arcsec": np.concatenate([across(row) for row in sizes]),
        "p95_if_model_holds_arcsec": made.p95_arcsec.ravel(),
        "p997_if_model_holds_arcsec": made.p997_arcsec.ravel(),
        "first_order_arcsec": np.concatenate([across(row) for row in (*analytic, zero)]),
        "absorbed_by_alignment": np.repeat(["no", "yes", "no", "in part", "no"], 4),
        **{
            "n_draws": 31,
            "n_frames": 41,
            "n_sampled_frames": 17,
            "frames": "a night",
            "alignment": "9 frames",
        },
        "rest_constant_arcsec": np.tile(across(made.rest_constant_arcsec), 5),
        "alignment_sigma_arcsec": np.tile(across(np.sqrt(np.diag(matrices[5]))), 5),
    }
    for i, axis in enumerate(AXES):
        for prefix, several in (
            ("", matrices[:5]),
            ("alignment_", np.repeat(matrices[5:], 5, axis=0)),
        ):
            column = np.column_stack((several[:, :, i], np.full(5, np.nan)))
            expected[f"{prefix}covariance_{axis}_arcsec2"] = column.ravel()
    for name, values in expected.items():
        if isinstance(values, np.ndarray) and values.dtype.kind == "f":
            written = [float(text or "nan") for text in table[name]]
            np.testing.assert_allclose(written, values, rtol=1e-14, err_msg=name)
        else:
            assert (table[name] == np.broadcast_to(np.asarray(values, dtype=str), 20)).all(), name
    assert [bool(text) for text in table["misfit"]] == [True] + [False] * 19
    before = dataclasses.replace(made, analytic_total_arcsec=None).to_dataframe()
    np.testing.assert_allclose(before["first_order_arcsec"][12:15], np.hypot(*analytic[1:3]))
    untested = dataclasses.replace(made, misfit=None).to_written()
    for name in untested.columns:
        assert (untested[name].astype(str) == "not assessed").all() == ("with_misfit_found" in name)


def test_a_field_map_is_that_of_a_second_make() -> None:
    """Least squares over the detector with half weights at its edges, by numerical derivatives."""
    post = wide()
    post.calibrated_camera = POST.camera.with_theta(post.mean)
    found = field_map(post, frames(1, (9, 7), False), n=5)
    x = np.linspace(-0.5, 1023.5, 5)
    np.testing.assert_allclose((found.x_px, found.y_px), (x, x), rtol=1e-14)
    xy = np.column_stack([g.ravel() for g in np.meshgrid(x, x)])
    b = directions(post.mean, xy)
    steps = np.diag(1e-3 * np.sqrt(np.diag(post.covariance)))
    B = np.stack(
        [
            (directions(post.mean + e, xy) - directions(post.mean - e, xy)) / (2.0 * e.max())
            for e in steps
        ],
        2,
    )
    weight = np.outer([0.5, 1, 1, 1, 0.5], [0.5, 1, 1, 1, 0.5]).ravel()
    normal = np.einsum("n,nij->ij", weight, np.eye(3) - b[:, :, None] * b[:, None])
    turned = np.linalg.solve(
        normal, np.einsum("n,nip->ip", weight, np.cross(b[:, :, None], B, axis=1))
    )
    rest = B - np.cross(turned[None], b[:, :, None], axis=1)
    for derivatives, sigma, worst, ellipse in (
        (
            B,
            found.sigma_absolute_arcsec,
            found.worst_absolute_arcsec,
            found.covariance_absolute_arcsec2,
        ),
        (
            rest,
            found.sigma_compensated_arcsec,
            found.worst_compensated_arcsec,
            found.covariance_compensated_arcsec2,
        ),
    ):
        covariance = derivatives @ post.covariance @ np.swapaxes(derivatives, 1, 2) * ARCSEC**2
        values = np.linalg.eigvalsh(covariance)
        np.testing.assert_allclose(sigma.ravel(), np.sqrt(0.5 * values.sum(axis=1)), rtol=1e-6)
        np.testing.assert_allclose(worst.ravel(), np.sqrt(values[:, 2]), rtol=1e-6)
        np.testing.assert_allclose(
            np.linalg.eigvalsh(ellipse).reshape(25, 2), values[:, 1:], rtol=1e-5, atol=1e-9
        )
        size = np.sqrt(np.einsum("nii,njj->nij", covariance, covariance))[:, :2, :2]
        np.testing.assert_allclose(
            ellipse.reshape(25, 2, 2) / size, covariance[:, :2, :2] / size, rtol=0, atol=0.03
        )
    rotation = turned @ post.covariance @ turned.T * ARCSEC**2
    np.testing.assert_allclose(
        found.rotation_covariance_arcsec2, rotation, rtol=1e-5, atol=1e-9 * rotation.max()
    )
    shift = np.linalg.inv(turned[:2, :2]) @ turned[:2]
    equal = shift @ post.covariance @ shift.T
    np.testing.assert_allclose(
        found.equivalent_covariance_px2, equal, rtol=1e-5, atol=1e-9 * equal.max()
    )
    np.testing.assert_allclose(
        found.equivalent_principal_point_px, np.sqrt(np.diag(equal)), rtol=1e-6
    )
    np.testing.assert_allclose(
        found.equivalent_principal_point_arcsec, np.sqrt(np.diag(rotation))[[1, 0]], rtol=1e-6
    )
    table = found.to_dataframe()
    assert (
        table["x_px"].tolist() == xy[:, 0].tolist() and table["y_px"].tolist() == xy[:, 1].tolist()
    )
    for kind in ("absolute", "compensated"):
        matrices = getattr(found, f"covariance_{kind}_arcsec2").reshape(25, 2, 2)
        for name, entry in (
            ("xx", matrices[:, 0, 0]),
            ("xy", matrices[:, 1, 0]),
            ("yy", matrices[:, 1, 1]),
        ):
            np.testing.assert_allclose(table[f"{kind}_{name}_arcsec2"], entry, rtol=1e-9)
        for name in ("sigma", "worst"):
            assert (
                table[f"{name}_{kind}_arcsec"].tolist()
                == getattr(found, f"{name}_{kind}_arcsec").ravel().tolist()
            )
    assert len(table.columns) == 12


def test_a_coupling_is_its_covariance_said_otherwise() -> None:
    """Every field and column from the covariance, the information, the prior and the responses,
    each by its formula.
    """
    rng = np.random.default_rng(2)
    scale = np.array([0.3, 0.2, 0.5, 1e-10, 1e-16])
    root = rng.standard_normal((5, 5))
    covariance = (root @ root.T) * np.outer(scale, scale)
    response, noise = rng.standard_normal((3, 5)) / scale * 1e-5, 1e-9 * np.eye(3)
    unit = covariance / np.outer(scale, scale)
    result = SimpleNamespace(
        camera=POST.camera,
        covariance=covariance,
        information=2.0 * np.linalg.inv(unit) / np.outer(scale, scale),
        rotation_per_theta=response,
        attitude_noise=noise,
        priors=SimpleNamespace(sd=lambda names: 7.0 * scale),
    )
    found = coupling(result)
    sigma = np.sqrt(np.diag(covariance))
    conditional = scale / np.sqrt(np.diag(np.linalg.inv(unit)))
    joint = np.vstack([np.diag(1.0 / scale), response])
    whole = joint @ covariance @ joint.T
    sizes = np.sqrt(np.diag(whole))
    extended = whole / np.outer(sizes, sizes)
    single = np.sqrt(np.diag(response @ covariance @ response.T + noise))
    assert (found.parameter_names, found.extended_names) == (
        ("x0", "y0", "f", "k1", "k2"),
        ("x0", "y0", "f", "k1", "k2", *AXES),
    )
    assert found.units == ("px", "px", "px", "px^-2", "px^-4")
    for name, expected in (
        ("correlation", extended[:5, :5]),
        ("covariance", covariance),
        ("sigma_marginal", sigma),
        ("sigma_conditional", conditional),
        ("variance_inflation", (sigma / conditional) ** 2),
        ("information", result.information),
        ("crlb_sigma", sigma / np.sqrt(2.0)),
        ("prior_sigma", 7.0 * scale),
        ("contraction", 1.0 - (sigma / (7.0 * scale)) ** 2),
        ("extended_correlation", extended),
        ("common_rotation_arcsec", sizes[5:] * ARCSEC),
        ("single_frame_correlation", covariance @ response.T / np.outer(sigma, single)),
    ):
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-8, err_msg=name)
    assert np.diag(found.extended_correlation).tolist() == [1.0] * 8
    values, vectors = np.linalg.eigh(extended[:5, :5])
    for direction, value, vector in zip(
        found.weak_directions, values[::-1], vectors.T[::-1], strict=True
    ):
        assert direction.variance == pytest.approx(value)
        sign = np.sign(vector[np.argmax(np.abs(vector))])
        np.testing.assert_allclose(direction.weights, sign * vector, rtol=1e-6, atol=1e-12)
    pairs = {(a, b): extended[i, j] for i, a in enumerate(found.parameter_names)
             for j, b in enumerate(found.parameter_names) if i < j}  # fmt: skip
    for least in (0.5, 0.1):
        strong = sorted(
            (pair for pair in pairs if abs(pairs[pair]) >= least),
            key=lambda pair: -abs(pairs[pair]),
        )
        assert [pair[:2] for pair in found.pairs(least)] == strong and 0 < len(strong) < 10
        np.testing.assert_allclose(
            [pair[2] for pair in found.pairs(least)], [pairs[pair] for pair in strong]
        )
    assert found.pairs() == found.pairs(0.5)
    table = found.to_dataframe()
    names = [
        "sigma_marginal",
        "sigma_conditional",
        "variance_inflation",
        "crlb_sigma",
        "prior_sigma",
        "contraction",
    ]
    assert table.columns.tolist() == [
        "parameter",
        "unit",
        *names,
        *(f"corr_{name}" for name in found.extended_names),
    ]
    for name in names:
        assert table[name].tolist() == getattr(found, name).tolist()
    np.testing.assert_array_equal(
        table.iloc[:, 8:].to_numpy(dtype=float), found.extended_correlation[:5]
    )
    assert (table["parameter"].tolist(), table["unit"].tolist()) == (
        [*found.parameter_names],
        [*found.units],
    )
    del result.priors
    bare = coupling(result)
    assert (
        bare.prior_sigma is None
        and bare.contraction is None
        and len(bare.to_dataframe().columns) == 14
    )


def test_a_curve_is_that_of_its_draws() -> None:
    post = wide()
    post.calibrated_camera = POST.camera.with_theta(post.mean)
    obs = frames(1, (9, 7), False)
    found = distortion_curve(post, obs, n=6, n_draws=50, level=0.9, seed=SEED)
    thetas = post.thin(50, SEED)[:, :-1]
    x0, y0, f = post.mean[:3]
    corner = np.hypot(max(x0 + 0.5, 1023.5 - x0), max(y0 + 0.5, 1023.5 - y0))
    radius = np.linspace(0.0, corner, 6)
    np.testing.assert_allclose(found.radius_px, radius, rtol=1e-14)
    ideal = np.empty((50, 6))
    for row, theta in zip(ideal, thetas, strict=True):
        b = directions(theta, theta[:2] + np.column_stack((radius, np.zeros(6))))
        row[:] = theta[2] * b[:, 0] / b[:, 2]
    curves = radius - ideal
    mean, sd = curves.mean(axis=0), curves.std(axis=0, ddof=1)
    away = np.abs(curves - mean)[:, 1:] / sd[1:]
    multiplier = np.quantile(away.max(axis=1), 0.9)
    bands = [np.quantile(curves, q, axis=0) for q in (0.05, 0.95)]
    for name, expected in (
        ("mean_px", mean),
        ("sd_px", sd),
        ("lower_px", bands[0]),
        ("upper_px", bands[1]),
        ("lower_simultaneous_px", mean - multiplier * sd),
        ("upper_simultaneous_px", mean + multiplier * sd),
    ):
        np.testing.assert_allclose(
            getattr(found, name)[0], expected, rtol=1e-6, atol=1e-9, err_msg=name
        )
    np.testing.assert_allclose(found.arcsec_per_px, ARCSEC * f / (f**2 + radius**2), rtol=1e-12)
    assert found.multiplier == pytest.approx(multiplier, rel=1e-6)
    assert (found.level, found.model, found.n_draws, found.azimuth_deg.tolist()) == (
        0.9,
        "brown",
        50,
        [0.0],
    )
    assert found.star_radius_px == pytest.approx(
        np.linalg.norm(obs.xy - post.mean[:2], axis=1).max()
    )
    table = found.to_dataframe()
    assert (
        table["radius_px"].tolist() == radius.tolist()
        and table["azimuth_deg"].tolist() == [0.0] * 6
    )
    for name in (
        "mean_px",
        "sd_px",
        "lower_px",
        "upper_px",
        "lower_simultaneous_px",
        "upper_simultaneous_px",
    ):
        assert table[name].tolist() == getattr(found, name)[0].tolist()
    for wrong in ({"n": 1}, {"level": 0.0}, {"level": 1.0}):
        with pytest.raises(ValueError, match=r"at least 2|level"):
            distortion_curve(post, **wrong)
