"""Data of one row, made once by the package's own simulation: a table for us, arrays of NumPy for
the rivals.

python benchmarks/contestants/data.py FOLDER FRAMES SEED

A million frames become a folder of partitions.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

import starcal_uq as sc

SIGMA_PX = 0.05
PARTITIONED = 1_000_000


def make(folder: Path, n_frames: int, seed: int) -> None:
    """The paper's sensor and start; the attitudes at the start are those of Kabsch's solution
    there.
    """
    start = sc.paper.paper_start()
    folder.mkdir(parents=True, exist_ok=True)
    if n_frames >= PARTITIONED:
        camera = folder / "truth.toml"
        sc.paper.paper_camera().save(camera)
        words = [
            "simulate",
            str(camera),
            "--out",
            str(folder / "frames"),
            "--force",
            "--seed",
            str(seed),
        ]
        words += ["--frames", str(n_frames), "--partition-frames", "10000"]
        subprocess.run(
            [sys.executable, "-c", "from starcal_uq.cli.app import main; main()", *words],
            check=True,
        )
        start.save(folder / "camera.toml")
        return
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    obs = sc.simulate(
        stars, sc.paper.paper_camera(), n_frames=n_frames, sigma_px=SIGMA_PX, seed=seed
    )
    b, r = sc.camera.unproject(start, obs.xy), obs.directions_icrs
    gram = np.add.reduceat(b[:, :, None] * r[:, None, :], obs.frame_starts[:-1], axis=0)
    left, _, right = np.linalg.svd(gram)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    obs.save(folder / "stars.parquet")
    np.savez(
        folder / "stars.npz",
        starts=obs.frame_starts,
        xy=obs.xy,
        r=r,
        start=start.theta,
        rotations=left @ right,
        size=[start.width_px, start.height_px],
    )
    # Last: what is there then is whole.
    start.save(folder / "camera.toml")


if __name__ == "__main__":
    make(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
