"""The comparison of two versions on planted folders: nothing of the package is run."""

from __future__ import annotations

import json

import numpy as np
import pytest

from verification import baseline
from verification.baseline_jobs import JOBS

DRAWING = "<svg><!-- focal length --><path d='M 1.5 2.5'/></svg>"


@pytest.fixture
def made(tmp_path):
    """Write a job's folder as `make` does; `changes` are files in the place of the usual ones."""

    def write(name, day="2031-05-06", **changes):
        folder = tmp_path / name / "demo"
        (folder / "terminal").mkdir(parents=True)
        record = {"work": f"/tmp/{name}-1234", "started": f"{day}T01:00:00+00:00"}
        record |= {"ended": f"{day}T01:09:00+00:00", "seconds": 1.0}
        (folder / "job.json").write_text(json.dumps(record), "utf-8")
        document = {
            "theta": [1.0, 2.0],
            "covariance": [[0.25, 0.0], [0.0, 1.0]],
            "note": "All well.",
        }
        files = {
            "terminal/01-demo.txt": f"Report: /tmp/{name}-1234/report.html\nf is 3 px",
            "stars.csv": "star,x_px,sigma_x_px\nVega,1.5,0.5\nDeneb,2.5,0.5\n",
            "result.json": json.dumps(
                document | {"created_utc": f"{day}T01:02:03Z", "seconds": 7.0}
            ),
            "page.html": f"<p>{day} 01:02:04 UTC, observed 2019-07-29</p>\n{DRAWING}<p>End</p>",
            "figure.svg": DRAWING,
        }
        for path, content in (files | changes).items():
            if content is not None:
                (folder / path).write_text(content, "utf-8")
        np.savez(folder / "arrays.npz", residuals=np.arange(3.0) + (name == "array") * 1e-15)
        return tmp_path / name

    return write


def test_runs_at_other_times_in_other_folders_are_the_same(made, capsys):
    assert (
        baseline.main(["compare", str(made("before")), str(made("after", day="2031-06-07"))]) == 0
    )
    assert "demo: the same" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"stars.csv": "star,x_px,sigma_x_px\nVega,1.5,0.5\nDeneb,2.6,0.5\n"},
            "x_px: 0.1, 0.04 of the largest, 0.2 sigma",
        ),
        ({"stars.csv": "star,x_px\nVega,1.5\nDeneb,2.5\n"}, "vanished: sigma_x_px"),
        ({"stars.csv": "star,x_px,sigma_x_px\nVega,1.5,0.5\nMizar,2.5,0.5\n"}, "star: + Mizar"),
        ({"stars.csv": "star,x_px,sigma_x_px\nVega,1.5,0.5\nDeneb,,0.5\n"}, "finite in one alone"),
        ({"stars.csv": None}, "stars.csv: vanished"),
        ({"result.json": '{"theta": [1.0, 2.0]}'}, "vanished: note"),
        ({"terminal/01-demo.txt": "Report: report.html\nf is 4 px"}, "+ f is 4 px"),
        (
            {"page.html": DRAWING.replace("focal", "other")},
            "drawing 1/lines: + <!-- other length -->",
        ),
        ({"page.html": f"<p>observed 2019-07-30</p>{DRAWING}<p>End</p>"}, "2019-07-30"),
        ({"figure.svg": DRAWING.replace("2.5", "2.6")}, "numbers: 0.1"),
        ({"new.txt": ""}, "new.txt: appeared"),
    ],
)
def test_a_planted_change_is_seen(made, capsys, changes, line):
    assert baseline.main(["compare", str(made("before")), str(made("after", **changes))]) == 1
    assert line in capsys.readouterr().out


def test_the_last_bit_of_an_array_is_seen_and_a_tolerance_may_allow_it(made, capsys):
    folders = [str(made("before")), str(made("array"))]
    assert baseline.main(["compare", *folders]) == 1
    assert "residuals: 1.11e-15" in capsys.readouterr().out
    assert baseline.main(["compare", *folders, "--tolerance", "1e-12"]) == 0
    assert "(within tolerance)" in capsys.readouterr().out


def test_words_that_were_changed_on_purpose_can_be_named(made):
    folders = [
        str(made("before")),
        str(made("after", **{"figure.svg": DRAWING.replace("focal", "other")})),
    ]
    assert baseline.main(["compare", *folders]) == 1
    assert baseline.main(["compare", *folders, "--replace", "focal length=other length"]) == 0


def test_a_part_of_a_document_that_vanished_is_one_line():
    before, after = {"a/b/c", "a/b/d", "a/e", "f"}, {"a/e/1", "g"}
    assert baseline.alone(before, after) == ["a/b", "a/e", "f"]
    assert baseline.alone(after, before) == ["a/e/1", "g"]


def test_folders_without_a_common_job_are_no_success(tmp_path):
    assert baseline.main(["compare", str(tmp_path), str(tmp_path)]) == 1


def test_each_job_has_a_name_of_its_own_and_lines_that_can_be_filled_in():
    assert len({job.name for job in JOBS}) == len(JOBS)
    for line in (line for job in JOBS for line in job.lines):
        if not line.startswith("file "):
            assert "{seed}" not in line.format(seed=7)


def test_a_job_is_made_and_compared_with_itself(tmp_path, monkeypatch, capsys):
    job = baseline.Job(
        "one",
        ("file a.txt\nhello", "python\nprint(open('a.txt').read())", "python\nraise SystemExit(3)"),
    )
    assert baseline.make(tmp_path, [job], 7, tmp_path) == 1
    assert "FAILED: python" in capsys.readouterr().out
    assert "hello" in (tmp_path / "one/terminal/01-python.txt").read_text("utf-8")
    monkeypatch.setattr(baseline, "JOBS", (job,))
    assert baseline.main(["compare", str(tmp_path), str(tmp_path)]) == 0


def test_numbers_in_a_sentence_may_differ_by_rounding_and_its_words_may_not():
    before = ["f is 3.000000000000001 px"]
    for after, within in (
        ("f is 3.000000000000004 px", True),
        ("f is 3.1 px", False),
        ("g is 3.000000000000001 px", False),
    ):
        assert {counts for counts, _ in baseline.changed(before, [after], 1e-12)} == {not within}
        assert {counts for counts, _ in baseline.changed(before, [after])} == {True}


def test_lists_in_a_column_are_compared_number_by_number():
    column = np.array([np.array([1.0, 2.0]), None, np.array([3.0])], dtype=object)
    facts = baseline.Facts()
    facts.add("curve", column)
    np.testing.assert_array_equal(facts.arrays["curve"], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(facts.arrays["curve (lengths)"], [2, 0, 1])
