"""The command `study`: a template, a folder that goes on, errors in one sentence."""

from __future__ import annotations

from pathlib import Path

STUDY = """\
[study]
target_arcsec = 0.05
[camera]
width_px = 1024
height_px = 1024
pixel_um = 12.0
focal_mm = 70.2
x0_px = 511.5
y0_px = 511.5
[sweep]
frames = [50, 200]
"""


def test_a_study_from_its_file_to_its_page_and_on(
    painting_cli, tmp_path: Path, monkeypatch
) -> None:
    # Figures have tests of their own.
    monkeypatch.setattr("starcal_uq.presentation.pages.studies.study_figures", lambda _study: {})
    (tmp_path / "my.toml").write_text(STUDY, "utf-8")
    found = painting_cli.document("study my.toml -o out --workers 0")["study"]
    assert (found["n_cells"], found["n_ok"], found["problems"]) == (2, 2, {})
    assert found["complete"]
    assert found["answer"] and found["advice"]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {"cells", "study.nc", "study.parquet", "study.toml"}
    assert (tmp_path / "out" / "study.toml").read_text("utf-8") == STUDY
    assert Path(found["page"]).name == "report.html"


def test_cells_without_numbers_alone_are_status_1(painting_cli, tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text(STUDY + "fov_deg = [0.5]\n", "utf-8")
    _, said = painting_cli.ok("study my.toml -o out", among=(1,))
    assert "2 of 2 cells: only 0 of" in said


def test_templates_and_errors(painting_cli, tmp_path: Path) -> None:
    painting_cli.ok("new study --template frames-stars")
    painting_cli.refuses("", "new camera --template frames-stars")
    (tmp_path / "study.toml").rename(tmp_path / "new.toml")
    (tmp_path / "bad.toml").write_text(STUDY.replace("frames", "frame"), "utf-8")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    for words, sentence in (
        ("", "STUDY 'study.toml': does not exist; check the path, or starcal-uq new study"),
        ("bad.toml", "bad.toml, section [sweep]: key frame is unknown; did you mean frames?"),
        ("new.toml -o other", "other: the folder exists and is not empty"),
    ):
        assert len(painting_cli.refuses(sentence, f"study {words}").splitlines()) == 1
    assert list((tmp_path / "other").iterdir()) == [tmp_path / "other" / "thesis.tex"]
