"""The attitude error that is stated with each onboard model against that of a sensor of a second
make with an effect of its own, NumPy alone; see `tests.helpers.onboard_campaigns`.
"""

import pytest

from starcal_uq.propagation import propagate as propagation
from tests.helpers.onboard_campaigns import EFFECTS, ratios

REPLICATES, CONTROLS = range(28), range(6)


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    """Half-widths, which take most of the time, are not compared."""
    monkeypatch.setattr(propagation, "_SAMPLES", 1000)


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_stated_attitude_errors_are_the_true_ones_whatever_is_aboard(effect: str) -> None:
    found = ratios(effect, REPLICATES)
    assert set(found) == {"model", "effects"}
    for onboard, (common, rest) in found.items():
        print(effect, onboard, "true over stated: common", common, "rest", rest)
    for common, rest in found.values():
        assert 0.8 < common < 1.2
        assert 0.8 < rest < 1.2
    # Control: a calibration that knows no effect states an error that the sensor exceeds.
    blind = ratios(effect, CONTROLS, left_out=True)
    print(effect, "left out", blind)
    assert max(blind["model"]) > 1.2
