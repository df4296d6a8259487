"""Tables in the documentation, between the markers ``<!-- word -->`` and ``<!-- /word -->`` of a
page.
"""

from __future__ import annotations

from pathlib import Path


def between(page: Path, word: str) -> str:
    """What stands between the markers."""
    return _parts(page, word)[1]


def put(page: Path, word: str, content: str) -> None:
    """Put `content` there, in place of what stood between them."""
    before, _, after = _parts(page, word)
    page.write_text(f"{before}\n\n{content}\n\n{after}", encoding="utf-8")


def _parts(page: Path, word: str) -> tuple[str, str, str]:
    """The page up to the end of the first marker, up to the second, and from there on."""
    first, last = f"<!-- {word} -->", f"<!-- /{word} -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(first)
    inside, end, after = rest.partition(last)
    if not found or not end:
        raise SystemExit(f"{page} has no markers {first} and {last}")
    return before + found, inside, end + after
