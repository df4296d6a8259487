"""Kernels against CasADi's own evaluation."""

import numpy as np
import pytest

from starcal_uq.camera import projection
from tests.helpers.scenes import MODELS, camera

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("order", ["value", "attitude", "first", "bent"])
def test_kernels_equal_casadi(model, order):
    cam = camera(model)
    b = np.ascontiguousarray(projection.unproject(cam, RNG.uniform(-50, 1074, (3000, 2))).T)
    root = projection.forward_root(model, cam.theta, b)
    kernel = projection.forward_kernel(model, order)
    outputs = kernel(b.shape[1], cam.theta, b, root)
    shared = root if root.ndim == 2 else np.zeros((2, b.shape[1]))
    picks = slice(0, 3000, 61)
    reference = kernel.function(cam.theta, b[:, picks], shared[:, picks])
    reference = reference if isinstance(reference, tuple) else (reference,)
    for ours, theirs in zip(outputs, reference, strict=True):
        flat = ours.reshape(-1, b.shape[1])[:, picks]
        expected = np.array(theirs).reshape(flat.shape)
        scale = np.max(np.abs(expected), axis=1, keepdims=True) + 1e-300
        assert np.max(np.abs(flat - expected) / scale) < 1e-13


@pytest.mark.parametrize("model", MODELS)
def test_backward_kernel_equals_casadi(model):
    cam = camera(model)
    pixel = RNG.uniform(0, 1023, (2, 200))
    root = projection.backward_root(model, cam.theta, pixel)
    kernel = projection.backward_kernel(model, True)
    shared = root if root.ndim == 2 else np.zeros((2, 200))
    for ours, theirs in zip(
        kernel(200, cam.theta, pixel, root), kernel.function(cam.theta, pixel, shared), strict=True
    ):
        assert np.max(np.abs(ours.reshape(-1, 200) - np.array(theirs).reshape(-1, 200))) < 1e-13
