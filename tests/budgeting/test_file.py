"""The budget file: what it may say, and the sentence for what it may not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from starcal_uq.budgeting.file import load_budget_file
from starcal_uq.budgeting.rows import FROM_FILE
from starcal_uq.core.constants import AXES
from starcal_uq.core.errors import BudgetError

ROW = """
[[contributor]]
name = "star catalogue"
axis = "all"
sigma_arcsec = 0.2
provenance = "catalogue note"
"""
OWN = """
ecss_class = "other"
interpretation = "mixed"
absorbed_by_alignment = "no"
"""
LIMIT = """
[[requirement]]
name = "R-1"
axis = "cross-boresight"
limit_arcsec = 10.0
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "budget.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_contributor_takes_what_is_expected_of_it(tmp_path: Path) -> None:
    found = load_budget_file(written(tmp_path, ROW))
    assert [row.axis for row in found.contributors] == list(AXES)
    first = found.contributors[0]
    assert (first.ecss_class, first.interpretation) == ("FOV spatial", "mixed")
    assert first.sigma_arcsec == 0.2 and first.mean_arcsec == 0.0 and first.source == "file"


@pytest.mark.parametrize(
    ("lines", "sigma", "mean"),
    [
        ('distribution = "uniform"\nhalf_width_arcsec = 3.0', 3.0 / math.sqrt(3.0), 0.0),
        (
            'distribution = "arcsine"\nhalf_width_arcsec = 3.0\nmean_arcsec = -1',
            3.0 / math.sqrt(2.0),
            -1.0,
        ),
        ('distribution = "constant"\nmean_arcsec = 2.0', 0.0, 2.0),
        (
            'distribution = "rayleigh"\nsigma_arcsec = 1.0',
            1.0,
            math.sqrt(math.pi / (4.0 - math.pi)),
        ),
        ("applies = false", 0.0, 0.0),
    ],
)
def test_moments(tmp_path: Path, lines: str, sigma: float, mean: float) -> None:
    row = load_budget_file(
        written(tmp_path, ROW.replace("sigma_arcsec = 0.2", lines))
    ).contributors[0]
    assert row.sigma_arcsec == pytest.approx(sigma) and row.mean_arcsec == pytest.approx(mean)
    assert row.applies is ("applies" not in lines)
    combination = (
        "none" if "applies" in lines else "mean: linear" if "constant" in lines else "in squares"
    )
    assert row.combination == combination


@pytest.mark.parametrize("name", ["Star Catalogue", "STAR  catalogue"])
def test_names_of_the_starter_may_be_in_any_case(tmp_path: Path, name: str) -> None:
    row = load_budget_file(written(tmp_path, ROW.replace("star catalogue", name))).contributors[0]
    assert (row.name, row.ecss_class) == ("star catalogue", "FOV spatial")


@pytest.mark.parametrize("name", ["polishing residual", "star sensor cable", "launch lock"])
def test_a_name_of_ones_own_is_taken_with_what_it_states(tmp_path: Path, name: str) -> None:
    row = load_budget_file(
        written(tmp_path, ROW.replace("star catalogue", name) + OWN)
    ).contributors[0]
    assert (row.name, row.interpretation, row.distribution) == (name, "mixed", "gaussian")


def test_requirements_take_the_confidence_of_the_file(tmp_path: Path) -> None:
    text = (
        "[budget]\ntitle = 'T'\nconfidence = 0.95\n"
        + LIMIT
        + LIMIT.replace("R-1", "R-2")
        + "confidence = 0.5\n"
    )
    found = load_budget_file(written(tmp_path, text))
    assert (found.title, found.confidence) == ("T", 0.95)
    assert [asked.confidence for asked in found.requirements] == [0.95, 0.5]
    asked = found.requirements[0]
    assert (asked.scope, asked.interpretation, asked.judged_by) == (
        "after alignment",
        "mixed",
        "both",
    )


def test_a_byte_order_mark_is_no_error(tmp_path: Path) -> None:
    path = tmp_path / "budget.toml"
    path.write_bytes(b"\xef\xbb\xbf" + ROW.encode())
    assert len(load_budget_file(path).contributors) == 3


BAD = {
    "sigmas": (ROW.replace("sigma_arcsec", "sigma_arcsecs"), "did you mean sigma_arcsec"),
    "name blank": (ROW.replace('"star catalogue"', '" "'), "key name is ' '; write text in quotes"),
    "axis": (ROW.replace('"all"', '"w"'), "key axis is 'w'"),
    "no sigma": (ROW.replace("sigma_arcsec = 0.2", ""), "write either sigma_arcsec or"),
    "both": (ROW + "half_width_arcsec = 1.0\n", "are both given"),
    "half width of a gaussian": (ROW.replace("sigma_arc", "half_width_arc"), "a gaussian error"),
    "constant with sigma": (ROW + 'distribution = "constant"\n', "a constant has no spread"),
    "posterior's": (ROW.replace("star catalogue", "centroid noise (NEA)"), "filled by the"),
    "twice": (ROW + ROW, "star catalogue, axis pitch is stated twice"),
    "one bracket": (ROW.replace("[[contributor]]", "[contributor]"), "must be written with two"),
    "other table": (ROW + "[limits]\na = 1\n", "limits is not known"),
    "confidence": ("[budget]\nconfidence = 99.7\n", "write 0.997 for 99.7 %"),
    "confidence of a few per cent": ("[budget]\nconfidence = 1.5\n", "write 0.015 for 1.5 %"),
    "confidence of a hundred": ("[budget]\nconfidence = 100\n", "is 100.0, but a confidence lies"),
    "a turn and more": (ROW.replace("0.2", "1296000.1"), "write a number of arcsec from 0 to"),
    "frame twice named": ("[frame.sensor]\nrotation = [0, 0, 0, 1]\n", "give yours another name"),
    "frame with more": ("[frame.a]\nrotation = [0, 0, 0, 1]\nunit = 1\n", "unit"),
    "no list": ("requirement = 1\n", "must be written with two brackets, [[requirement]]"),
    "second row": (
        ROW + ROW.replace('"all"', '"w"').replace("star c", "noise of star c") + OWN,
        "[[contributor]] 2 ('noise of",
    ),
    "own like none": (ROW.replace("star catalogue", "xyz"), "[[contributor]] 1 ('xyz'): The"),
    "own that does not apply, but with a word for it": (
        ROW.replace("star catalogue", "xyz").replace("sigma_arcsec = 0.2", "applies = 1"),
        "write true or false",
    ),
    "limit": (LIMIT.replace("10.0", "0"), "write a positive number of arcsec"),
    "axis of a limit": (LIMIT.replace("cross-boresight", "all"), "key axis is 'all'"),
    "limits twice": (LIMIT + LIMIT, "requirement R-1 is stated twice"),
    "second limit": (LIMIT + LIMIT.replace("R-1", "R-2").replace("10.0", "0"), "[[requirement]] 2"),
    "mistyped": (ROW.replace("star catalogue", "star catalog"), "did you mean 'star catalogue'?"),
    "mistyped, everything stated": (
        ROW.replace("star catalogue", "star catalogues") + OWN,
        "did you mean",
    ),
    "posterior's, in capitals": (
        ROW.replace("star catalogue", "Centroid Noise (NEA)"),
        "filled by the posterior",
    ),
    "own without class": (ROW.replace("star catalogue", "polish"), "('polish'): The starter has"),
    "own like one": (
        ROW.replace("star catalogue", "star catalogue noise") + 'ecss_class = "other"\n',
        (
            "did you mean 'star catalogue'? The starter has no such name, and a contributor of "
            "your "
            "own must state interpr"
        ),
    ),
    "too large": (ROW.replace("0.2", "1e308"), "write a number of arcsec from 0 to 1296000, a"),
    "no table": ("contributor = [1]\n", "is no table"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_said_in_one_sentence_with_file_and_key(tmp_path: Path, case: str) -> None:
    text, sentence = BAD[case]
    path = written(tmp_path, text)
    with pytest.raises(BudgetError) as caught:
        load_budget_file(path)
    assert sentence in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value).strip() and str(caught.value).endswith((".", "?"))


def example(root: Path) -> str:
    """The full example of the how-to page."""
    page = (root / "docs" / "how-to" / "budget.md").read_text(encoding="utf-8")
    return page.split("```toml\n", 1)[1].split("```", 1)[0]


def test_the_documented_example_loads(root: Path, tmp_path: Path) -> None:
    found = load_budget_file(written(tmp_path, example(root)))
    assert len(found.requirements) == 3 and found.title.startswith("Star tracker")
    assert {row.name for row in found.contributors} - {entry.name for entry in FROM_FILE} == {
        "polishing residual"
    }
    expected = {entry.name: entry for entry in FROM_FILE}
    for row in found.contributors:
        if row.name in expected:
            assert row.ecss_class == expected[row.name].ecss_class


def test_the_documented_keys_are_all_there_are(root: Path) -> None:
    from starcal_uq.budgeting.file import CONTRIBUTOR_KEYS, REQUIREMENT_KEYS

    page = (root / "docs" / "how-to" / "budget.md").read_text(encoding="utf-8")
    for heading, keys in (
        ("Keys of a contributor", CONTRIBUTOR_KEYS),
        ("Keys of a requirement", REQUIREMENT_KEYS),
    ):
        table = page.split(f"## {heading}", 1)[1].split("##", 1)[0]
        listed = [line.split("`")[1] for line in table.splitlines() if line.startswith("| `")]
        assert sorted(listed) == sorted(keys)


def test_frames_are_rotations_that_requirements_name(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    text = (
        f"[frame.payload]\nrotation = [0.0, {half}, 0.0, {half}]\n" + LIMIT + 'frame = "payload"\n'
    )
    found = load_budget_file(written(tmp_path, text))
    # A quarter turn about Y: the payload's X is the sensor's Z.
    np.testing.assert_allclose(found.frames["payload"][0], [0.0, 0.0, 1.0], atol=1e-9)
    assert found.requirements[0].frame == "payload"
    # A quaternion of any length, and a matrix that was rounded to six digits.
    for rotation in (
        "[0, 3, 0, 3]",
        "[0, 9e5, 0, 9e5]",
        "[[1, 0, 0], [0, 1.000004, 0], [0, 0, 1]]",
        "[[1, 0, 0], [0, 0.999996, 0], [0, 0, 1]]",
    ):
        again = load_budget_file(
            written(tmp_path, f"[frame.payload]\nrotation = {rotation}\n")
        ).frames["payload"]
        np.testing.assert_allclose(again @ again.T, np.eye(3), atol=1e-5)
    for rotation, words in (
        ("[[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "mirrors"),
        ("[[1, 0, 0], [0, 1.0000075, 0], [0, 0, 1]]", "is no rotation"),
        ('"north"', "is no rotation"),
        ("[0, 1.1e6, 0, 1.1e6]", "is no rotation"),
        ("[0, 0, 0, 0]", "is no rotation"),
        ("[[1, 0], [0, 1]]", "is no rotation"),
        ("[]", "is no rotation"),
        ("[nan, 0, 0, 1]", "is no rotation"),
    ):
        with pytest.raises(BudgetError, match=words):
            load_budget_file(written(tmp_path, f"[frame.payload]\nrotation = {rotation}\n"))
    with pytest.raises(BudgetError, match="no table of the file describes"):
        load_budget_file(written(tmp_path, LIMIT + 'frame = "payload"\n'))
    with pytest.raises(BudgetError, match="needs a name"):
        load_budget_file(written(tmp_path, "[frame]\nrotation = 1\n"))
