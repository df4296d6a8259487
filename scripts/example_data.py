"""Measure the example data again: the stars of the frames that ESA published with tetra3.

    python scripts/example_data.py esa-tetra3/ [stars.ecsv]

`esa-tetra3/` holds the eight TIFF files of github.com/esa/tetra3 (examples/data). Written is what
the package holds.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import starcal_uq as sc
from starcal_uq.pipeline import examples
from starcal_uq.pipeline.images import observations_from_images

FOLDER = Path(examples.__file__).parent / "data" / "esa"
# Decimals: 0.1 of a thousandth of a pixel, 0.4 of a thousandth of an arcsecond.
DECIMALS = {"x_px": 4, "y_px": 4, "ra_deg": 7, "dec_deg": 7, "sigma_px": 6, "mag": 3}


def measure(images: Path) -> sc.Observations:
    """Every star that is found and identified, none left out, its noise that of the pixels
    alone.
    """
    camera, site = sc.Camera.load(FOLDER / "camera.toml"), sc.sky.Site.load(FOLDER / "site.toml")
    _, _, found = observations_from_images([images], camera, site=site)
    obs = found.identification.observations
    columns = {name: np.round(getattr(obs, name), decimals) for name, decimals in DECIMALS.items()}
    kept = {name: obs.meta[name] for name in ("directions", "epoch", "max_mag", "source")}
    notice = {
        "attribution": "measured in images by the European Space Agency (github.com/esa/tetra3)",
        "licence": "CC BY-SA 3.0 IGO",
        "measured_by": "scripts/example_data.py",
    }
    return replace(obs, **columns, meta=kept | notice)


if __name__ == "__main__":
    measure(Path(sys.argv[1])).save(
        sys.argv[2] if sys.argv[2:] else FOLDER / "stars.ecsv", force=True
    )
