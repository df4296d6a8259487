"""Settings of `calibrate` that make no sense, alone or together, are refused in a sentence."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from tests.helpers.effects import sheet, table
from tests.helpers.outside import campaign
from tests.helpers.ties import gyro, known_of

SEEN = campaign(np.random.default_rng(7), n_frames=8)
MEASURED = gyro(np.random.default_rng(7), SEEN, 1.0)
KNOWN = known_of(MEASURED)
OTHERS = known_of(MEASURED | {"frame_b": MEASURED["frame_b"] + 1})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "magic"}, "'magic' is unknown: use one of"),
        ({"solver": "magic"}, "'magic' is unknown: use one of"),
        ({"duplicates": "magic"}, "'magic' is unknown: use one of"),
        ({"mount": "magic"}, "'magic' is unknown: use one of"),
        ({"effects": "magic"}, "'magic' is unknown: .* noise, tails"),
        ({"effects": "temperature"}, "'temperature' needs"),
        ({"effects": "star"}, "seen in several frames"),
        ({"effects": "noise", "method": "three_stage"}, "effects='noise' needs method='efficient'"),
        ({"effects": "tails", "method": "three_stage"}, "effects='tails' needs method='efficient'"),
        ({"effects": "star", "method": "three_stage"}, "effects='star' needs method='efficient'"),
        ({"effects": "tails", "method": "samaan"}, "effects='tails' needs method='efficient'"),
        ({"effects": "tails", "dof": 0.1}, "from 2 to 200"),
        ({"effects": "tails", "dof": "many"}, "'free'"),
        ({"dof": 4.0}, "dof=4.0 belongs to effects='tails'"),
        ({"recursion": sc.paper.RecursionOptions()}, "needs method='samaan' or method="),
        ({"mount": "fixed"}, "mount_sigma_arcsec is"),
        ({"mount": "fixed", "mount_sigma_arcsec": 1.0}, "no time_utc"),
        ({"mount_sigma_arcsec": 1.0}, "mount_sigma_arcsec=1.0 needs mount='fixed'"),
        ({"relative_attitudes": KNOWN, "effects": "frame"}, "effects"),
        ({"relative_attitudes": KNOWN, "method": "three_stage"}, "needs method='efficient'"),
        ({"relative_attitudes": OTHERS}, "name frame 8, which the table does not hold"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "needs a folder of partitions"),
    ],
    ids=str,
)
def test_settings_without_meaning_are_refused(options, words):
    with pytest.raises(CalibrationError, match=words):
        sc.calibrate(table(SEEN), sheet(SEEN), **options)
