"""Whether the estimated error of the force covers the true one, for unseen contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.certify.unseen_contacts import HEIGHTS, draw_contacts
from avatar_core.contact.model import Status, estimate_error, prepare, step
from avatar_core.fem.elasticity import Elasticity
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum

_RADIUS = 8e-3  # of the tip, larger than it is ever above the surface [m]
_APPROACH = 4  # steps of its approach


@dataclass(frozen=True, eq=False)
class ForceErrors:
    """Forces of unseen contacts, each (n,) [N].

    force : of the step; error : its true error; estimate : its estimated error
    """

    force: np.ndarray
    error: np.ndarray
    estimate: np.ndarray

    @property
    def coverage(self) -> float:
        """Fraction of the contacts whose error does not exceed the estimate."""
        return float(np.mean(self.error <= self.estimate))

    @property
    def overestimate(self) -> float:
        """Median of the estimate over the error."""
        return float(np.median(self.estimate / self.error))


def force_errors(
    vademecum: Vademecum, elasticity: Elasticity, n: int, seed: int = 0
) -> ForceErrors:
    """Press a tip at ``n`` random points; the reference is full finite elements at equal depth."""
    contacts = draw_contacts(vademecum, n, seed)
    model = prepare(vademecum, (Tip("patch", _RADIUS),), cloud="off", effects=())
    force, depth, relative = np.zeros((3, n))
    for k, (tip, normal) in enumerate(zip(contacts.tip, contacts.normal, strict=True)):
        model.reset()
        for height in np.linspace(_RADIUS + HEIGHTS[1], 0.0, _APPROACH):
            status = step(model, (tip + height * normal)[None])
        assert status == Status.OK, f"contact {k} has status {status}"
        estimate_error(model)
        force[k], depth[k] = model.state.force[0], -model.state.gap[0]
        relative[k] = model.out.force_error[0] / np.linalg.norm(model.out.force[0])
    exact = depth / contacts.true_compliance(vademecum.surface, elasticity)
    return ForceErrors(force, np.abs(force - exact), relative * force)
