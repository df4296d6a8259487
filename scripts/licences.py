"""Licences of what the package brings along, from the packages' own metadata.

    licences.py PYTHON ...     the table of docs/reference/licences.md, from these environments
    together

Listed is what `pip install starcal-uq` installs, directly or not, and what its extras for users
add.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "licences.md"
EXTRAS = ("asdf", "cluster", "compiled", "excel", "images", "notebook", "raw", "tetra3rs")
HEAD = """# Licences

`starcal_uq` is under the MIT licence, except one table: the example data (`stars.ecsv`) were measured in images by the
European Space Agency and are under CC BY-SA 3.0 IGO (`starcal_uq/pipeline/data/esa/NOTICE`).

The table (made by `make supply`) lists all direct and indirect dependencies in any supported version of Python, extras
included, by the licences in their metadata. We distribute none of them. You can replace those under the LGPL.

| Licence | Packages |
|---|---|
"""


def licence(package: Distribution) -> str:
    """What a package says of itself: expression, classifiers, the first line of its text or the
    text.
    """
    said = [
        line.rpartition(" :: ")[2]
        for line in package.metadata.get_all("Classifier", [])
        if "License ::" in line
    ]
    names = ", ".join(name for name in said if name != "OSI Approved")
    text = (package.metadata.get("License") or "").strip().partition("\n")[0]
    return (
        package.metadata.get("License-Expression")
        or names
        or text
        or by_text(package)
        or "not stated"
    )


def by_text(package: Distribution) -> str:
    """Of a package whose metadata have the text alone: the BSD licence of three clauses, known by
    its last one.
    """
    files = [
        file.read_text()
        for file in package.files or ()
        if file.name in package.metadata.get_all("License-File", [])
    ]
    known = any(
        "Redistributions in binary form" in text and "Neither the name" in text for text in files
    )
    return "BSD-3-Clause" if known else ""


def licences() -> dict[str, str]:
    """Licence by package, for all that this environment has because of the package."""
    found: dict[str, str] = {}
    wanted = {("starcal-uq", extra) for extra in ("", *EXTRAS)}
    seen: set[tuple[str, str]] = set()
    while wanted:
        seen.add(at := wanted.pop())
        try:
            package = distribution(at[0])
        except PackageNotFoundError:  # for another system or version of Python
            continue
        if at[0] != "starcal-uq":
            found[at[0]] = licence(package)
        for line in package.requires or ():
            needed = Requirement(line)
            if needed.marker is None or needed.marker.evaluate({"extra": at[1]}):
                wanted |= {
                    (canonicalize_name(needed.name), extra) for extra in ("", *needed.extras)
                } - seen
    return found


def main() -> None:
    if len(sys.argv) == 1:
        print(json.dumps(licences()))
        return
    table: dict[str, str] = {}
    pins = PAGE.parents[2].joinpath("constraints.txt").read_text("utf-8")
    pinned = {
        canonicalize_name(line.partition("==")[0]) for line in pins.splitlines() if "==" in line
    }
    for python in sys.argv[1:]:
        made = subprocess.run([python, __file__], capture_output=True, text=True, check=True).stdout
        table |= json.loads(made)
    if unpinned := sorted(set(table) - pinned):
        raise SystemExit(f"constraints.txt does not pin {', '.join(unpinned)}")
    packages = {
        kind: [name for name in sorted(table) if table[name] == kind] for kind in table.values()
    }
    PAGE.write_text(
        HEAD + "".join(f"| {kind} | {', '.join(packages[kind])} |\n" for kind in sorted(packages)),
        "utf-8",
    )


if __name__ == "__main__":
    main()
