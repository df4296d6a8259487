"""Options of `run` given together, generated from its declaration: they work, or are refused in
words.
"""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.cli.app import FAULT
from starcal_uq.cli.commands import app
from starcal_uq.runs import whole
from tests.helpers.ground_scenes import SITE
from tests.helpers.outside import campaign
from tests.helpers.ties import gyro, write_columns

KINDS = ("plain.csv", "rich.csv", "space.ecsv", "parts")
# Values of each option, None where it stands alone. Files are made by `tables`.
VALUES = {
    "--model": ("none", "k1", "brown_tangential", "inverse"),
    "--method": ("three_stage", "least_squares", "samaan", "griffith"),
    "--solver": ("minpack", "ipopt"),
    "--screen": (None,),
    "--effects": ("auto", "none", "field,frame", "star", "noise", "tails", "auto,noise,tails"),
    "--relative-attitudes": ("gyro.csv",),
    "--relative-alignment-arcsec": ("30",),
    "--mount": ("none", "fixed"),
    "--mount-sigma-arcsec": ("5",),
    "--start": ("x0_px=500",),
    "--max-iterations": ("500",),
    "--duplicates": ("drop", "keep"),
    "--scheduler": ("tcp://127.0.0.1:9",),
    "--workers": ("0",),
    "--directions": ("apparent", "catalogue", "undeclared"),
    "--site": ("site.toml",),
    "--in-space": (None,),
    "--time": ("2026-11-25T02:00:00",),
    "--column": ("sigma_px=x_px / 10000",),
    "--only-frames": ("0-3", "9"),
    "--pixel-um": ("12",),
    "--observer-velocity": ("7.5,0,0",),
    "--max-mag": ("5",),
    "--epoch": ("2020",),
    "--focal-tolerance": ("0.1",),
    "--gain": ("2",),
    "--bayer": ("RGGB",),
    "--engine": ("pyramid",),
    "--seed": ("3",),
    "--sigma": ("0.05",),
    "--priors": ("priors.toml",),
    "--likelihood": ("marginal", "pairs", "pairs_naive", "student_t"),
    "--evaluation": ("compressed", "exact"),
    "--moves": ("stretch",),
    "--dof": ("free", "5"),
    "--alignment": ("observed", "rich.csv"),
    "--alignment-frames": ("20",),
    "--onboard": ("effects",),
    "--temperature-profile": ("orbit.csv",),
    "--budget": ("budget.toml",),
    "--json": (None,),
}
# These say how large a run is and where it stands.
ALWAYS = {
    "--out": "out",
    "--force": None,
    "--ensembles": "2",
    "--walkers": "16",
    "--steps": "20",
    "--draws": "50",
}
# What a sentence for the command line has no words of: arguments, calls and attributes of Python.
PYTHON = re.compile(r"[a-z_]+='|[a-z_]+=(True|None)|\bsc\.|obs\.|, not both\.$|\(throw|Traceback")
# These change which stars are calibrated or where they are, or need a scheduler: wrong directions
# end no run well.
OF_THE_DATA = {
    "--only-frames",
    "--max-mag",
    "--column",
    "--directions",
    "--site",
    "--observer-velocity",
    "--scheduler",
}
# Whole runs of the slow test.
ROWS = 4
COMBINATIONS = [(name, value) for name, values in VALUES.items() for value in values]


@pytest.fixture
def tables(tmp_path):
    """Six frames of twelve stars, without and with all that a table can state, declared, and in two
    files.
    """
    c = campaign(np.random.default_rng(5), n_frames=6, stars_per_frame=12, patch_stars=14)
    columns = dict(c.columns)
    sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)).save(tmp_path / "camera.toml")
    plain = sc.Observations(
        **{name: columns[name] for name in ("frame", "x_px", "y_px", "ra_deg", "dec_deg")}
    )
    plain.save(tmp_path / "plain.csv")
    frame = columns["frame"]
    stated = {
        "sigma_px": np.full(len(frame), 0.05),
        "temperature_c": np.linspace(5.0, 25.0, 6)[frame],
    }
    times = np.array([f"2026-11-25T02:{minute:02d}:00" for minute in frame])
    sc.Observations(**columns, **stated, time_utc=times).save(tmp_path / "rich.csv")
    sc.Observations(**columns, meta={"directions": "apparent", "observer": "space"}).save(
        tmp_path / "space.ecsv"
    )
    (tmp_path / "parts").mkdir()
    for name, some in (("a", frame < 3), ("b", frame >= 3)):
        plain.select(some).save(tmp_path / "parts" / f"{name}.parquet")
    SITE.save(tmp_path / "site.toml")
    (tmp_path / "priors.toml").write_text("[priors]\nfocal_fraction = 0.05\n", encoding="utf-8")
    (tmp_path / "budget.toml").write_text("", encoding="utf-8")
    (tmp_path / "orbit.csv").write_text("time_s,temperature_c\n0,5\n60,25\n", encoding="utf-8")
    write_columns(tmp_path / "gyro.csv", gyro(np.random.default_rng(6), c, 5.0))
    return tmp_path


def command(kind, given):
    words = ["run", kind, "camera.toml"]
    for name, value in (ALWAYS | dict(given)).items():
        words += [name] if value is None else [name, value]
    return words


def check_ending(words, status, err):
    """Status 0, 1, or 2 with one sentence in the words of the command line."""
    call = " ".join(words)
    assert status in (0, 1, 2), (call, status, err)
    if status == 2:
        said = [line for line in err.splitlines() if line.startswith("error: ")]
        assert len(said) == 1 and err.splitlines()[-1] == said[0] and said[0].endswith("."), (
            call,
            err,
        )
        # Both worlds are served where a column is named.
        assert not PYTHON.search(said[0].replace(" or columns={...}", "")), (call, said[0])


def test_every_option_has_values():
    options = {
        max(parameter.opts, key=len)
        for parameter in app.commands["run"].params
        if parameter.opts[0].startswith("-")
    }
    of_the_call = {"--help", "--help-all", "--set", "--quiet", "--verbose"}
    assert options - of_the_call == VALUES.keys() | ALWAYS.keys()


class ReachedError(BaseException):
    """The table is read, and nothing stands against the options; no error of the program."""


@pytest.fixture
def asked(tables, cli, monkeypatch):
    """Whether a run begins to calibrate with these options of this kind of table, or else ends with
    a sentence.

    Without reading it, the options alone are judged.
    """

    def reached(*_args, **_options):
        raise ReachedError

    def begins(kind, given, read=True):
        words = command(kind, given)
        with monkeypatch.context() as patch:
            patch.setattr(sc.Run, "calibrate", reached)
            if not read:
                patch.setattr(whole, "read_stars", reached)
            try:
                status, _, err = cli(*words)
            except ReachedError:
                return True
        check_ending(words, status, err)
        return False

    return begins


def different(combination):
    return len({name for name, _ in combination}) == len(combination)


def test_some_pairs_of_options_work_or_are_refused_in_words(asked):
    assert asked("plain.csv", [("--effects", "tails"), ("--model", "k1")])
    assert asked("plain.csv", [("--effects", "tails,noise"), ("--likelihood", "student_t")])
    assert asked("plain.csv", [("--effects", "tails,star"), ("--likelihood", "marginal")])
    assert asked("plain.csv", [("--effects", "auto,noise")])
    assert asked("plain.csv", [("--effects", "noise"), ("--likelihood", "pairs")])
    assert asked("plain.csv", [("--effects", "auto"), ("--screen", None)])
    assert asked("parts", [("--effects", "none")])
    assert asked("plain.csv", [("--relative-attitudes", "gyro.csv"), ("--effects", "tails")])
    assert asked("rich.csv", [("--mount", "fixed"), ("--mount-sigma-arcsec", "5")])
    assert not asked("rich.csv", [("--mount", "fixed")])
    assert not asked("rich.csv", [("--relative-attitudes", "gyro.csv"), ("--effects", "auto")])
    for likelihood in ("pairs", "student_t"):
        words = [("--relative-attitudes", "gyro.csv"), ("--likelihood", likelihood)]
        assert not asked("plain.csv", words)
    assert asked("parts", [("--effects", "auto")])
    assert not asked("parts", [("--effects", "noise")])
    assert not asked("plain.csv", [("--effects", "none,frame")])
    assert not asked("plain.csv", [("--effects", "auto"), ("--method", "samaan")])
    assert not asked("plain.csv", [("--effects", "tails"), ("--method", "three_stage")])
    assert not asked("plain.csv", [("--effects", "tails"), ("--likelihood", "marginal")])
    assert not asked("plain.csv", [("--effects", "star"), ("--likelihood", "student_t")])
    assert not asked("parts", [("--effects", "star")])


@pytest.mark.slow
def test_many_pairs_and_triples_of_options_work_or_are_refused_in_words(asked):
    rng = np.random.default_rng(2)
    for size, tried in ((2, 300), (3, 100)):
        several = list(itertools.combinations(VALUES, size))
        for place in rng.choice(len(several), tried, replace=False):
            asked(rng.choice(KINDS), [(name, rng.choice(VALUES[name])) for name in several[place]])


def test_a_fault_of_the_program_has_a_status_of_its_own(tables, cli, monkeypatch):
    def wrong(*_args, **_options):
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(sc.Run, "calibrate", wrong)
    status, _, err = cli(*command("plain.csv", []))
    assert status == FAULT and "Traceback" in err
    assert err.splitlines()[-1].startswith("error: ValueError: this is a fault of starcal-uq")


@pytest.mark.slow
def test_runs_with_many_options_together_end_well_too(asked, cli):
    """Rows of as many options as can be given together, in random order: hundreds of pairs in a few
    runs.
    """
    choices = [choice for choice in COMBINATIONS if choice[0] not in OF_THE_DATA]
    begins = {kind: [choice for choice in choices if asked(kind, [choice])] for kind in KINDS}
    rows, together = [], set()
    rng = np.random.default_rng(3)
    for kind in itertools.islice(itertools.cycle(KINDS), ROWS):
        row: list[tuple[str, str | None]] = []
        for place in rng.permutation(len(begins[kind])):
            more = [*row, begins[kind][place]]
            if different(more) and asked(kind, more):
                row = more
        together |= set(itertools.combinations(sorted(row, key=COMBINATIONS.index), 2))
        rows.append((kind, row))
    assert len(together) > 150
    ended, errors = [], []
    for kind, row in rows:
        words = command(kind, row)
        status, _, err = cli(*words)
        check_ending(words, status, err)
        ended.append(status)
        errors.append(err[-300:] if status == 2 else "")
    # Few are refused after the work has begun: by the data, which then do not allow it.
    assert np.mean(np.array(ended) < 2) > 0.7, errors
