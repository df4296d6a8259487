"""What the map over the field says, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starcal_uq.core.formatting import significant

if TYPE_CHECKING:
    from starcal_uq.propagation.field import FieldMap


def equivalent_sentence(field: FieldMap | None) -> str:
    """The common rotation as an error of the principal point; empty without a map, or for one that does not hold it."""
    if field is None:
        return ""
    pixels, angles = field.equivalent_principal_point_px, field.equivalent_principal_point_arcsec
    if pixels is None or angles is None:
        return ""
    x, y = (
        f"{significant(pixel)} px ({significant(angle)} arcsec)"
        for pixel, angle in zip(pixels.tolist(), angles.tolist(), strict=True)
    )
    return (
        "Equivalent principal point: the rotation that is removed on the right is what an error of the principal point "
        f"of {x} along x and {y} along y (1 sigma) would do by itself."
    )
