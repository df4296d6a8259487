"""Interactive figures in a real browser without network: sliders, keys, values with units, and what a
measurement from elsewhere does, against formulas of our own.
"""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.camera.distortion import parameters
from starcal_uq.presentation.pages.explorer import explorer
from starcal_uq.presentation.pages.printing import browsers
from starcal_uq.presentation.pages.studies import render_study
from tests.helpers.studies import made_study

FIELDS = (5.0, 10.0, 20.0)
FRAMES = (10, 100, 1000)
R = dict(zip(FIELDS, (-0.97, -0.8, -0.3), strict=True))


@pytest.fixture(scope="module")
def calibration() -> sc.Calibration:
    frames = sc.simulate(
        sc.load_catalogue(max_mag=6.0), sc.paper.paper_camera(), n_frames=20, seed=1
    )
    return sc.calibrate(frames, sc.paper.paper_start())


# What a reader does, and what the page then says.
STEPS = """
<script>
const seen = [], sliders = [...document.querySelectorAll(".explorer input")];
const text = (of) => [...document.querySelectorAll(`.explorer ${of}`)].map((one) => one.textContent);
const names = (of, name) => [...of].map((one) => one.getAttribute(name));
const note = () => seen.push({
  outputs: text("label output"), valuetexts: names(sliders, "aria-valuetext"),
  errors: text("dd"), said: text(".said")[0], cells: text("td.chosen"), sigmas: text("td.n"),
  charts: names(document.querySelectorAll(".explorer svg"), "aria-label"), titles: text("svg g title") });
const move = (k, to) => { sliders[k].value = to; sliders[k].dispatchEvent(new Event("input")); note(); };
const press = (key) => {
  document.activeElement.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  note();
};
note();
STEPS
const result = document.createElement("pre");
result.id = "result";
result.textContent = JSON.stringify(seen);
document.body.append(result);
</script>
"""


def seen(page: str, steps: str, folder: Path) -> list[dict[str, list[str]]]:
    """What a page shows first and after each step, in a browser that reaches no network."""
    browser = next((one for one in browsers() if "chrom" in one.lower()), None)
    if browser is None:
        pytest.skip("no Chromium or Chrome is installed: interactive figures were not tested")
    file = folder / "page.html"
    file.write_text(page + STEPS.replace("STEPS", steps), encoding="utf-8")
    options = ["--headless", "--disable-gpu", "--no-first-run", f"--user-data-dir={folder}"]
    options += ["--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND"]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        options.append("--no-sandbox")
    command = [browser, *options, "--dump-dom", file.as_uri()]
    dom = subprocess.run(command, capture_output=True, timeout=60, check=True).stdout.decode()
    found = re.search(r'<pre id="result">(.*?)</pre>', dom, re.DOTALL)
    assert found, "the script of the page failed"
    states: list[dict[str, list[str]]] = json.loads(html.unescape(found[1]))
    return states


def test_sliders_keys_and_points_show_the_numbers_of_a_study(tmp_path: Path) -> None:
    study = made_study(
        {"fov_deg": FIELDS, "frames": FRAMES},
        lambda cell: {("f", "k1"): R[cell["fov_deg"]]},
        size=lambda cell: 10.0 / np.sqrt(cell["frames"]),
        failing=lambda cell: "too few stars." if cell["fov_deg"] == 5.0 else "ok",
        jitter=0.0,
    )
    steps = """move(0, 2); move(1, 2); move(0, 0); move(0, 1);
      document.querySelector("td.chosen").focus(); press("ArrowLeft"); press("ArrowUp");"""
    page = render_study(study, {})
    # One page without another file.
    assert not re.search(r'(src|href)="(?!#|data:)|@import|fetch\(', page)
    assert set(re.findall(r"https?:[^\s\"']*", page)) == {"http://www.w3.org/2000/svg"}
    first, wide, many, missing, back, diagonal, corner = seen(page, steps, tmp_path)
    assert first["outputs"] == first["valuetexts"] == ["10°", "100"]
    assert first["errors"] == ["1 arcsec", "10 arcsec", "1 arcsec", "✗ not met"]
    assert first["cells"] == ["−0.80"] and "f and k₁: correlation −0.80" in str(first["said"])
    assert wide["cells"] == ["−0.30"] and wide["outputs"] == ["20°", "100"]
    # 10 / sqrt(1000) arcsec.
    assert many["errors"] == ["0.316 arcsec", "3.16 arcsec", "0.316 arcsec", "✓ met"]
    assert "frame-dependent rest 0.316 arcsec" in many["charts"][0]
    assert "frame-dependent rest at number of frames 10: 3.16 arcsec" in many["titles"]
    assert missing["said"] == "No cell has numbers here." and missing["errors"] == ["–"] * 3
    assert back["cells"] == ["−0.80"] and "f and k₁ at field of view 20°: 0.30" in back["titles"]
    # From k1 in the row of f to f itself, then to y0 in its column.
    assert str(diagonal["said"]).startswith("σ of f: 0.0316 px; 0.019 px if all other")
    assert corner["cells"] == ["0.00"] and "y₀ and f: correlation 0.00" in str(corner["said"])


def test_a_measurement_from_elsewhere_is_added_as_information(
    calibration: sc.Calibration, tmp_path: Path
) -> None:
    coupling = sc.coupling(calibration)
    names = list(coupling.parameter_names)
    x0, k2 = names.index("x0"), names.index("k2")
    # Sigmas with x0 measured as well as it is known, and k2 ten times better, by information.
    scale = np.sqrt(np.diag(coupling.covariance))
    information = np.linalg.inv(coupling.covariance / np.outer(scale, scale))
    information[x0, x0] += 1.0
    information[k2, k2] += 100.0
    sigma = coupling.sigma_marginal * np.sqrt(np.diag(np.linalg.inv(information)))
    rotation = calibration.rotation_per_theta * scale
    yaw = np.sqrt((rotation @ np.linalg.inv(information) @ rotation.T)[1, 1]) * 648000.0 / np.pi
    page = f"<!DOCTYPE html><meta charset='utf-8'>{explorer(coupling)}"
    first, _, both = seen(page, f"move({x0}, 2); move({k2}, 4);", tmp_path)
    shown = [float(text.split()[0]) for text in both["sigmas"][::2]]
    specs = parameters(calibration.camera.distortion)
    np.testing.assert_allclose(shown, sigma / [spec.scale for spec in specs], rtol=0.006)
    assert float(both["errors"][1].split()[0]) == pytest.approx(yaw, rel=0.006)
    before = coupling.common_rotation_arcsec[1]
    assert float(first["errors"][1].split()[0]) == pytest.approx(before, rel=0.006)
    assert yaw < 0.8 * before


def test_a_notebook_holds_the_figure_in_a_frame_of_its_own(calibration: sc.Calibration) -> None:
    coupling = sc.coupling(calibration)
    shown = coupling._repr_html_()
    assert shown is not None
    frame = re.search(r'<iframe sandbox="allow-scripts"[^>]* srcdoc="([^"]*)"', shown)
    assert frame
    page = html.unescape(frame[1])
    # For readers without a script the matrix is there with its numbers.
    table = page[page.index("<table") : page.index("</table>")]
    shown_r = [text.replace("−", "-") for text in re.findall(r"<td[^>]*>([^<]*)</td>", table)]
    p = len(coupling.parameter_names)
    expected = coupling.extended_correlation[:p]
    np.testing.assert_allclose(
        np.reshape(list(map(float, shown_r)), expected.shape), expected, atol=0.0051
    )
    assert len(shown) < 60_000
