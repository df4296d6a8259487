"""Settings of short runs, and what is in a folder."""

from __future__ import annotations

SMALL = ["--walkers", "32", "--steps", "80"]


def files(folder):
    return {
        p.relative_to(folder): (p.read_bytes() if p.is_file() else None)
        for p in sorted(folder.rglob("*"))
    }
