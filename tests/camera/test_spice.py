"""Instrument kernels of SPICE: published values against their own formulas, in NumPy alone."""

import re

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CameraError
from tests.helpers.scenes import camera as scene_camera
from tests.helpers.scenes import nominal, observations

# Values of dawn_fc_v10.ti (DLR, MPS, NAIF 2013), msgr_mdis_v160.ti (JHU/APL 2015), nh_lorri_v201.ti
# (JHU/APL 2016) and orx_ocams_v07.ti (NAIF 2019).
KERNELS = {
    -203126: """
        INS-203126_FOCAL_LENGTH       = ( 150.08                   )
        INS-203126_PIXEL_SIZE         = ( 14.004, 13.995 )
        INS-203126_PIXEL_SAMPLES      = ( 1024           )
        INS-203126_PIXEL_LINES        = ( 1024           )
        INS-203126_CCD_CENTER         = ( 511.5,  511.5  )
        INS-203126_FOV_FRAME          = 'DAWN_FC2'
        INS-203126_RAD_DIST_COEFF     = ( 0.0000092 )""",
    -236800: """
        INS-236800_FOCAL_LENGTH     = ( 78.23670  )
        INS-236800_PIXEL_SAMPLES    = (  1024    )
        INS-236800_PIXEL_LINES      = (  1024    )
        INS-236800_PIXEL_PITCH      = (  14.0E-3 )
        INS-236800_CCD_CENTER       = (  512.5, 512.5 )
        INS-236800_FRAME   = 'MSGR_MDIS_WAC'
        INS-236800_TRANSX  = ( 0.0, 13.99999999972e-03,    0.0                )
        INS-236800_TRANSY  = ( 0.0, 1.32495711261385e-07,  13.997772676294e-03 )
        INS-236800_ITRANSS = ( 0.0, 71.42857143,           0.0        )
        INS-236800_ITRANSL = ( 0.0, -6.76106091652016e-04, 71.4399371332522 )
        INS-236800_OD_T_X = (  0.0, 1.0, 0.0, -7.720894252056575E-5, 3.599871902138938E-6, 0.0,
                               5.509035727272325E-6, 0.0, 5.509035727272406E-6, 0.0 )
        INS-236800_OD_T_Y = (  0.0, 0.0, 1.0000000000261484, 0.0, -7.720894252092194E-5,
                               3.5998717824736167E-6, 0.0, 5.5090356219415276E-6, 0.0,
                               5.509030873819812E-6 )""",
    -236820: """
        INS-236820_FOCAL_LENGTH     = ( 549.1178195372703 )
        INS-236820_PIXEL_SAMPLES    = (  1024    )
        INS-236820_PIXEL_LINES      = (  1024    )
        INS-236820_PIXEL_PITCH      = (  14.0E-3 )
        INS-236820_CCD_CENTER       = (  512.5, 512.5 )
        INS-236820_FRAME  = 'MSGR_MDIS_NAC'
        INS-236820_ITRANSS     = ( 0.0, 71.42857143,  0.0        )
        INS-236820_ITRANSL     = ( 0.0,  0.0,        71.42857143 )
        INS-236820_OD_T_X = (  0.0, 1.0018542696238023333, 0.0, 0.0, -5.0944404749411114E-4, 0.0,
                               1.0040104714688569E-5, 0.0, 1.0040104714688569E-5, 0.0 )
        INS-236820_OD_T_Y = (  0.0, 0.0, 1.0, 9.06001059499675E-4, 0.0, 3.5748426266207586E-4, 0.0,
                               1.0040104714688569E-5, 0.0, 1.0040104714688569E-5 )""",
    -98301: """
        INS-98301_FOV_FRAME         = 'NH_LORRI_1X1'
        INS-98301_BORESIGHT         = ( 0.0, 0.0, -1.0 )
        INS-98301_FOCAL_LENGTH      = ( 2618.4775964615382691 )
        INS-98301_PIXEL_SAMPLES     = ( 1024 )
        INS-98301_PIXEL_LINES       = ( 1024 )
        INS-98301_PIXEL_SIZE        = (  12.997  )
        INS-98301_CCD_CENTER        = ( 511.5, 511.5 )
        INS-98301_OOC_FOCAL_LENGTH  = 2618.4775964615382691
        INS-98301_OOC_KMAT          = ( 76.9408555820574094, 0.0, 0.0, 76.9408555820574094 )
        INS-98301_OOC_EM            = ( 2.7172539725122498E-05, -1.9034392552127415E-05,
                                       -2.8806647687927984E-05 )
        INS-98301_OOC_CCD_CENTER    = ( 511.5, 511.5 )
        INS-98301_SIP_AP_3_0   =  4.5900372459772E-09
        INS-98301_SIP_AP_1_2   =  4.5900372459772E-09
        INS-98301_SIP_AP_1_1   = -2.4738992578302E-07
        INS-98301_SIP_AP_2_0   = -3.7439988768003E-07
        INS-98301_SIP_BP_2_1   =  4.5900372459772E-09
        INS-98301_SIP_BP_0_3   =  4.5900372459772E-09
        INS-98301_SIP_BP_0_2   = -2.4738992578302E-07
        INS-98301_SIP_BP_1_1   = -3.7439988768003E-07""",
    -64360: """
        INS-64360_FOCAL_LENGTH      = (  628.70   )
        INS-64360_PIXEL_SAMPLES     = (  1024  )
        INS-64360_PIXEL_LINES       = (  1024  )
        INS-64360_PIXEL_SIZE        = (   8.5  )
        INS-64360_CCD_CENTER        = (  511.5, 511.5 )""",
}
# Half of the field of view, as slopes.
FIELD = {-203126: 0.0477, -236800: 0.0916, -236820: 0.01305, -98301: 0.00254, -64360: 0.00692}


def kernel(*instruments):
    blocks = (
        f"\\begindata\n{KERNELS[i]}\n\\begintext\nText = (between) blocks\n" for i in instruments
    )
    return "KPL/IK\n\n   INS-1_FOCAL_LENGTH = 3\n" + "\n".join(blocks)


def slopes(instrument):
    side = np.linspace(-FIELD[instrument], FIELD[instrument], 9)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def published(instrument, at):
    """Samples and lines from the formula of each kernel's text, from 0 at the first pixel."""

    def values(key):
        text = re.search(
            rf"INS{instrument}_{key}\s*=\s*\(?([^)\n]*(?:\n[^)=]*)*)", KERNELS[instrument]
        )
        return [float(v) for v in re.findall(r"[-+.\d]+(?:[eE][-+]?\d+)?", text[1])]

    x, y = values("FOCAL_LENGTH")[0] * at.T
    r2 = x**2 + y**2
    if instrument == -203126:
        e1, (kx, ky) = values("RAD_DIST_COEFF")[0], 1e3 / np.array(values("PIXEL_SIZE"))
        return np.stack([kx * x * (1 + e1 * r2), ky * y * (1 + e1 * r2)], axis=1) + 511.5
    if instrument in (-236800, -236820):
        a, b = values("OD_T_X"), values("OD_T_Y")
        terms = [1, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
        xd, yd = (sum(c * t for c, t in zip(k, terms, strict=True)) for k in (a, b))
        (_, k00, k01), (_, k10, k11) = values("ITRANSS"), values("ITRANSL")
        # Its text counts from (1, 1).
        return np.stack([k00 * xd + k01 * yd, k10 * xd + k11 * yd], axis=1) + 511.5
    if instrument == -98301:
        (e2, e5, e6), k = values("OOC_EM"), values("OOC_KMAT")[0]
        grown = 1 + e2 * r2 + e5 * y + e6 * x
        return k * np.stack([x * grown, y * grown], axis=1) + 511.5
    return np.stack([x, y], axis=1) * 1e3 / 8.5 + 511.5


def seen(camera, at):
    """Directions of slopes in the frame of a camera, which its name states."""
    turned = re.search(r"turned by (\S+) deg", camera.name)
    a = np.radians(float(turned[1])) if turned else 0.0
    x, y = at.T
    b = np.stack([np.cos(a) * x - np.sin(a) * y, np.sin(a) * x + np.cos(a) * y, np.ones_like(x)])
    return (b / np.linalg.norm(b, axis=0)).T


@pytest.mark.parametrize("instrument", KERNELS)
def test_a_published_kernel_gives_its_pixels(instrument, tmp_path):
    path = tmp_path / "mission.ti"
    path.write_text(kernel(*KERNELS))
    camera = sc.Camera.load(f"{path}#{instrument}")
    at = slopes(instrument)
    theirs = published(instrument, at)
    assert np.ptp(theirs, axis=0).min() > 1000.0
    assert np.abs(sc.camera.project(camera, seen(camera, at)) - theirs).max() < 1e-6
    # Distortion and detector are seen at this bound: half a pixel, and the lens.
    if instrument != -64360:
        bare = camera.replace(distortion="none", coefficients=())
        assert np.abs(sc.camera.project(bare, seen(camera, at)) - theirs).max() > 0.05


def test_the_two_distortions_of_a_kernel_agree(tmp_path):
    """LORRI states its lens twice; the second is read where the first is absent."""
    path = tmp_path / "sip.ti"
    path.write_text(re.sub(r"INS-98301_OOC\w+\s*=\s*(\([^)]*\)|\S+)", "", kernel(-98301)))
    assert "OOC" not in path.read_text()
    at, camera = slopes(-98301), sc.Camera.load(path)
    assert camera.distortion == "cubic"
    # Its KMAT is 76.9231 / T, where 1000 / 13 is 76.92308: a share of 3e-7, 1.6e-4 px at the edge.
    off = np.abs(sc.camera.project(camera, seen(camera, at)) - published(-98301, at))
    assert 1e-4 < off.max() < 2e-4
    bare = camera.replace(distortion="none", coefficients=())
    assert np.abs(sc.camera.project(bare, seen(camera, at)) - published(-98301, at)).max() > 0.1


@pytest.mark.parametrize("instrument", KERNELS)
def test_what_is_written_is_read_again(instrument, tmp_path):
    (tmp_path / "k.ti").write_text(kernel(instrument))
    camera = sc.Camera.load(tmp_path / "k.ti")
    made = sc.export(camera, "spice", tmp_path / "out.ti", instrument=instrument)
    back = sc.Camera.load(made.path)
    at = slopes(instrument)
    ours = sc.camera.project(camera, seen(camera, at))
    assert made.error_px < 1e-7
    assert np.abs(sc.camera.project(back, seen(camera, at)) - ours).max() < 1e-6
    assert (back.distortion, back.pixel_um) == (camera.distortion, camera.pixel_um)


def test_lines_that_count_upwards_are_counted_downwards(tmp_path):
    """A `Camera` cannot be a mirror: line 0 is then the last one, and the name states it."""
    text = kernel(-236820).replace("0.0,  0.0,        71.42857143", "0.0,  0.0,       -71.42857143")
    assert text.count("-71.42857143") == 1
    (tmp_path / "k.ti").write_text(text)
    camera, at = sc.Camera.load(tmp_path / "k.ti"), slopes(-236820)
    assert camera.name == "MSGR_MDIS_NAC, lines counted from the other side"
    # Upwards, its line is 1023 less that of the kernel as published.
    assert np.abs(sc.camera.project(camera, seen(camera, at)) - published(-236820, at)).max() < 1e-6


def test_a_detector_turned_by_half_a_circle_turns_the_frame(tmp_path):
    text = kernel(-236820).replace(" 71.42857143", " -71.42857143")
    (tmp_path / "k.ti").write_text(text)
    camera, at = sc.Camera.load(tmp_path / "k.ti"), slopes(-236820)
    assert "turned by -180 deg" in camera.name or "turned by 180 deg" in camera.name
    theirs = 1023.0 - published(-236820, at)
    assert np.abs(sc.camera.project(camera, seen(camera, at)) - theirs).max() < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("FOCAL_LENGTH", "FL", "no camera with FOCAL_LENGTH and PIXEL_SAMPLES"),
        ("CCD_CENTER", "CENTER", "INS-203126 lacks CCD_CENTER"),
        ("RAD_DIST_COEFF", "OD_K", "INS-203126_OD_K is a distortion whose formula depends"),
        ("( 150.08                   )", "( 'long' )", "could not convert string to float"),
        ("( 14.004, 13.995 )", "( 1, 2, 3 )", "INS-203126_PIXEL_SIZE has not 2 finite numbers"),
        ("begindata", "begintext", "no camera with"),
    ],
)
def test_a_kernel_that_lacks_something_is_refused_in_a_sentence(old, new, said, tmp_path):
    text = kernel(-203126)
    assert old in text
    (tmp_path / "k.ti").write_text(text.replace(old, new))
    with pytest.raises(CameraError, match=said) as refused:
        sc.Camera.load(tmp_path / "k.ti")
    assert str(refused.value).startswith(str(tmp_path / "k.ti"))


def test_a_kernel_with_several_cameras_names_them_and_one_can_be_chosen(tmp_path):
    path = tmp_path / "k.ti"
    path.write_text(kernel(-236800, -236820))
    with pytest.raises(CameraError, match=r"-236800, -236820: put one of them .* FILE.ti#-236800"):
        sc.Camera.load(path)
    assert sc.Camera.load(f"{path}#-236820").name == "MSGR_MDIS_NAC"
    with pytest.raises(CameraError, match="has the cameras -236800, -236820"):
        sc.Camera.load(f"{path}#-1")
    made = sc.export(f"{path}#-236800", "spice", tmp_path / "wac.ti", instrument=-1)
    assert "INS-1_FOCAL_LENGTH = 78.2" in made.path.read_text()


def test_the_kernel_of_a_run_states_its_standard_deviations(tmp_path):
    obs = observations("brown", n_frames=20)
    found = sc.calibrate(obs, nominal(scene_camera()))
    text = sc.export(found, "spice", tmp_path / "k.ti").path.read_text()
    stated = dict(re.findall(r"^   (\w+) +([-.e\d]+) px", text.split("\\begintext")[1], re.M))
    assert list(stated) == list(found.parameter_names)
    assert np.allclose([float(v) for v in stated.values()], found.sigmas, rtol=1e-3)
    assert max(map(len, text.splitlines())) <= 132 and text.isascii()
    with pytest.raises(CameraError, match="pixel_um"):
        sc.export(
            found.camera.replace(pixel_um=None, focal_mm=None, focal_px=5000.0),
            "spice",
            tmp_path / "b.ti",
        )
