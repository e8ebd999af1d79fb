"""The band of the force on a tip: the forces that it exceeds with 95 and 5 % probability.

The ratio of each edge to the force at the present values is prepared for every load position and
some depths (:mod:`avatar_core.uncertainty.force_ratios`). A step looks it up with the weights w_j
of the load positions that carry the tip, and between two depths by their logarithm,

    F_edge(p) = F(p) exp( sum_j w_j(p) rho_j(ln d) ),        rho = ln (edge / F).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from avatar_core.common.array_table import ArrayTable, TableType, array, kind
from avatar_core.common.jit import entry
from avatar_core.contact.data import DATA
from avatar_core.contact.model import ContactData, compiled_for

RATIO, DEPTH = "force_band.ratio", "force_band.depth"  # names of the arrays beside a layout's

BAND = kind(
    "Band",
    ratio=array("T P depths 2", np.float32),  # rho of the low and the high edge
    depth=array("depths"),  # rising by a factor, at least two [m]
    edges=array("2 T 6"),  # forces [N] and torques [N m]
)


@entry
def force_band(data, band):  # type: ignore[no-untyped-def]
    """Write both edges of the wrench of each tip, from the last solution. Real-time safe.

    Beyond the prepared depths the ratios are those of the nearest depth.
    """
    out = data.out
    first, last = band.depth[0], band.depth.shape[0] - 2
    scale = 1.0 / np.log(band.depth[1] / first)
    for t in range(out.force.shape[0]):
        low = high = whole = 0.0
        if data.force[t] > 0.0:
            place = scale * np.log(max(-data.gap[t], first) / first)
            k = min(int(min(place, 1e3)), last)
            part = min(place - k, 1.0)
            for i in range(data.n_nodes[t]):
                w, at = data.weight[t, i, 0], band.ratio[t, data.nodes[t, i]]
                low += w * ((1.0 - part) * at[k, 0] + part * at[k + 1, 0])
                high += w * ((1.0 - part) * at[k, 1] + part * at[k + 1, 1])
                whole += w
        whole = max(whole, 1e-6)
        low, high = np.exp(low / whole), np.exp(high / whole)
        for d in range(3):
            band.edges[0, t, d] = low * out.force[t, d]
            band.edges[1, t, d] = high * out.force[t, d]
            band.edges[0, t, 3 + d] = low * out.torque[t, d]
            band.edges[1, t, 3 + d] = high * out.torque[t, d]


@cache
def _compiled() -> Any:
    return compiled_for(force_band, TableType(DATA), TableType(BAND))


class ForceBand:
    """The band of the forces of one loop.

    Parameters
    ----------
    data : ContactData
        Data of that loop.
    ratio : ndarray of float32, shape (n_tools, n_positions, n_depths, 2)
        Logarithm of the low and the high edge over the force.
    depth : ndarray, shape (n_depths,)
        Two depths or more, rising by a constant factor [m].

    Attributes
    ----------
    edges : ndarray, shape (2, n_tools, 6)
        Force [N] and torque [N m] of both edges, low first.
    """

    def __init__(self, data: ContactData, ratio: np.ndarray, depth: np.ndarray) -> None:
        self.edges = np.zeros((2, data.model.n_tools, 6))
        table = ArrayTable(BAND(ratio, depth, self.edges))
        self._update = partial(_compiled(), data.table, table)

    @staticmethod
    def of(data: ContactData, arrays: Mapping[str, np.ndarray]) -> ForceBand | None:
        """Return the band of a loop, if its arrays were prepared."""
        return ForceBand(data, arrays[RATIO], arrays[DEPTH]) if RATIO in arrays else None

    def update(self) -> None:
        """Write the edges of the forces of the last solution.

        Real-time safe, like :func:`avatar_core.contact.model.step`.
        """
        self._update()
