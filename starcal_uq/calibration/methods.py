"""Methods of estimation that other packages offer, found by their entry points.

The methods that Ye & Yang 2017 compare theirs with are offered by the wing of the paper.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, cast

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.extras import entry_point

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.estimation.settings import MethodOptions

GROUP = "starcal_uq.methods"


class Offered(Protocol):
    """A method: from observations and a nominal camera to a calibration."""

    def __call__(
        self,
        obs: object,
        camera: Camera,
        options: MethodOptions | None,
        solver: str,
        max_iterations: int,
        /,
    ) -> Calibration: ...


def offered(method: str) -> Offered:
    """The method of this name.

    CalibrationError where no installed package offers it.
    """
    found = entry_point(GROUP, method)
    if found is None:
        raise CalibrationError(
            f"method {method!r} is not offered by any installed package: install starcal_uq again."
        )
    return cast(Offered, found.load())
