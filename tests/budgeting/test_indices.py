"""Error indices of whole budgets: against time series and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from starcal_uq.budgeting.behaviour import Behaviour
from starcal_uq.budgeting.indices import NAMES, Index, seen_by
from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import COMMON, NEA, REST, Contributor
from starcal_uq.core.errors import BudgetError
from starcal_uq.propagation.spectrum import ErrorSpectrum
from tests.budgeting.test_budget import made

ROW = """
[[contributor]]
name = "{name}"
axis = "X"
ecss_class = "other"
interpretation = "{kind}"
absorbed_by_alignment = "no"
provenance = "note"
{keys}
"""


def written(folder: Path, *parts: str) -> Path:
    path = folder / "budget.toml"
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def rows_of(found: Budget, name: str) -> list[Contributor]:
    return [row for row in found.rows if row.name == name]


def test_the_absolute_knowledge_error_is_the_total_of_today(tmp_path: Path) -> None:
    index = '[[index]]\nkind = "APE"\n'
    found = made(
        written(tmp_path, index, ROW.format(name="own", kind="mixed", keys="sigma_arcsec = 3"))
    )
    assert found.indices == ("AKE", "APE")
    for axis in ("pitch", "cross-boresight"):
        absolute, performance = found.total(axis), found.total(axis, index="APE")
        assert performance.sampled_arcsec == absolute.sampled_arcsec
        assert performance.rule_arcsec == absolute.rule_arcsec > 8.0


def test_control_errors_are_in_pointing_alone(tmp_path: Path) -> None:
    keys = 'sigma_arcsec = 30.0\npart = "control"'
    path = written(
        tmp_path, '[[index]]\nkind = "APE"', ROW.format(name="wheels", kind="temporal", keys=keys)
    )
    found, without = made(path), made()
    assert found.total("X").rule_arcsec == without.total("X").rule_arcsec
    assert found.total("X", index="APE").rule_arcsec > 80.0
    classes = found.classes_dataframe()
    assert classes.loc[classes["ecss_class"] == "other", "sigma_arcsec"].tolist() in ([], [0.0] * 3)


def test_an_index_of_a_budget_is_that_of_simulated_sensors(tmp_path: Path) -> None:
    """A thermal sinusoid, frames with noise and a launch shift, 10,000 sensors."""
    rng, n, window, frame = np.random.default_rng(8), 10_000, 300.0, 20.0
    path = written(
        tmp_path,
        f"[budget]\nframe_seconds = {frame}",
        *(f'[[index]]\nkind = "{k}"\nwindow_seconds = {window}' for k in ("MKE", "RKE")),
        f'[[index]]\nkind = "KDE"\nwindow_seconds = {window}\nstability_seconds = 1500.0',
        ROW.format(
            name="thermal", kind="temporal", keys="half_width_arcsec = 2.0\nperiod_seconds = 5880.0"
        ),
        ROW.format(
            name="shift", kind="ensemble", keys='half_width_arcsec = 4.0\ndistribution = "uniform"'
        ),
    )
    found = made(path, n_samples=50_000)
    (noise,) = {r.sigma_arcsec for r in rows_of(found, NEA) if r.axis == "pitch"}
    (common,) = {r.sigma_arcsec for r in rows_of(found, COMMON) if r.axis == "pitch"}
    # Beside the rows that this simulation holds, the calibration leaves a hundredth of an arcsec.
    t = rng.uniform(0.0, 5880.0, (n, 1)) + np.arange(0.0, 1500.0 + window, frame)
    errors = 2.0 * np.sin(2.0 * np.pi * t / 5880.0) + noise * rng.standard_normal(t.shape)
    errors += 4.0 * rng.uniform(-1.0, 1.0, (n, 1)) + common * rng.standard_normal((n, 1))
    first, later = errors[:, :15].mean(axis=1), errors[:, -15:].mean(axis=1)
    simulated = {
        "MKE 300 s": first.std(),
        "RKE 300 s": np.sqrt(np.mean((errors[:, :15] - first[:, None]) ** 2)),
        "KDE 300 s / 1500 s": (later - first).std(),
    }
    for label, sigma in simulated.items():
        stated = found.total("X", "before alignment", index=label)
        # A window of 15 frames ends 10 s short of its time.
        assert stated.sigma_arcsec == pytest.approx(sigma, rel=0.02), label
        control = found.total("X", "before alignment")
        assert abs(control.sigma_arcsec / sigma - 1.0) > 0.05 or label.startswith("MKE")
    # The rest is mixed, and nobody stated how it changes.
    assert REST in found.total("X", index="RKE 300 s").at_most


def test_what_is_taken_at_most_leaves_a_requirement_open(tmp_path: Path) -> None:
    def asked(keys: str) -> str:
        return (
            f'[[requirement]]\nname = "R"\naxis = "X"\nindex = "RKE"\nwindow_seconds = 9.0\n{keys}'
        )

    row = ROW.format(name="own", kind="temporal", keys="sigma_arcsec = 5.0")
    (outcome,) = made(written(tmp_path, row, asked("limit_arcsec = 2.0"))).outcomes
    assert outcome.bound_arcsec > 14.0 and outcome.verdict == "open"
    assert outcome.total.at_most[0] == REST and "own" in outcome.total.at_most
    stated = ROW.format(
        name="own", kind="temporal", keys="sigma_arcsec = 5.0\nsample_seconds = 1.0"
    )
    (outcome,) = made(written(tmp_path, stated, asked("limit_arcsec = 2.0"))).outcomes
    assert outcome.verdict == "violated"
    assert "RKE 9 s, pitch" in outcome.text


def test_a_rate_moves_spatial_rows_between_classes(tmp_path: Path) -> None:
    still = made(written(tmp_path, "[budget]\nrate_deg_s = 0.0"))
    rest = rows_of(still, REST)
    assert {(row.ecss_class, row.interpretation, row.behaviour) for row in rest} == {
        ("bias", "ensemble", "constant")
    }
    assert "FOV spatial" not in {
        name
        for name, _, _, at_least in still.classes_dataframe().itertuples(index=False)
        if not at_least
    }
    moving = made(
        written(
            tmp_path, "[budget]\nrate_deg_s = 0.5", '[[index]]\nkind = "MKE"\nwindow_seconds = 8.0'
        )
    )
    # The field of 16 degrees passes in 32 s.
    assert {(r.ecss_class, r.behaviour) for r in rows_of(moving, REST)} == {
        ("FOV spatial", "periodic, 32 s")
    }


def test_the_spectrum_of_the_calibration_states_its_behaviour() -> None:
    f = np.arange(1, 33) / 64.0
    psd = np.stack([1.0 / (1.0 + (f / 0.05) ** 2)] * 3, axis=1)
    spectrum = ErrorSpectrum(
        *(f, psd, np.ones(3), psd.sum(axis=0) * f[0], np.ones(3), np.arange(32.0)),
        *(np.ones((32, 3)), np.arange(64.0), np.ones((64, 3)), 1.0, 0.0, 100),
    )
    found = made(spectrum=spectrum, indices=[Index("MKE", 4.0)])
    assert {row.behaviour for row in rows_of(found, NEA)} == {"white, 1 s"}
    assert {row.behaviour for row in rows_of(found, REST)} == {"series, 1 s"}
    behaviour = Behaviour("series", 1.0, f, psd[:, 0] * f[0])
    rest = rows_of(found, REST)
    seen, _ = seen_by(Index("MKE", 4.0), rest, {(REST, row.axis): behaviour for row in rest})
    passed = (np.sinc(4.0 * f) / np.sinc(f)) ** 2
    expected = np.sqrt(passed @ psd[:, 0] / psd[:, 0].sum())
    assert [s.sigma_arcsec for s in seen] == pytest.approx(
        [expected * r.sigma_arcsec for r in rest]
    )


def test_budgets_with_indices_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        '[[index]]\nkind = "PRE"\nwindow_seconds = 60.0\nstability_seconds = 86400.0',
        '[[requirement]]\nname = "R"\naxis = "Z"\nlimit_arcsec = 9.0\nindex = "RPE"\nwindow_seconds = 2.5',
    )
    found = made(path)
    found.save(tmp_path / "budget.csv")
    again = Budget.load(tmp_path / "budget.csv")
    assert repr(again) == repr(found)
    assert again.indices == ("AKE", "PRE 60 s / 86400 s", "RPE 2.5 s")
    assert again.outcomes[0].total.of_index == "RPE 2.5 s"
    with pytest.raises(ValueError, match="RPE 3 s"):
        again.total("X", index="RPE 3 s")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            '[[index]]\nkind = "RKE"\n',
            r"\[\[index\]\] 1: .*RKE needs window_seconds; give a positive",
        ),
        (
            '[[index]]\nkind = "AKE"\nwindow_seconds = 3.0\n',
            "AKE takes no window_seconds; leave it out",
        ),
        (
            '[[index]]\nkind = "KDE"\nwindow_seconds = 3.0\n',
            "KDE needs stability_seconds; give a positive",
        ),
        ('[[behaviour]]\nname = "calibration, rest"\n', "no key states a behaviour"),
        ('[[behaviour]]\nname = "calibration, rst"\nperiod_seconds = 3.0\n', "did you mean"),
        (
            ROW.format(name="a", kind="mixed", keys="period_seconds = 3.0\nsample_seconds = 3.0"),
            "both state",
        ),
        (ROW.format(name="a", kind="mixed", keys='psd = "none.csv"'), "none.csv"),
        (
            ROW.format(name="a", kind="mixed", keys="sigma_arcsec = 1.0\ndrift_seconds = 50.0")
            + '[[index]]\nkind = "KDE"\nwindow_seconds = 30.0\nstability_seconds = 30.0\n',
            "known over 50 s",
        ),
    ],
)
def test_a_wrong_index_or_behaviour_is_refused(tmp_path: Path, text: str, words: str) -> None:
    from starcal_uq.core.errors import StarcalError

    with pytest.raises(StarcalError, match=words):
        made(written(tmp_path, text))


def test_every_kind_has_its_times() -> None:
    times: dict[str, tuple[float, ...]] = dict.fromkeys(NAMES, (9.0,))
    times |= dict.fromkeys(("APE", "AKE"), ())
    times |= dict.fromkeys(("PDE", "KDE", "PRE", "KRE"), (9.0, 3.0))
    assert {Index(kind, *given).label for kind, given in times.items()} == {
        *("APE", "AKE", "MPE 9 s", "MKE 9 s", "RPE 9 s", "RKE 9 s"),
        *(f"{kind} 9 s / 3 s" for kind in ("PDE", "KDE", "PRE", "KRE")),
    }
    with pytest.raises(BudgetError):
        Index("XPE")
