"""Whether a rival gives the same answer as the package, and how far off it is, in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

# Of ESA's frames.
MIDDLE_PX = (511.5, 383.5)


@dataclass(frozen=True)
class Agreement:
    """How far a rival's answer is from ours, in words, and whether they are the same for all that
    matters; in words what `ours` is, where each answer is described for itself.
    """

    words: str
    same: bool
    ours: str = ""


Same = Callable[[Mapping[str, Any], Mapping[str, Any]], Agreement]


def same_estimate(limit: float = 0.03) -> Same:
    """Largest difference of the optics in our standard deviations, and of the deviations where both
    have them.
    """

    def compare(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        if "theta" not in rival:
            return Agreement("–", True)
        sigma = np.sqrt(np.diag(ours["covariance"]))
        off = float(np.max(np.abs(np.array(rival["theta"]) - ours["theta"]) / sigma))
        words, same = f"{off:.2g} σ", off < limit
        if "covariance" in rival:
            ratios = np.sqrt(np.diag(rival["covariance"])) / sigma
            words += f", σ to {100.0 * np.max(np.abs(ratios - 1.0)):.1g} %"
            same = same and bool(np.all(np.abs(ratios - 1.0) < 0.02))
        return Agreement(words + (f"; {rival['said']}" if "said" in rival else ""), same)

    return compare


def same_draws(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
    """Means and spreads of two sets of draws, beside their Monte Carlo errors."""
    mine, theirs = ours["moments"], rival["moments"]
    (m, s, n), (m2, s2, n2) = (tuple(np.array(moment) for moment in x) for x in (mine, theirs))
    means, spreads = np.abs(m2 - m) / s, np.abs(s2 / s - 1.0)
    noise = np.sqrt(1.0 / n + 1.0 / n2)
    same = bool(np.all(means < 4.0 * noise + 0.03) and np.all(spreads < 4.0 * noise + 0.02))
    return Agreement(f"means {np.max(means):.2f} σ, spreads {100.0 * np.max(spreads):.0f} %", same)


def same_attitudes(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
    """Largest angle between the attitudes, arc seconds."""
    a, b = np.array(ours["quaternions"]), np.array(rival["quaternions"])
    few = min(len(a), len(b))
    a, b = a[:few], b[:few]
    b = b * np.sign(np.sum(a * b, axis=1, keepdims=True))
    angle = float(np.max(2.0 * np.linalg.norm(a - b, axis=1)) * 206264.8)
    return Agreement(f"{angle:.1g} arcsec", angle < 1e-3)


def same_arrays(key: str, scale: float, unit: str, limit: float) -> Same:
    """Largest difference of two arrays."""

    def compare(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        off = float(np.max(np.abs(np.array(ours[key]) - np.array(rival[key])))) * scale
        return Agreement(f"{off:.1g} {unit}", off < limit)

    return compare


def same_frames(table: Path) -> Same:
    """Frames found and wrong, stars named rightly, scatter of the centroids, median and worst times
    of both steps.

    A frame is wrong whose middle is more than 0.05 degrees from where the stars of a table have it,
    or of whose stars more than one in twenty is (`judged_frames`). Times are of the processor.
    Scatter is of the stars that both measured, of those of the table, about a cubic polynomial of
    the places in each frame, which takes up attitude, lens and which pixel counts first.
    """

    def words(result: Mapping[str, Any], *rest: str) -> str:
        frames = result["frames"]
        found = judged_frames(table, frames)
        wrong = sum(apart_deg > 0.05 or right < 0.95 * n for apart_deg, right, n in found)
        n_right, n_stars = (
            sum(column) for column in list(zip(*found, strict=True))[1:] or ([], [])
        )
        steps = 1e3 * np.diff([f["clock"] for f in frames], axis=1)
        (c, i), (slow_c, slow_i) = np.median(steps, axis=0), np.max(steps, axis=0)
        return "<br>".join(
            (
                f"{len(found) - wrong} of {len(frames)} frames, {wrong} wrong (farthest "
                f"{max(f[0] for f in found):.3f}°)",
                f"{n_right} of {n_stars} stars right",
                f"centroids {c:.1f} ms (worst {slow_c:.1f})",
                f"identification {i:.1f} ms (worst {slow_i:.1f})",
                *rest,
            )
        )

    def compare(ours: Mapping[str, Any], rival: Mapping[str, Any]) -> Agreement:
        rms = scatter(table, [[f["points"] for f in result["frames"]] for result in (ours, rival)])
        return Agreement(
            words(rival, f"scatter {rms[1]:.3f} px, of the same stars ours {rms[0]:.3f}"),
            True,
            words(ours),
        )

    return compare


# Farther from its place than this a star is another one, px; catalogues of other epochs differ by a
# tenth of it.
_OTHER_STAR_PX = 3.0


def judged_frames(table: Path, frames: Sequence[Mapping[str, Any]]) -> list[tuple[float, int, int]]:
    """Of each frame found: how far its middle is off, degrees, and how many of its stars are right,
    of how many.

    What is right follows from the places and catalogue directions of the table's own stars, by a
    cubic polynomial.
    """
    stars = np.genfromtxt(
        table, delimiter=",", names=True, usecols=range(10), dtype=None, encoding="utf-8"
    )

    def terms(xy: Any) -> Any:
        u, v = (np.asarray(xy, dtype=float) - MIDDLE_PX).T / 500.0
        return np.column_stack([u**i * v**j for i in range(4) for j in range(4 - i)])

    found = []
    for k, frame in enumerate(frames):
        if frame["middle"] is None:
            continue
        own = stars[stars["frame"] == k]
        r, xy = (
            directions(own["ra_deg"], own["dec_deg"]),
            np.column_stack([own["x_px"], own["y_px"]]),
        )
        axes = np.linalg.svd(r)[2]
        axes[0] *= np.sign(np.mean(r @ axes[0]))
        plane = np.linalg.lstsq(terms(xy), (r @ axes[1:].T) / (r @ axes[0])[:, None], rcond=None)[0]
        pixel = np.linalg.norm(plane[[1, 4]]) / np.sqrt(2.0) / 500.0

        def off(theirs: Any, places: Any, axes: Any = axes, plane: Any = plane) -> Any:
            """Distance of directions from where the places are."""
            here = axes[0] + terms(places) @ plane @ axes[1:]
            return np.linalg.norm(theirs - here / np.linalg.norm(here, axis=1)[:, None], axis=1)

        named = np.reshape(frame["stars"], (-1, 4))
        right = off(directions(named[:, 2], named[:, 3]), named[:, :2]) < _OTHER_STAR_PX * pixel
        apart = off(np.reshape(frame["middle"], (1, 3)), [MIDDLE_PX])
        found.append((float(np.degrees(apart[0])), int(right.sum()), len(named)))
    return found


def directions(ra_deg: Any, dec_deg: Any) -> Any:
    """Unit vectors (n, 3)."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def scatter(table: Path, measured: Sequence[Sequence[Any]]) -> list[float]:
    """Scatter per axis, px, of each list of places by frame (n, 2), of the stars that all lists
    have.
    """
    from scipy.spatial import cKDTree

    stars = np.genfromtxt(
        table, delimiter=",", names=True, usecols=range(10), dtype=None, encoding="utf-8"
    )
    left: list[list[Any]] = [[] for _ in measured]
    for k in np.unique(stars["frame"]):
        own = stars[stars["frame"] == k]
        near = [
            cKDTree(places[k]).query(np.column_stack([own["x_px"], own["y_px"]]))
            for places in measured
        ]
        all_have = np.all([distance < 2.0 for distance, _ in near], axis=0)
        r = directions(own["ra_apparent_deg"], own["dec_apparent_deg"])
        axes = np.linalg.svd(r)[2]
        x, y = (r @ axes[1:].T / (r @ axes[0])[:, None]).T * 10.0
        terms = np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])[all_have]
        rest = []
        for (_, index), places in zip(near, measured, strict=True):
            at = np.asarray(places[k])[index[all_have]]
            rest.append(at - terms @ np.linalg.lstsq(terms, at, rcond=None)[0])
        factor = np.sqrt(len(terms) / (len(terms) - terms.shape[1]))
        for parts, e in zip(left, rest, strict=True):
            parts.append(e * factor)
    return [float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for parts in left]


def counted(words: str) -> Same:
    """Each program's own count: no two find the same."""
    return lambda ours, rival: Agreement(
        f"{rival['found']} {words}", True, f"{ours['found']} {words}"
    )
