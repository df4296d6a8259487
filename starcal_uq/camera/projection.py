"""The camera model: one symbolic formula, and the vectorised kernels generated from it.

A direction ``b`` in the camera frame falls on an ideal point relative to the principal point, of a
pinhole ``(u, v) = f (b_x, b_y) / b_z`` (`starcal_uq.camera.planes`); a distortion model of the
registry moves it (``forward``) or moves the point behind the lens back (``inverse``). The axes of
the detector stretch that point, where they are free. The direction in which a model is not explicit
is found by Newton's method, and its derivatives by taking further Newton steps symbolically from the
root: one step carries exact first derivatives, two carry exact second derivatives.

Arrays inside have the star axis last (structure of arrays), the layout in which sums over stars are
matrix products.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.kernels import Kernel, build_kernel
from starcal_uq.camera.planes import PINHOLE
from starcal_uq.core.errors import DistortionError
from starcal_uq.core.types import BoolArray, FloatArray, IntArray, floats

_NEWTON_STEPS = 60
# After a last step of this size the error is its square times what the distortion bends per px,
# below rounding; the kernels take one more Newton step from the root, which squares it again.
_NEWTON_TOLERANCE_PX = 1e-5
# Of a radius, until a fold is told to a millionth of it.
_HALVINGS = 20


@dataclass(frozen=True)
class Symbols:
    """Symbols shared by the expressions of one model."""

    theta: Any
    b: Any
    phi: Any
    pixel: Any
    root: Any


def _symbols(model_name: str) -> Symbols:
    import casadi as ca

    n_parameters = 3 + len(get_model(model_name).coefficients)
    return Symbols(
        *(ca.SX.sym(n, k) for n, k in zip("tbpxr", (n_parameters, 3, 3, 2, 2), strict=True))
    )


def _displaced(model_name: str, point: Any, theta: Any) -> Any:
    import casadi as ca

    model = get_model(model_name)
    k = [theta[3 + j] for j in range(len(model.lens))]
    du, dv = model.displacement(point[0], point[1], k)
    return ca.vertcat(point[0] + du, point[1] + dv)


def _elements(symbols: Any) -> list[Any]:
    return [symbols[i] for i in range(symbols.numel())]


def _behind_lens(model_name: str, offset: Any, theta: Any) -> Any:
    """Point (casadi.SX, 2) behind the lens, before the detector's axes stretch it, of an offset
    on the detector.
    """
    import casadi as ca

    model = get_model(model_name)
    return ca.vertcat(*model.unstretched(offset[0], offset[1], _elements(theta)))


def _newton_step(model_name: str, point: Any, target: Any, theta: Any) -> tuple[Any, Any]:
    """One symbolic Newton step for ``displaced(point) = target``; also the Jacobian determinant."""
    import casadi as ca

    free = ca.SX.sym("q", 2)
    displaced = _displaced(model_name, free, theta)
    jacobian = ca.substitute(ca.jacobian(displaced, free), free, point)
    residual = ca.substitute(displaced, free, point) - target
    a, b, c, d = jacobian[0, 0], jacobian[0, 1], jacobian[1, 0], jacobian[1, 1]
    determinant = a * d - b * c
    step = (
        ca.vertcat(d * residual[0] - b * residual[1], a * residual[1] - c * residual[0])
        / determinant
    )
    return point - step, determinant


def _rotated(b: Any, phi: Any) -> Any:
    """``exp([phi]x) b`` to second order, which is exact for derivatives of up to second order at
    phi = 0.
    """
    import casadi as ca

    first = ca.cross(phi, b)
    return b + first + 0.5 * ca.cross(phi, first)


def _ideal(model_name: str, b: Any, theta: Any) -> Any:
    """Ideal point of a direction (casadi.SX, 2)."""
    import casadi as ca

    return ca.vertcat(*get_model(model_name).plane.onto(_elements(b), theta[2]))


def _pixel(model_name: str, s: Symbols, ideal: Any, newton_steps: int) -> Any:
    """Pixel position of an ideal point (casadi.SX, 2)."""
    import casadi as ca

    model = get_model(model_name)
    if model.direction == "forward":
        point = _displaced(model_name, ideal, s.theta)
    else:
        point = s.root
        for _ in range(newton_steps):
            point, _ = _newton_step(model_name, point, ideal, s.theta)
    return s.theta[:2] + ca.vertcat(*model.stretched(point[0], point[1], _elements(s.theta)))


def _forward_columns(model_name: str, s: Symbols, newton_steps: int) -> tuple[Any, Any, Any]:
    """Pixel position of the direction b (casadi.SX, 2), and its derivatives by theta (2, p) and by
    phi (2, 3) at zero.

    They go through the ideal point, whose two coordinates take fewer derivatives than all of theta
    and phi.
    """
    import casadi as ca

    ideal, point = _ideal(model_name, s.b, s.theta), ca.SX.sym("q", 2)
    xy = _pixel(model_name, s, point, newton_steps)
    columns = [xy, ca.jacobian(xy, s.theta), ca.jacobian(xy, point)]
    xy, by_theta, by_point = ca.substitute(columns, [point], [ideal])
    # A turn phi moves b by phi x b.
    turned = ca.mtimes(ca.jacobian(ideal, s.b), -ca.skew(s.b))
    by_theta += ca.mtimes(by_point, ca.jacobian(ideal, s.theta))
    return xy, by_theta, ca.mtimes(by_point, turned)


def forward_expression(model_name: str, s: Symbols, newton_steps: int) -> Any:
    """Pixel position of the direction ``exp([phi]x) b`` (casadi.SX, 2)."""
    turned = _ideal(model_name, _rotated(s.b, s.phi), s.theta)
    return _pixel(model_name, s, turned, newton_steps)


def backward_expression(model_name: str, s: Symbols, newton_steps: int) -> Any:
    """Unit vector in the camera frame of a measured pixel position (casadi.SX, 3)."""
    import casadi as ca

    offset = _behind_lens(model_name, s.pixel - s.theta[:2], s.theta)
    if get_model(model_name).direction == "forward":
        point = s.root
        for _ in range(newton_steps):
            point, _ = _newton_step(model_name, point, offset, s.theta)
    else:
        point = _displaced(model_name, offset, s.theta)
    plane = get_model(model_name).plane
    direction = ca.vertcat(*plane.back(point[0], point[1], s.theta[2]))
    return direction / ca.sqrt(ca.sumsqr(direction))


def second_index(n: int) -> tuple[IntArray, IntArray]:
    """Row and column of every unique second derivative of n variables, in kernel order."""
    rows, columns = np.triu_indices(n)
    return rows.astype(np.int64), columns.astype(np.int64)


@lru_cache(maxsize=32)
def bent_index(model_name: str) -> tuple[IntArray, IntArray]:
    """Rows and columns (row <= column) of the second derivatives over (theta, phi) that are not
    zero everywhere.
    """
    import casadi as ca

    s = _symbols(model_name)
    variables = ca.vertcat(s.theta, s.phi)
    xy = forward_expression(model_name, s, newton_steps=2)
    patterns = [ca.hessian(xy[axis], variables)[0].sparsity() for axis in range(2)]
    n = variables.numel()
    there = [
        (i, j)
        for i in range(n)
        for j in range(i, n)
        if any(pattern.has_nz(i, j) for pattern in patterns)
    ]
    rows, columns = np.array(there, dtype=np.int64).T
    return rows, columns


def _second_derivatives(value: Any, variables: Any, index: tuple[IntArray, IntArray]) -> Any:
    """Second derivatives (casadi.SX) of an index, of all axes of a value one after the other."""
    import casadi as ca

    hessians = [ca.hessian(axis, variables)[0] for axis in _elements(value)]
    return ca.vertcat(
        *(own[int(i), int(j)] for i, j in zip(*index, strict=True) for own in hessians)
    )


@lru_cache(maxsize=64)
def forward_kernel(model_name: str, order: str) -> Kernel:
    """Kernel of the forward model at phi = 0.

    `order` is "value" (2,); "attitude", also d/dphi (3, 2); "first", also d/dtheta (p, 2) before
    it; "bent", also the second derivatives over (theta, phi) of `bent_index`, (n, 2).
    """
    import casadi as ca

    s = _symbols(model_name)
    p = s.theta.numel()
    bent = order == "bent"
    xy, by_theta, by_phi = _forward_columns(model_name, s, newton_steps=2 if bent else 1)
    outputs: list[Any] = [xy]
    shapes: list[tuple[int, ...]] = [(2,)]
    if order == "first" or bent:
        # casadi.vec is column-major, so the Jacobian (2, p) becomes rows of (p, 2).
        outputs.append(by_theta)
        shapes.append((p, 2))
    if order != "value":
        outputs.append(by_phi)
        shapes.append((3, 2))
    if bent:
        index = bent_index(model_name)
        xy = forward_expression(model_name, s, newton_steps=2)
        outputs.append(_second_derivatives(xy, ca.vertcat(s.theta, s.phi), index))
        shapes.append((len(index[0]), 2))
    outputs = [ca.substitute(ca.densify(output), s.phi, ca.SX.zeros(3)) for output in outputs]
    return build_kernel(f"forward_{model_name}_{order}", [s.theta, s.b, s.root], outputs, shapes)


@lru_cache(maxsize=32)
def slope_kernel(model_name: str, alike: bool) -> Kernel:
    """Kernel of what a star adds to the slope of ``(e^T W e + log |A^T W A|) / 2`` over (theta, phi),
    (p + 3,), at phi = 0.

    e is its residual and A the derivatives of its frame's pixels by phi. The inputs end with the
    measured pixel, W (4,), which is the unit matrix where the axes are `alike`, and the inverse of
    ``A^T W A`` (9,).
    """
    import casadi as ca

    s, inverse = _symbols(model_name), ca.SX.sym("m", 3, 3)
    axes = ca.SX.sym("w", 2, 2)
    weight = ca.SX.eye(2) if alike else axes
    xy, _, by_phi = _forward_columns(model_name, s, newton_steps=2)
    columns = ca.horzcat(xy - s.pixel, by_phi)
    # The slope of a log determinant is that of a trace with the inverse held. What a column is
    # multiplied by is half the slope of the trace by it, because W and the inverse are symmetric.
    held = weight @ columns @ ca.diagcat(1, inverse)
    slope = ca.jtimes(ca.vec(columns), ca.vertcat(s.theta, s.b), ca.vec(held), True)
    # By turns of a turned direction; from here, half a turn of the columns is less.
    turn = ca.cross(s.b, slope[-3:]) - ca.inv_skew(held[:, 1:].T @ by_phi)
    slope = ca.vertcat(slope[:-3], turn)
    inputs = [s.theta, s.b, s.root, s.pixel, ca.vec(axes), ca.vec(inverse)]
    return build_kernel(f"slope_{model_name}", inputs, [slope], [(slope.numel(),)])


@lru_cache(maxsize=32)
def backward_kernel(model_name: str, derivatives: bool) -> Kernel:
    """Kernel from pixels to unit vectors: value (3,), with `derivatives` also d/dtheta (p, 3)."""
    import casadi as ca

    s = _symbols(model_name)
    direction = backward_expression(model_name, s, newton_steps=1)
    outputs: list[Any] = [direction]
    shapes: list[tuple[int, ...]] = [(3,)]
    if derivatives:
        outputs.append(ca.jacobian(direction, s.theta))
        shapes.append((s.theta.numel(), 3))
    return build_kernel(
        f"backward_{model_name}_{derivatives}", [s.theta, s.pixel, s.root], outputs, shapes
    )


@lru_cache(maxsize=32)
def backward_second_kernel(model_name: str) -> Kernel:
    """Kernel from pixels to unit vectors (3,), d/dtheta (p, 3), and unique second derivatives (p (p
    + 1) / 2, 3).
    """
    import casadi as ca

    s = _symbols(model_name)
    p = s.theta.numel()
    direction, index = backward_expression(model_name, s, newton_steps=2), second_index(p)
    second = _second_derivatives(direction, s.theta, index)
    outputs = [direction, ca.jacobian(direction, s.theta), second]
    shapes = [(3,), (p, 3), (len(index[0]), 3)]
    return build_kernel(
        f"backward_second_{model_name}", [s.theta, s.pixel, s.root], outputs, shapes
    )


@lru_cache(maxsize=32)
def newton_kernel(model_name: str) -> Kernel:
    """Kernel of one Newton step: next point (2,) and Jacobian determinant at the present one
    (1,).

    The target is an offset on the detector (forward), or an ideal point (inverse).
    """
    s = _symbols(model_name)
    forward = get_model(model_name).direction == "forward"
    target = _behind_lens(model_name, s.pixel, s.theta) if forward else s.pixel
    point, determinant = _newton_step(model_name, s.root, target, s.theta)
    return build_kernel(
        f"newton_{model_name}", [s.theta, s.pixel, s.root], [point, determinant], [(2,), (1,)]
    )


def solve_displacement(model_name: str, theta: FloatArray, target: FloatArray) -> FloatArray:
    """Points (2, n) that the model displaces to targets (2, n), px from the principal point: to
    offsets on the detector (forward), or to ideal points (inverse).

    Newton's method starts from the target, whence it converges monotonically for radial distortion
    that does not fold. Where it meets a fold they are not finite, but it may step over one
    (`before_fold`).
    """
    kernel = newton_kernel(model_name)
    n, point = target.shape[1], target
    if not get_model(model_name).coefficients or n == 0 or not np.any(theta[3:]):
        return np.array(target)
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            moved, determinant = kernel(n, theta, target, point)
            # Past a fold the determinant changes sign: that branch is not an image of the field.
            moved[:, determinant[0] <= 0.0] = np.nan
            change = np.nanmax(np.abs(moved - point), initial=0.0)
            point = moved
            if change < _NEWTON_TOLERANCE_PX:
                return point
        settled = (
            np.abs(point - kernel(n, theta, target, point)[0]).max(axis=0) < _NEWTON_TOLERANCE_PX
        )
    return np.where(settled, point, np.nan)


def forward_root(model_name: str, theta: FloatArray, b: FloatArray) -> FloatArray:
    """The `root` input of a forward kernel for directions b (3, n): (2,) zeros where the model is
    explicit.
    """
    if get_model(model_name).direction == "forward":
        return np.zeros(2)
    return solve_displacement(model_name, theta, theta[2] * b[:2] / b[2])


def backward_root(model_name: str, theta: FloatArray, pixel: FloatArray) -> FloatArray:
    """The `root` input of a backward kernel for pixels (2, n): (2,) zeros where the model is
    explicit.
    """
    if get_model(model_name).direction == "inverse":
        return np.zeros(2)
    centre = theta[:2] if theta.ndim == 2 else theta[:2, None]
    return solve_displacement(model_name, theta, pixel - centre)


def before_fold(model_name: str, theta: FloatArray, point: FloatArray) -> BoolArray:
    """Whether the displacement does not fold over between the principal point and each point (2,
    n); of NaN it is True.

    `theta` is (p,), or a column (p, n) each.
    """
    model = get_model(model_name)
    before = np.ones(point.shape[1], dtype=bool)
    with np.errstate(all="ignore"):
        square, size = point[0] ** 2 + point[1] ** 2, np.abs(theta[model.of_lens])
        if (
            not _bend(
                model_name, np.sqrt(np.fmax.reduce(square, initial=0.0)), [np.max(k) for k in size]
            )
            > 1.0
        ):
            return before
        bend = _bend(model_name, np.sqrt(square), size)
        far = np.flatnonzero((bend > 1.0) & np.isfinite(bend))
        if far.size:
            own = theta if theta.ndim == 1 else theta[:, far]
            safe = bend[far] ** (1.0 / (1 - min(c.order for c in model.lens)))
            # From there on in steps of 4 % at most, each point on its own way.
            inner = outer = np.full(far.size, np.nan)
            for step in np.geomspace(safe, 1.0, 2 + int(-np.log(safe.min()) / 0.04)):
                at = step * point[:, far]
                determinant = newton_kernel(model_name)(far.size, own, at, at)[1][0]
                # A parabola through three steps has the minimum between them.
                bend = inner - 2.0 * outer + determinant
                dips = (
                    (outer < inner)
                    & (outer <= determinant)
                    & (8.0 * bend * outer <= (determinant - inner) ** 2)
                )
                before[far] &= (determinant > 0.0) & ~dips
                inner, outer = outer, determinant
    return before


def _bend(model_name: str, radius: FloatArray, k: Iterable[FloatArray]) -> FloatArray:
    """Largest change of the displacement, px per px, up to a radius; below one, nothing folds."""
    # A radial term k r^m bends by m k r^(m - 1) px per px at most, a decentring one (even m) by
    # three times that.
    terms = get_model(model_name).lens
    steep = [(1.0 if c.order % 2 else 3.0) * c.order * radius ** (c.order - 1) for c in terms]
    return sum((a * b for a, b in zip(steep, k, strict=True)), np.zeros(1))


def cannot_fold(model_name: str, thetas: FloatArray, xy: FloatArray) -> bool:
    """Whether no parameters (D, p) fold at any pixel (N, 2), by a bound; False where that takes a
    closer look.
    """
    model = get_model(model_name)
    if model.direction != "forward":
        return False
    low, high = thetas[:, :2].min(axis=0), thetas[:, :2].max(axis=0)
    reach = np.hypot(*np.maximum(np.abs(xy - low), np.abs(xy - high)).max(axis=0))
    # Where nothing bends by more than a half, an ideal point is at most twice as far out as its
    # image; axes that are stretched or skewed add a half at most.
    if model.axes and np.abs(thetas[:, model.of_lens.stop :]).max() > 0.2:
        return False
    reach *= 1.5 if model.axes else 1.0
    size = list(np.abs(thetas[:, model.of_lens]).max(axis=0))
    return bool(_bend(model_name, np.array([2.0 * reach]), size)[0] < 0.5)


def unproject_theta(model_name: str, theta: FloatArray, xy: FloatArray) -> FloatArray:
    """Unit vectors (N, 3) in the camera frame of pixels xy (N, 2) for parameters theta (p,), or a
    column each.

    Not finite where a pixel has no ideal point before the distortion folds over.
    """
    return _unprojected(model_name, theta, xy, derivatives=False)[0].T


def unproject_jacobian(
    model_name: str, theta: FloatArray, xy: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Unit vectors b (N, 3) of pixels xy (N, 2), as by `unproject_theta`, and their derivatives
    db/dtheta (N, 3, p).
    """
    b, db = _unprojected(model_name, theta, xy, derivatives=True)
    return b.T, db.transpose(2, 1, 0)


def _unprojected(
    model_name: str, theta: FloatArray, xy: FloatArray, derivatives: bool
) -> tuple[FloatArray, ...]:
    pixel = np.ascontiguousarray(floats(xy).T)
    theta = floats(theta)
    root = backward_root(model_name, theta, pixel)
    outputs = backward_kernel(model_name, derivatives)(pixel.shape[1], theta, pixel, root)
    # The displacement acts on ideal points (forward) or on measured ones (inverse).
    x, y = pixel - (theta[:2] if theta.ndim == 2 else theta[:2, None])
    point = root if root.ndim == 2 else np.stack(get_model(model_name).unstretched(x, y, theta))
    before = before_fold(model_name, theta, point)
    plane = get_model(model_name).plane
    if plane is not PINHOLE:
        before &= ~(np.hypot(*point) > plane.limit_rad * theta[2])
    if not before.all():
        outputs[0][:, ~before] = np.nan
    return outputs


def fold_radius_px(model_name: str, theta: FloatArray, max_radius_px: float) -> float:
    """Smallest radius up to `max_radius_px` at which the distortion folds over; infinity when it
    does not.

    The map folds where the determinant of its Jacobian is not positive (`before_fold`), in any of
    36 directions; a radial model is the same in all of them.
    """
    angle = (
        np.zeros(1)
        if get_model(model_name).radial
        else np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    )
    rim = max_radius_px * np.stack([np.cos(angle), np.sin(angle)])
    clear, folded = 0.0, 1.0
    if before_fold(model_name, theta, rim).all():
        return float("inf")
    for _ in range(_HALVINGS):
        middle = 0.5 * (clear + folded)
        clear, folded = (
            (middle, folded)
            if before_fold(model_name, theta, middle * rim).all()
            else (clear, middle)
        )
    return max_radius_px * folded


class Optics(Protocol):
    """A camera, as far as these functions know it."""

    @property
    def distortion(self) -> str:
        """Name of the model."""

    @property
    def theta(self) -> FloatArray:
        """Parameters, px, shape (p,)."""

    @property
    def corner_radius_px(self) -> float:
        """Distance of the farthest corner from the principal point, px."""


def project(camera: Optics, b_cam: FloatArray) -> FloatArray:
    """Pixel positions of directions in the camera frame.

    Parameters
    ----------
    camera : Camera
        Optics and distortion.
    b_cam : (N, 3) array
        Directions in the camera frame (need not be unit vectors).

    Returns
    -------
    (N, 2) array
        Pixels; NaN for a direction beyond what the projection of the model can reach: of a pinhole
        at or behind the image plane's horizon (b_z <= 0).

    Raises
    ------
    DistortionError
        When a direction lies where the distortion has folded over, so that the image is not unique.
    """
    b = floats(b_cam).reshape(-1, 3).T
    theta = camera.theta
    xy = np.full((2, b.shape[1]), np.nan)
    plane = get_model(camera.distortion).plane
    front = b[2] > np.cos(plane.limit_rad) * np.linalg.norm(b, axis=0)
    if plane is PINHOLE:
        front = b[2] > 0.0
    if not front.any():
        return xy.T
    seen = np.ascontiguousarray(b[:, front])
    root = forward_root(camera.distortion, theta, seen)
    if get_model(camera.distortion).direction == "forward":
        radius = float(np.max(np.hypot(*plane.onto(seen, theta[2]))))
        fold = (
            fold_radius_px(camera.distortion, theta, radius) if np.any(theta[3:]) else float("inf")
        )
        if fold <= radius:
            raise DistortionError(
                f"the distortion {camera.distortion!r} folds over {fold:.0f} px from the "
                "principal point, inside the "
                f"{radius:.0f} px asked for: use smaller coefficients or stay within that radius."
            )
    elif not np.isfinite(root).all():
        raise _no_inverse(camera)
    (xy[:, front],) = forward_kernel(camera.distortion, "value")(seen.shape[1], theta, seen, root)
    return xy.T


def unproject(camera: Optics, xy_px: FloatArray) -> FloatArray:
    """Unit vectors in the camera frame of pixel positions.

    Parameters
    ----------
    camera : Camera
        Optics and distortion.
    xy_px : (N, 2) array
        Pixels.

    Returns
    -------
    (N, 3) array
        Unit vectors.

    Raises
    ------
    DistortionError
        When a pixel has no ideal point before the distortion folds over.
    """
    xy = floats(xy_px).reshape(-1, 2)
    theta = camera.theta
    if not np.isfinite(xy).all():
        raise DistortionError("a pixel position is not finite: pass finite x and y in px.")
    b = unproject_theta(camera.distortion, theta, xy)
    if not np.isfinite(b).all():
        raise _no_inverse(camera)
    return b


def _no_inverse(camera: Optics) -> DistortionError:
    fold = fold_radius_px(camera.distortion, camera.theta, 4.0 * camera.corner_radius_px)
    if fold == float("inf"):
        limit_deg = np.degrees(get_model(camera.distortion).plane.limit_rad)
        return DistortionError(
            f"pixels lie more than {limit_deg:.0f} degrees from the optical axis, which the model "
            f"{camera.distortion!r} does not reach: use a longer focal length."
        )
    return DistortionError(
        f"the distortion {camera.distortion!r} folds over {fold:.0f} px from the principal point "
        "and cannot be "
        "inverted beyond: use smaller coefficients or stay within that radius."
    )


def monotonic_expression(model_name: str, theta: Any, max_radius_px: float) -> Any:
    """Jacobian determinants of the distortion up to a radius, px, as a CasADi vector that is
    positive without folds.
    """
    import casadi as ca

    if not get_model(model_name).lens:
        return ca.SX.zeros(0, 1)
    values = []
    for radius in np.linspace(0.25, 1.0, 4) * max_radius_px:
        for angle in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
            point = ca.SX([radius * np.cos(angle), radius * np.sin(angle)])
            values.append(_newton_step(model_name, point, point, theta)[1])
    return ca.vertcat(*values)
