"""What Ye & Yang (2017) print about their field experiment (section 3.4, Table 3), and how its
sensor is read.

The printed sensor is not one: see `READINGS`. Everything that had to be assumed stands here, each
with its reason.
"""

from __future__ import annotations

from dataclasses import dataclass

from starcal_uq.camera.camera import Camera
from starcal_uq.paper.published import LEAST_SQUARES, PROPOSED, SAMAAN, Printed
from starcal_uq.simulation.sensor import Sensor

UNCALIBRATED, TRUE_CAMERA = "uncalibrated", "truth"
# Rows of their Table 3, in order; the truth is ours, as a control.
FIELD_METHODS = (UNCALIBRATED, LEAST_SQUARES, SAMAAN, PROPOSED)
FIELD_CAMERAS = (*FIELD_METHODS, TRUE_CAMERA)
RATE = "rate_percent"
AXES = ("pitch_arcsec", "yaw_arcsec", "roll_arcsec")
_ROWS = (
    ("89", "65", "72", "127.2"),
    ("93", "45", "49", "69"),
    ("95", "17", "21", "32"),
    ("96", "10", "11", "16.2"),
)
TABLE_3: tuple[Printed, ...] = tuple(
    Printed(method, quantity, text, f"Table 3, row {number}")
    for number, (method, row) in enumerate(zip(FIELD_METHODS, _ROWS, strict=True), 1)
    for quantity, text in zip((RATE, *AXES), row, strict=True)
)
# Section 3.4: the sensor, its calibration by the proposed method, and the frames.
FIELD_DEG = 10.8
PIXEL_UM = 5.5
FOCAL_MM = 44.38
X0_PX = 1142.06
Y0_PX = 1058.62
K1 = -3.7e-9
K2 = 3.93e-16
N_CHOSEN, N_TAKEN, MORE_THAN_STARS = 200, 600, 6

# A data sheet gives whole millimetres, the centre of the detector, and no distortion.
NOMINAL_FOCAL_MM = 44.0
# Other data sheets, for comparison: the print rounded to 0.1 mm, and the next whole millimetre.
OTHER_NOMINAL_FOCAL_MM = (44.4, 45.0)


@dataclass(frozen=True)
class FieldReading:
    """One consistent sensor: its name, what it says, the pixels per side that are read out, and the
    first of them.

    A pixel coordinate of the paper is ours plus `offset_px`. Half of the stars of `limit_mag` (Gaia
    G) are found: about a third of random attitudes then show more than six stars, as many as were
    chosen of the paper's frames, 200 of 600.
    """

    name: str
    words: str
    side_px: int
    offset_px: int
    limit_mag: float

    @property
    def truth(self) -> Camera:
        """The sensor with the calibrated values of the paper."""
        return Camera(
            width_px=self.side_px,
            height_px=self.side_px,
            pixel_um=PIXEL_UM,
            focal_mm=FOCAL_MM,
            x0_px=X0_PX - self.offset_px,
            y0_px=Y0_PX - self.offset_px,
            coefficients=(K1, K2),
            name="field unit of Ye & Yang 2017",
        )

    def nominal(self, focal_mm: float = NOMINAL_FOCAL_MM) -> Camera:
        """The sensor as a data sheet has it: principal point at the centre, coefficients of zero to
        start from.
        """
        centre = 0.5 * (self.side_px - 1)
        return self.truth.replace(
            focal_mm=focal_mm,
            x0_px=centre,
            y0_px=centre,
            coefficients=(0.0, 0.0),
            name="data sheet",
        )

    @property
    def sensor(self) -> Sensor:
        """Detector and PSF of the default star tracker, of which a star at the limit just passes
        the threshold.
        """
        return Sensor(
            zero_point_e_s=_ZERO_POINT_E_S * 10.0 ** (0.4 * (self.limit_mag - _ZERO_POINT_MAG))
        )


# With this the default sensor finds half of the stars of this magnitude.
_ZERO_POINT_E_S, _ZERO_POINT_MAG = 9.7e4, 4.9

# The window is a part of a common format of 5.5 um pixels.
READINGS: dict[str, FieldReading] = {
    "window": FieldReading(
        "window",
        "The middle 1524 × 1524 px of a 2048 × 2048 detector are read out, and pixels are "
        "counted on the whole "
        "detector.",
        1524,
        262,
        4.7,
    ),
    "full": FieldReading("full", "All of a 2048 × 2048 detector is read out.", 2048, 0, 4.05),
}


def printed_sensor(reading: FieldReading) -> tuple[tuple[str, str, bool, str], ...]:
    """Every printed number of the sensor under a reading: name, text, whether it is kept, and how
    or why not.

    Other readings contradict more: a detector of the 1525 px that 10.8 deg are at 44.38 mm has its
    centre 482 px from the printed principal point, and 2048 px over 10.8 deg have another focal
    length or other pixels.
    """
    truth = reading.truth
    x, y = abs(truth.x0_px - truth.centre_px[0]), abs(truth.y0_px - truth.centre_px[1])
    field = f"{truth.fov_deg[0]:.2f}°: {reading.side_px} px of 5.5 µm at 44.38 mm"
    return (
        (
            "field",
            f"{FIELD_DEG}° × {FIELD_DEG}°",
            bool(abs(truth.fov_deg[0] - FIELD_DEG) < 0.05),
            field,
        ),
        ("pixel", f"{PIXEL_UM} µm", True, "as printed"),
        ("focal length", f"{FOCAL_MM} mm", True, "as printed"),
        (
            "principal point",
            f"({X0_PX}, {Y0_PX}) px",
            True,
            f"{x:.1f} and {y:.1f} px off the centre of the detector",
        ),
        (
            "distortion",
            "k₁ = −3.7·10⁻⁹, k₂ = 3.93·10⁻¹⁶",
            True,
            "px⁻² and px⁻⁴, by eq. 14; monotonic over the field",
        ),
    )


def printed_field(method: str, quantity: str) -> Printed:
    """The printed number of a row and column of Table 3."""
    return next(
        number for number in TABLE_3 if (number.method, number.quantity) == (method, quantity)
    )
