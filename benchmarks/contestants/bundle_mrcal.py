"""mrcal's sparse bundle, by the system's Python (Debian: ``apt-get install python3-mrcal``).

The optics are LENSMODEL_OPENCV4: a second focal length and two tangential terms more than ours,
which its covariance holds at fx = fy and p1 = p2 = 0 afterwards. The stars are fixed points a
billion units away, and every frame is a camera of its own. mrcal leaves each camera a translation;
two points a unit away, where the camera at the start sees them, hold it with a weight of 1e-3: it
moves no star by 1e-6 px then. No outlier rejection, no regularisation.
"""

import mrcal
import numpy as np

FAR, WEIGHT = 1e9, 1e-3
ANCHORS = np.array([[0.05, 0.05, 1.0], [-0.05, -0.05, 1.0]])


def bundle(folder, covariance=True):
    """The estimate, with the covariance of the optics by its own sparse factor."""
    with np.load(folder / "stars.npz") as data:
        starts, xy, r, start = data["starts"], data["xy"], data["r"], data["start"]
        rotations, size = data["rotations"], data["size"]
    frames, stars = len(starts) - 1, len(xy)
    x0, y0, f = start[:3]
    poses = np.zeros((frames, 6))
    poses[:, :3] = mrcal.r_from_R(rotations)
    near = np.einsum("kji,aj->kai", rotations, ANCHORS).reshape(-1, 3)
    seen = np.ones((2 * frames + stars, 3))
    seen[: 2 * frames, :2] = np.tile(f * ANCHORS[:, :2] + [x0, y0], (frames, 1))
    seen[: 2 * frames, 2] = WEIGHT
    seen[2 * frames :, :2] = xy
    indices = np.zeros((len(seen), 3), dtype=np.int32)
    indices[:, 0] = np.arange(len(seen))
    indices[: 2 * frames, 2] = np.repeat(np.arange(frames), 2)
    indices[2 * frames :, 2] = np.repeat(np.arange(frames), np.diff(starts))
    fixed = {
        "frames_rt_toref": None,
        "observations_board": None,
        "indices_frame_camintrinsics_camextrinsics": None,
        "indices_point_camintrinsics_camextrinsics": indices,
        "lensmodel": "LENSMODEL_OPENCV4",
        "imagersizes": size.reshape(1, 2).astype(np.int32),
        "Npoints_fixed": len(seen),
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": False,
        "do_optimize_calobject_warp": False,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
        "point_min_range": 1e-3,
        "point_max_range": 1e3 * FAR,
        "verbose": False,
    }
    points = np.concatenate([near, FAR * r])
    dof = 2 * stars - 3 * frames - 8

    def run():
        problem = {
            "intrinsics": np.array([[f, f, x0, y0, 0.0, 0.0, 0.0, 0.0]]),
            "extrinsics_rt_fromref": poses.copy(),
            "points": points.copy(),
            "observations_point": seen.copy(),
            **fixed,
        }
        x = mrcal.optimize(**problem)["x"]
        optics = problem["intrinsics"][0]
        if not covariance:
            return {"raw": optics}
        packed, _, _, factor = mrcal.optimizer_callback(**problem)
        units = np.zeros((8, len(packed)))
        units[np.arange(8), np.arange(8)] = 1.0
        spread = factor.solve_xt_JtJ_bt(units)[:, :8] * (x @ x) / dof
        scales = np.ones_like(packed)
        mrcal.unpack_state(scales, **problem)
        spread *= np.outer(scales[:8], scales[:8])
        theta, within = held(optics, spread)
        return {"theta": theta, "covariance": within}

    return run


def held(optics, covariance):
    """x0, y0, f, k1, k2 in pixels with fx = fy and no tangential terms: what this covariance makes
    of that.
    """
    rows = np.zeros((3, 8))
    rows[0, 0], rows[0, 1], rows[1, 6], rows[2, 7] = 1.0, -1.0, 1.0, 1.0
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T)
    optics, covariance = optics - gain @ (rows @ optics), covariance - gain @ rows @ covariance
    f, k1, k2 = optics[0], optics[4], optics[5]
    by = np.zeros((5, 8))
    by[0, 2] = by[1, 3] = by[2, 0] = 1.0
    by[3, 0], by[3, 4] = -2.0 * k1 / f**3, f**-2
    by[4, 0], by[4, 5] = -4.0 * k2 / f**5, f**-4
    return np.array([optics[2], optics[3], f, k1 / f**2, k2 / f**4]), by @ covariance @ by.T
