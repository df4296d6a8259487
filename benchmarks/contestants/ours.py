"""What the package offers, by its public calls; the version before is timed by the same lines."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from worker import Missing

import starcal_uq as sc

Result = dict[str, Any]


def _data(folder: Path) -> tuple[Any, Any]:
    camera = sc.Camera.load(folder / "camera.toml")
    if (folder / "frames").is_dir():
        return sc.observations.open_partitions(folder / "frames"), camera
    return sc.load_observations(folder / "stars.parquet"), camera


def calibrate(folder: Path, **options: Any) -> Callable[[], Result]:
    """Estimate, covariance, compressed likelihood."""
    obs, camera = _data(folder)

    def run() -> Result:
        cal = sc.calibrate(obs, camera, **options)
        path = cal.provenance["kernels"]
        return {"theta": cal.theta, "covariance": cal.covariance, "sigma": cal.sigma, "path": path}

    return run


def three_stages(folder: Path) -> Callable[[], Result]:
    """The paper's method with its sandwich covariance."""
    obs, camera = _data(folder)

    def run() -> Result:
        cal = sc.calibrate(obs, camera, method="three_stage")
        return {"theta": cal.pair_theta, "covariance": cal.pair_covariance}

    return run


def sample(folder: Path, **options: Any) -> Callable[[], Result]:
    """Draws with all their checks."""
    obs, camera = _data(folder)
    cal = sc.calibrate(obs, camera)
    kept = Path(tempfile.mkdtemp(prefix="starcal-bench-"))
    seeds = iter(range(10_000))

    def run() -> Result:
        seed = next(seeds)
        post = sc.sample(obs, cal, seed=seed, **options)
        # (chains, draws, parameters)
        path = kept / f"{seed}.npy"
        np.save(path, post.draws.reshape(post.n_ensembles, -1, post.draws.shape[-1]))
        return {"draws": str(path), "evaluations": post.diagnostics.n_evaluations}

    return run


def propagate(folder: Path) -> Callable[[], Result]:
    """The attitude error that a calibration contributes."""
    obs, camera = _data(folder)
    post = sc.sample(obs, sc.calibrate(obs, camera), seed=0)

    def run() -> Result:
        sc.propagate(post, obs, seed=0)
        return {}

    return run


def diagnose(folder: Path) -> Callable[[], Result]:
    """Misfit, jackknife, predictive check, other starts, other models."""
    obs, camera = _data(folder)
    cal = sc.calibrate(obs, camera)
    post = sc.sample(obs, cal, seed=0)

    def run() -> Result:
        sc.diagnose(obs, cal, post)
        return {}

    return run


def study(folder: Path, *, definition: str) -> Callable[[], Result]:
    """All cells of a coupling study, on all processors."""
    if not hasattr(sc, "study"):
        raise Missing("this version has no `study`")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "study.toml"
    path.write_text(definition, encoding="utf-8")
    return lambda: {"cells": int(sc.study(path).data.sizes["cell"])}


def command(
    folder: Path, *, arguments: list[str], needs: str | None = None
) -> Callable[[], Result]:
    """A command of the package in a fresh process; ``{data}`` is the folder of the data, ``{out}``
    a new one.
    """
    if needs is not None and not Path(needs).exists():
        raise Missing(f"{needs} is not on this machine")
    # -P: else the package in the folder where the benchmark was started goes before the one that is
    # asked for.
    program = [sys.executable, "-P", "-m", "starcal_uq"]

    def run() -> Result:
        peak = 0.0
        with tempfile.TemporaryDirectory() as out, tempfile.TemporaryFile("w+") as said:
            words = [a.format(data=folder, out=Path(out) / "out") for a in arguments]
            process = subprocess.Popen([*program, *words], stdout=said, stderr=said)
            while process.poll() is None:
                peak = max(peak, _tree_mb(process.pid))
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.1)
            said.seek(0)
            text = said.read()
            # Status 1 is a verdict on the data, such as those of real frames.
            if process.returncode > 1 or "Traceback" in text:
                raise RuntimeError(f"{' '.join(words)}: {text.strip()[-300:]}")
        return {"peak_mb": peak} if peak > 0.0 else {}

    return run


def _tree_mb(root: int) -> float:
    """Memory of a process and all that descend from it, pages that they share counted once; 0 where
    Linux is not.
    """
    total, waiting = 0.0, [root]
    while waiting:
        pid = waiting.pop()
        try:
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
            total += (
                sum(float(line.split()[1]) for line in lines if line.startswith("Pss:")) * 1.024e-3
            )
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += [
                    int(child) for child in (task / "children").read_text(encoding="ascii").split()
                ]
        except OSError:
            # It has ended, or there is no such folder.
            continue
    return total


def imported(folder: Path, *, code: str) -> Callable[[], Result]:
    """A line of Python in a fresh process."""

    def run() -> Result:
        subprocess.run([sys.executable, "-P", "-c", code], check=True)
        return {}

    return run


def quest(folder: Path, *, frames: int, stars: int) -> Callable[[], Result]:
    """Attitudes of all frames in one call."""
    from attitudes import directions

    b, r = directions(frames, stars)
    starts = np.arange(frames + 1) * stars
    flat_b, flat_r = b.reshape(-1, 3), r.reshape(-1, 3)

    def run() -> Result:
        found = sc.attitude.quest(flat_b, flat_r, starts, covariance=False)
        return {"quaternions": found.quaternions[:1000]}

    return run


def project(folder: Path, *, points: int) -> Callable[[], Result]:
    """Directions to pixels."""
    from points import directions

    camera, b = sc.paper.paper_camera(), directions(points)
    return lambda: {"xy": sc.camera.project(camera, b)[:1000]}


def unproject(folder: Path, *, points: int) -> Callable[[], Result]:
    """Pixels to directions."""
    from points import pixels

    camera, xy = sc.paper.paper_camera(), pixels(points)
    return lambda: {"b": sc.camera.unproject(camera, xy)[:1000]}


def _loaded(images: str) -> list[Any]:
    """The images of a folder, in memory."""
    if not Path(images).is_dir():
        raise Missing(f"{images} is not on this machine")
    paths = [path for end in ("tif*", "png") for path in sorted(Path(images).glob(f"*.{end}"))]
    return [sc.images.read_image(path) for path in paths]


def centroids(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """Stars of images, each alone."""
    loaded = _loaded(images)

    def run() -> Result:
        found = [sc.images.extract_centroids(image) for image in loaded]
        return {"frames": len(loaded), "found": sum(len(f.x_px) for f in found)}

    return run


def _alone(tables: list[Any], camera: Any, stars: Any) -> Callable[[], list[Any]]:
    """Identification of tables of one frame, each by itself."""
    identify = sc.identification.identify
    return lambda: [identify(table, camera, stars, cache=False) for table in tables]


def identify_unknown(folder: Path, *, images: str, field: float) -> Callable[[], Result]:
    """Stars of images of a camera without a sheet, each frame alone, of fields of 0.5 to 90 degrees."""
    tables = [sc.images.extract_centroids(image) for image in _loaded(images)]
    identified = _alone(tables, None, sc.load_catalogue(max_mag=7.0, epoch=2019.6))

    def run() -> Result:
        fields = [done.camera.fov_deg[0] for done in identified() if done.n_identified]
        wrong = sum(abs(found / field - 1.0) > 0.02 for found in fields)
        return {"frames": len(tables), "found": len(fields), "wrong": wrong}

    return run


def identify(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """Stars of images with a sheet, each frame alone."""
    tables = [sc.images.extract_centroids(image) for image in _loaded(images)]
    stars = sc.load_catalogue(max_mag=7.0, epoch=2019.6)
    identified = _alone(tables, sc.Camera.load(camera), stars)
    return lambda: {
        "frames": len(tables),
        "found": sum(done.n_identified for done in identified()),
    }


def field(folder: Path, *, degrees: float, max_mag: float) -> Callable[[], Result]:
    """A simulated frame of a field, without a sheet, from its centroids."""
    stars = sc.load_catalogue(max_mag=max_mag, epoch=2026.0)
    focal = 1024 / (2.0 * np.tan(np.radians(degrees / 2.0)))
    camera = sc.Camera(1024, 1024, 10.0, None, 511.5, 511.5, focal_px=focal)
    truth = sc.simulate(stars, camera, n_frames=1, sigma_px=0.2, seed=4)
    mag = dict(zip(stars.star_id.tolist(), stars.mag.tolist(), strict=True))
    flux = 10.0 ** (-0.4 * np.array([mag[name] for name in truth.star_id.tolist()]))
    zero = np.zeros(len(flux))
    columns = {"var_x_px2": zero + 0.04, "var_y_px2": zero + 0.04, "cov_xy_px2": zero}
    columns |= {"flux": flux, "snr": zero + 50.0, "peak": flux}
    flags = dict.fromkeys(("saturated", "blended", "edge"), zero > 1.0)
    numbers = {name: [1.0] for name in ("background", "noise", "psf_sigma_px")}
    words = {name: [""] for name in ("image", "time_utc", "problem")}
    table = sc.images.Centroids(
        frame=zero.astype(int),
        x_px=truth.x_px,
        y_px=truth.y_px,
        frame_ids=[0],
        **columns,
        **flags,
        **numbers,
        **words,
        meta={"optics": {"width_px": 1024, "height_px": 1024}},
    )
    identified = _alone([table], None, stars)

    def run() -> Result:
        (done,) = identified()
        right = dict(zip(truth.x_px.tolist(), truth.star_id.tolist(), strict=True))
        named = zip(
            done.observations.x_px.tolist(), done.observations.star_id.tolist(), strict=True
        )
        wrong = any(right[x] != name for x, name in named)
        return {"frames": 1, "found": done.n_identified, "wrong": int(wrong)}

    return run


def frames(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """Images to attitudes, one by one."""
    loaded = _loaded(images)
    nominal, stars = sc.Camera.load(camera), sc.load_catalogue(max_mag=7.0, epoch=2019.6)

    def run() -> Result:
        done = []
        for image in loaded:
            clock = [time.process_time()]
            found = sc.images.extract_centroids(image)
            clock.append(time.process_time())
            result = sc.identification.identify(found, nominal, stars, cache=False)
            clock.append(time.process_time())
            middle, o = None, result.observations
            if (quaternion := result.frames[0].quaternion) is not None:
                centre = np.array([[0.5 * (nominal.width_px - 1), 0.5 * (nominal.height_px - 1)]])
                seen = sc.camera.unproject(result.camera, centre)[0]
                middle = Rotation.from_quat(quaternion).apply(seen, inverse=True).tolist()
            places = np.column_stack([found.x_px, found.y_px])
            named = np.column_stack([o.x_px, o.y_px, o.ra_deg, o.dec_deg])
            done.append(
                {
                    "clock": clock,
                    "middle": middle,
                    "points": places.tolist(),
                    "stars": named.tolist(),
                }
            )
        return {"frames": done}

    return run
