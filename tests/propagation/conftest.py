"""What fast tests of propagation leave out."""

import pytest


@pytest.fixture(autouse=True)
def few_samples(request, monkeypatch):
    """Half-widths take most of the time of a propagation: only campaigns that measure them have
    them to a few parts in a thousand.
    """
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr("starcal_uq.propagation.propagate._SAMPLES", 4000)
