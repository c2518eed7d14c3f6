"""Runs through made-up worlds, whose embeddings tell the position and how far it can be known."""

import numpy as np

from uncertain_place_recognition.embedded_run import EmbeddedRun

D = 24
_RNG = np.random.default_rng(7)
_WAVES = _RNG.normal(0.0, 0.02, (2, D))
_SPACES = np.linalg.qr(_RNG.normal(size=(5, D, D)))[0]


def place_code(positions, space=None):
    """Embeddings [N x D] that change smoothly with the position; `space` turns them."""
    code = np.cos(positions @ _WAVES + np.arange(D)) + 0.3
    return code if space is None else code @ _SPACES[space]


def made_run(name, world='town', submaps=60, noise=0.1, seed=0, apart=False, bad=0.15):
    """A run along a street; a share of submaps is blurred, which members disagree about."""
    rng = np.random.default_rng([seed, *map(ord, name)])
    x = np.linspace(0.0, 900.0, submaps) + rng.normal(0, 3.0, submaps)
    positions = np.column_stack([x, 40.0 * np.sin(x / 150.0) + rng.normal(0, 2.0, submaps)])
    blur = np.where(rng.random(submaps) < bad, 3.0, 1.0)[:, None]
    common = noise * blur * rng.normal(size=(submaps, D))

    def members(count, turned):
        return np.stack(
            [
                place_code(positions, m if turned else None)
                + (common @ _SPACES[m] if turned else common)
                + 0.7 * noise * blur * rng.normal(size=(submaps, D))
                for m in range(count)
            ],
            axis=1,
        ).astype(np.float32)

    groups = {
        'teacher': members(1, False),
        'students': members(3, apart),
        'naive': members(3, True),
        'dropout': members(3, False),
        'stun': members(1, False),
        'stun_variance': np.repeat(noise**2 * blur**2, D, axis=1)[:, None].astype(np.float32),
    }
    stamps_ns = (np.arange(submaps) * 1_000_000_000).astype(np.int64)
    return EmbeddedRun(name, world, stamps_ns, positions, groups)
