"""Calls for the type checker, which `make lint` runs; nothing runs this file.

The stubs give the public names their signatures. Each wrong call has to be an error: in an untyped
surface its comment is unused, and that is an error, too.
"""

from __future__ import annotations

import starcal_uq as sc

obs = sc.load_observations("observations.csv")
cal: sc.Calibration = sc.calibrate(obs, sc.Camera.load("camera.toml"))
plan: sc.planning.Plan = sc.plan(cal.camera, sc.load_catalogue(max_mag=6.0))
figure = cal.plot
sc.calibrate(obs, cal.camera, nonsense=3)  # type: ignore[call-arg]
sc.calibrate(1, cal.camera)  # type: ignore[arg-type]
sc.sample(obs, cal, seed="one")  # type: ignore[arg-type]
sc.simulation.render(1)  # type: ignore[call-arg, arg-type]
nothing = sc.nonsense  # type: ignore[attr-defined]
