"""Sections of TOML files: what is taken, and what is said of the rest."""

from pathlib import Path
from typing import Any

import pytest

from starcal_uq.core.errors import SiteError
from starcal_uq.core.toml import Key, Section, read_section, write_section

SECTION = Section(
    {
        "width": Key(int, "the width, a whole number above 0", required=True, gt=0),
        "height": Key(float, "the height, from 0 to 9", ge=0.0, le=9.0),
        "centre": Key(list[float], "two numbers", min_length=2, max_length=2),
        "name": Key(str, "a name in quotes"),
    },
    SiteError,
)


def test_a_section_is_written_and_read_without_loss(tmp_path: Path) -> None:
    table = {"width": 3, "height": 0.1 + 0.2, "name": "ä"}
    write_section(tmp_path / "a.toml", "site", table, "# A comment.\n\n", force=False)
    assert SECTION.check(read_section(tmp_path / "a.toml", "site", SiteError), "here") == table
    # Whole numbers stand for floats; what is not given is left to the caller.
    assert SECTION.check({"width": 3, "height": 2, "centre": [1, 2.5]}, "here")["height"] == 2.0
    assert SECTION.check({"width": 3}, "here") == {"width": 3}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "key width is missing; add the width, a whole number above 0."),
        ({"width": 0}, "key width is 0; write the width, a whole number above 0."),
        ({"width": 2.0}, "key width is 2.0; write the width"),
        ({"width": True}, "key width is True; write the width"),
        ({"width": 1, "height": "2"}, "key height is '2'; write the height, from 0 to 9."),
        ({"width": 1, "height": False}, "key height is False; write the height"),
        ({"width": 1, "height": float("nan")}, "key height is nan; write the height"),
        ({"width": 1, "height": float("inf")}, "key height is inf; write the height"),
        ({"width": 1, "centre": [1.0]}, "key centre is [1.0]; write two numbers."),
        ({"width": 1, "centre": [1.0, "x"]}, "key centre is [1.0, 'x']; write two numbers."),
        ({"width": 1, "name": 3}, "key name is 3; write a name in quotes."),
        ({"width": 1, "hight": 2.0}, "key hight is unknown; did you mean height?"),
        ({"width": 1, "colour": 2.0}, "key colour is unknown; remove it"),
        ({"colour": 2.0, "hight": 1.0}, "(2 more bad keys)."),
    ],
)
def test_a_wrong_key_is_named_with_its_remedy(table: dict[str, Any], words: str) -> None:
    with pytest.raises(SiteError) as caught:
        SECTION.check(table, "a.toml, section [site]")
    assert str(caught.value).startswith("a.toml, section [site]: key ")
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the site file is empty: section [site] is missing; write [site] above its keys."),
        ("[sight]\n", "section [site] is missing, and [sight] is there; give another file, or"),
        ("site = 3\n", "site is no section; write [site] above its keys."),
        ("x = 1\n[site]\n", "x stands outside section [site]; remove it or move it below [site]."),
        ("[site\n", "the site file is not valid TOML"),
        ("[site]\nx = " + 5000 * "1", "the site file holds a number with too many digits; correct"),
    ],
)
def test_a_wrong_file_is_named_with_its_remedy(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SiteError) as caught:
        read_section(path, "site", SiteError)
    assert str(caught.value).startswith(f"{path}: ") and words in str(caught.value)
    assert ("x stands" in words) is (
        text.startswith("x") and read_section(path, "site", SiteError, alone=False) == {}
    )
