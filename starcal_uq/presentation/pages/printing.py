"""A page as PDF, by a browser that is installed or by WeasyPrint."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from starcal_uq.core.errors import MissingExtraError, RunFolderError

# By these names browsers that print without a window are found, the plainest first.
_NAMES = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "microsoft-edge-stable", "msedge", "brave-browser"),
)
_APPLICATIONS = ("Chromium", "Google Chrome", "Microsoft Edge", "Brave Browser")
_WINDOWS = (r"Google\Chrome\Application\chrome.exe", r"Microsoft\Edge\Application\msedge.exe")
_SECONDS = 180.0


def pdf_bytes(page: Path) -> bytes:
    """A page, one file that needs no other, as PDF.

    MissingExtraError if there is neither a browser nor WeasyPrint. RunFolderError if what there is
    makes no PDF of it.
    """
    said = ""
    for browser in browsers():
        made, said = _printed(browser, page)
        if made:
            return made
    try:
        weasyprint: Any = importlib.import_module("weasyprint")
    # A library that it needs may be missing.
    except (ImportError, OSError):
        if said:
            raise RunFolderError(
                f"{page}: {said}; open the page and print it from there."
            ) from None
        raise MissingExtraError(
            "a PDF takes a browser, and none was found: install Chromium, Chrome or Edge, or "
            "`pip install weasyprint`."
        ) from None
    made = weasyprint.HTML(filename=str(page)).write_pdf()
    return bytes(made)


def browsers() -> Iterator[str]:
    """Programs that are installed and can print a page."""
    yield from filter(None, map(shutil.which, _NAMES))
    if sys.platform == "darwin":
        places = [Path(f"/Applications/{name}.app/Contents/MacOS/{name}") for name in _APPLICATIONS]
    else:
        roots = [
            os.environ.get(name, "")
            for name in ("PROGRAMFILES", "PROGRAMFILES(X86)", "LOCALAPPDATA")
        ]
        places = [Path(root, name) for root in roots if root for name in _WINDOWS]
    yield from (str(place) for place in places if place.is_file())


def _printed(browser: str, page: Path) -> tuple[bytes, str]:
    """What a browser makes of a page, and what went wrong if that is nothing."""
    name = Path(browser).name
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        to = Path(folder, "page.pdf")
        # Nothing on the page asks for the network; nor should the browser itself.
        options = [
            "--headless",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
        ]
        options += [
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={folder}",
            "--no-pdf-header-footer",
            "--generate-pdf-document-outline",
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            # Root, as in a container, has no other way.
            options.append("--no-sandbox")
        command = [browser, *options, f"--print-to-pdf={to}", page.resolve().as_uri()]
        try:
            ended = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            return b"", f"{name} could not print it ({type(error).__name__})"
        made = to.read_bytes() if to.is_file() else b""
    return (
        (made, "")
        if made.startswith(b"%PDF")
        else (b"", f"{name} made no PDF (exit status {ended.returncode})")
    )
