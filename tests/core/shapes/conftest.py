"""Points that several tests of shapes share."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(scope="session")
def cloud() -> np.ndarray:
    """Draw 60 points of a curved three-parameter family in 200 dimensions."""
    rng = np.random.default_rng(0)
    t = rng.uniform(-1, 1, (60, 3))
    features = np.hstack([t, 0.3 * t**2, 0.3 * t * t[:, [1, 2, 0]]])
    return features @ rng.standard_normal((9, 200))
