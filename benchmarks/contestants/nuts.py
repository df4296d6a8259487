"""No-U-Turn sampling (NumPyro) of the exact likelihood in JAX, with the derivatives that JAX finds."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")

import jax.numpy as jnp  # noqa: E402
from likelihood import Likelihood  # noqa: E402
from numpyro.infer import MCMC, NUTS  # noqa: E402

Result = dict[str, Any]


def numpyro(
    folder: Path, *, chains: int = 4, warmup: int = 200, draws: int = 500
) -> Callable[[], Result]:
    """Chains one after the other, from draws of the normal approximation, in its coordinates."""
    exact = Likelihood(folder)
    # A frame in each row, filled up with zeros: sums over frames are then products of small
    # matrices.
    wide = int(exact.counts.max())
    inside = np.arange(wide) < exact.counts[:, None]

    def padded(values: np.ndarray) -> Any:
        out = np.zeros((*values.shape[:-1], *inside.shape))
        out[..., inside] = values
        return jnp.asarray(out)

    p, q, x, y = (padded(values) for values in (exact.p, exact.q, exact.x, exact.y))
    basis, mask = padded(exact.basis), jnp.asarray(inside, dtype=float)
    theta_hat, root = jnp.asarray(exact.theta_hat), jnp.asarray(exact.root)

    def potential(z: Any) -> Any:
        theta = theta_hat + root @ z[:5]
        u, v = theta[2] * p, theta[2] * q
        r2 = u * u + v * v
        scale = 1.0 + r2 * (theta[3] + theta[4] * r2)
        ex, ey = (x - theta[0] - u * scale) * mask, (y - theta[1] - v * scale) * mask
        along = jnp.sum(basis[:, 0] * ex + basis[:, 1] * ey, axis=-1)
        # Residuals without what the attitudes take up; zero where there is no star.
        ex -= jnp.einsum("akm,ak->km", basis[:, 0], along)
        ey -= jnp.einsum("akm,ak->km", basis[:, 1], along)
        log_sigma = exact.log_sigma + exact.log_sigma_sd * z[5]
        s = jnp.vdot(ex, ex) + jnp.vdot(ey, ey)
        return 0.5 * s * jnp.exp(-2.0 * log_sigma) + exact.count * log_sigma

    sampler = MCMC(
        NUTS(potential_fn=potential),
        num_warmup=warmup,
        num_samples=draws,
        num_chains=chains,
        chain_method="sequential",
        progress_bar=False,
    )
    kept = Path(tempfile.mkdtemp(prefix="starcal-bench-"))
    seeds = iter(range(10_000))

    def run() -> Result:
        seed = next(seeds)
        path = kept / f"{seed}.npy"
        start = jnp.asarray(np.random.default_rng(seed).standard_normal((chains, 6)))
        sampler.run(jax.random.PRNGKey(seed), init_params=start, extra_fields=("num_steps",))
        np.save(path, exact.parameters(np.asarray(sampler.get_samples(group_by_chain=True))))
        return {
            "draws": str(path),
            "evaluations": int(np.sum(sampler.get_extra_fields()["num_steps"])),
        }

    return run
