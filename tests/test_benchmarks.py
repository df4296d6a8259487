"""The harness of the benchmarks on planted times: nothing is started, nothing is timed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from benchmarks import run as bench
from benchmarks.answers import judged_frames, same_estimate
from benchmarks.harness import CONTESTANTS, Contestant, Runs, Turn, ratio, spread, take_turns

# A machine that is up to ten times slower in some turns than in others.
LOAD = (1.0, 10.0, 3.0, 1.0, 7.0)
SECONDS = {"ours": 0.1, "twice": 0.2, "wrong": 0.05}


class Planted:
    """A worker that says what it was told to."""

    order: ClassVar[list[str]] = []

    def __init__(self, call, options, folder, command, environment):
        self.name, self.environment, self.turn = call.partition(":")[2], environment, -1
        self.missing = "it is not installed" if self.name == "absent" else None

    def go(self):
        Planted.order.append(self.name)
        slow = 100.0 if self.turn < 0 else LOAD[self.turn % len(LOAD)]
        self.turn += 1
        took = SECONDS[self.name] * slow
        theta = np.array([1.0, 2.0]) + (5.0 if self.name == "wrong" else 0.001) * (
            self.name != "ours"
        )
        result = {"theta": theta.tolist(), "covariance": np.eye(2).tolist()}
        return {"wall": 2.0 * took, "processor": took, "peak_mb": 50.0, "result": result}

    def end(self):
        pass


@pytest.fixture
def planted(monkeypatch, tmp_path):
    monkeypatch.setattr(bench, "Worker", Planted)
    monkeypatch.setattr(bench, "CACHE", tmp_path)
    Planted.order = []
    names = ("ours", "twice", "wrong", "absent")
    return bench.Row(
        name="planted",
        what="Planted",
        contestants=tuple(Contestant(name, f"x:{name}") for name in names),
        same=same_estimate(),
        repeats=5,
        targets=(
            bench.Target("no longer than the other", "twice"),
            bench.Target("60 MB", peak=True),
            bench.Target("as fast as what is not there", "absent"),
        ),
    )


def test_contestants_take_turns_and_the_load_of_the_machine_cancels(planted):
    found = bench.run_row(planted)
    assert Planted.order == ["ours", "twice", "wrong"] * 6  # the first call of each, and five turns
    ours, twice, wrong, absent = found["contestants"]
    for clock in ("processor", "wall"):
        assert twice[f"{clock}_ratio"] == pytest.approx({"median": 2.0, "low": 2.0, "high": 2.0})
    # The control: ratios across turns would have the spread of the machine.
    assert twice["processor"]["high"] / ours["processor"]["low"] > 10.0
    assert ours["processor"]["median"] == pytest.approx(0.3)  # without the first call
    assert (twice["same"], wrong["same"]) == (True, False)
    assert absent["missing"] == "it is not installed"
    assert ours["first_processor"] == pytest.approx(10.0)
    assert found["targets"] == [
        {
            "target": "no longer than the other",
            "measured": "300 ms (600 ms)",
            "rival": "twice: 600 ms (1.2 s), 2 times ours",
        },
        {"target": "60 MB", "measured": "50 MB", "rival": "–"},
        {
            "target": "as fast as what is not there",
            "measured": "300 ms (600 ms)",
            "rival": "absent: not measured",
        },
    ]


def test_a_row_begins_no_turn_after_its_time(planted):
    def start(contestant):
        return Planted(contestant.call, {}, None, None, {})

    found = take_turns(planted.contestants[:2], 5, start, seconds=0.0)
    assert [len(runs.turns) for runs in found] == [1, 1]
    assert Planted.order == ["ours", "twice"] * 2


def test_a_row_says_what_differs_and_who_is_missing(planted):
    text = bench.table([bench.run_row(planted)])
    assert "| absent | not measured: it is not installed |" in text
    assert "**another answer**: 5 σ" in text
    assert "| twice | 20 s | 600 ms (1.2 s) | **2** (2–2) | 50 |" in text


def test_writing_keeps_rows_that_were_not_run(planted, monkeypatch, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(Path(bench.PAGE).read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(bench, "PAGE", page)
    monkeypatch.setattr(bench, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(bench, "rows", lambda: [planted, replace(planted, name="other")])
    assert bench.main(["--only", "other", "--repeats", "1", "--write"]) == 0
    assert bench.main(["--only", "planted", "--repeats", "1", "--write"]) == 0
    text = page.read_text(encoding="utf-8")
    assert text.index("`planted`") < text.index("`other`")
    assert "| 60 MB | 50 MB |" in text.partition("<!-- /targets -->")[0]
    # Written again it is the same.
    assert bench.main(["--only", "planted", "--repeats", "1", "--write"]) == 0
    assert page.read_text(encoding="utf-8") == text


def test_ratios_count_what_was_done_and_take_common_turns_only():
    ours = Runs("ours", {i: Turn(1.0, 1.0, 10.0) for i in range(4)})
    rival = Runs(
        "rival", {i: Turn(3.0, 2.0, amount) for i, amount in ((0, 1.0), (3, 2.0), (9, 1e9))}
    )
    found = ratio(rival, ours, "wall", float)
    assert (found.low, found.median, found.high) == pytest.approx(
        (18.75, 22.5, 26.25)
    )  # quartiles of 15 and 30
    assert ratio(Runs("rival"), ours, "wall") is None
    assert spread([5.0, 1.0, 3.0]).median == 3.0


def test_every_row_has_a_name_of_its_own_and_rivals_that_its_targets_name():
    rows = bench.rows()
    assert len({row.name for row in rows}) == len(rows)
    for row in rows:
        labels = [c.label for c in row.contestants]
        assert len(set(labels)) == len(labels)
        assert {t.rival for t in row.targets} - {None} <= set(labels[1:])
        for contestant in row.contestants:
            file, _, function = contestant.call.partition(":")
            source = (CONTESTANTS / f"{file}.py").read_text(encoding="utf-8")
            assert f"\ndef {function}(" in source
            assert contestant.how


def test_frames_are_judged_by_their_stars_and_their_middle(tmp_path):
    rng = np.random.default_rng(0)
    xy = np.column_stack([rng.uniform(0.0, 1023.0, 40), rng.uniform(0.0, 767.0, 40)])
    # Rays of a camera that looks at right ascension 0, declination 0.
    x, y = ((xy - (511.5, 383.5)) / 5000.0).T
    ra, dec = np.degrees(np.arctan(x)), np.degrees(np.arctan2(y, np.hypot(1.0, x)))
    rows = [
        f"0,{u},{v},{a},{d},s,5.0,20.0,{a},{d}" for (u, v), a, d in zip(xy, ra, dec, strict=True)
    ]
    table = tmp_path / "stars.csv"
    table.write_text(
        "\n".join(
            [
                "frame,x_px,y_px,ra_deg,dec_deg,star_id,mag,snr,ra_apparent_deg,dec_apparent_deg",
                *rows,
            ]
        )
    )
    stars = np.column_stack([xy, ra, dec])
    right = {"middle": [1.0, 0.0, 0.0], "stars": stars.tolist()}
    # A star of another name is 4 px off; the camera looks 0.1 degrees past, or away from its stars.
    other = stars + np.where(
        np.arange(40)[:, None] < 3, [0.0, 0.0, np.degrees(4.0 / 5000.0), 0.0], 0.0
    )
    past = [np.cos(np.radians(0.1)), np.sin(np.radians(0.1)), 0.0]

    def judged(**changes):
        return judged_frames(table, [right | changes])

    assert judged() == [(pytest.approx(0.0, abs=1e-4), 40, 40)]
    assert judged(stars=other.tolist()) == [(pytest.approx(0.0, abs=1e-4), 37, 40)]
    assert judged(middle=past) == [(pytest.approx(0.1, abs=1e-3), 40, 40)]
    assert judged(middle=[-1.0, 0.0, 0.0])[0][0] > 90.0
    assert judged(middle=None, stars=[]) == []
