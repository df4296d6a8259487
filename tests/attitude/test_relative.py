"""Relative attitudes from files, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from starcal_uq.attitude import RelativeAttitudes, load_relative_attitudes
from starcal_uq.core.errors import AttitudeProfileError

HEADER = "frame_a,frame_b,qx,qy,qz,qw,sigma_arcsec\n"
ROW = "3,4,0.6,0,0,0.8,2.5\n"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "relative_attitudes.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_is_read_with_one_error_or_three(tmp_path: Path) -> None:
    one = load_relative_attitudes(written(tmp_path, HEADER + ROW))
    np.testing.assert_array_equal(one.frame_b, [4])
    np.testing.assert_array_equal(one.sigma_arcsec, [[2.5, 2.5, 2.5]])
    header = HEADER.replace("sigma_arcsec", "sigma_x_arcsec,sigma_y_arcsec,sigma_z_arcsec")
    three = load_relative_attitudes(written(tmp_path, header + "3,4,0.6,0,0,0.8,1,2,30\n"))
    np.testing.assert_array_equal(three.sigma_arcsec, [[1.0, 2.0, 30.0]])


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (HEADER, "holds no rows"),
        (HEADER.replace("qw", "q") + ROW, "column qw is missing"),
        (HEADER + ROW + "5,6,0.6,0,0,0.7,1\n", "line 3: the quaternion has the length 0.92"),
        (HEADER + ROW + "4,3,0.6,0,0,0.8,1\n", r"line 3 \(frames 4 and 3\): .* earlier row; keep"),
        (HEADER + "3,3,0.6,0,0,0.8,1\n", "tied to itself; remove it"),
        (HEADER + "3,4,0.6,0,0,0.8,0\n", "error is not above zero; state"),
        (HEADER + "3.5,4,0.6,0,0,0.8,1\n", "frame_a is 3.5, not the number of a frame"),
        (HEADER + "3,4,a,0,0,0.8,1\n", "line 2: qx is 'a', not a number"),
    ],
)
def test_a_broken_file_is_refused_with_its_line(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(AttitudeProfileError, match=match):
        load_relative_attitudes(written(tmp_path, text))


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    q = np.array([[0.0, 0.0, 0.0, 1.0]])
    with pytest.raises(AttitudeProfileError, match="give two frames for each"):
        RelativeAttitudes(np.arange(2), np.arange(2) + 1, q, np.ones(1))
    with pytest.raises(AttitudeProfileError, match="alignment_arcsec is -1"):
        RelativeAttitudes(np.array([0]), np.array([1]), q, np.ones(1), -1.0)
