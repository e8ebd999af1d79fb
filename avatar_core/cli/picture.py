"""Pictures of an organ under a tool, drawn with matplotlib."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar_core.contact.model import prepare, step
from avatar_core.contact.tool_path import palpation
from avatar_core.vademecum.model import Vademecum


def palpation_picture(
    vademecum: Vademecum, path: str | Path, radius: float = 5e-3, depth: float = 10e-3
) -> None:
    """Draw the organ under a push in the middle of its accessible surface, and the force curve.

    Left: deformed boundary seen from the front, coloured by displacement. Right: normal force
    over indentation, as the 1 kHz step computes it.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    model = prepare(vademecum, (radius,))
    tips = palpation(vademecum, radius, depth, 400)
    indentation, force = [], []
    deepest = int(np.argmin(np.linalg.norm(tips - tips[len(tips) // 2], axis=1)))
    cloud = model.out.cloud.copy()
    for k, tip in enumerate(tips[: deepest + 1]):
        step(model, tip[None].copy())
        indentation.append(-1e3 * model.state.gap[0])
        force.append(np.linalg.norm(model.out.force[0]))
        if k == deepest:
            cloud = model.out.cloud.copy()
    figure = plt.figure(figsize=(11, 4.6), layout="constrained")
    _draw_organ(figure, vademecum, cloud, tips[deepest])
    _draw_curve(figure, vademecum, np.array(indentation), np.array(force))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_organ(figure, vademecum: Vademecum, cloud: np.ndarray, tip: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    axes = figure.add_subplot(1, 2, 1)
    faces = vademecum.surface_faces
    corner = cloud[faces]
    front = np.argsort(corner[:, :, 1].mean(axis=1))  # painter's order, seen from anterior
    seen = np.cross(corner[:, 1, :3] - corner[:, 0, :3], corner[:, 2, :3] - corner[:, 0, :3])
    front = front[seen[front, 1] > 0]
    light = seen[front] / np.linalg.norm(seen[front], axis=1, keepdims=True)
    moved = 1e3 * np.linalg.norm(corner[front, :, 3:], axis=2).mean(axis=1)
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(0.0, moved.max()), "viridis")
    color = scale.to_rgba(moved)
    color[:, :3] *= (0.55 + 0.45 * np.clip(light @ np.array([-0.4, 0.75, 0.5]), 0, 1))[:, None]
    # radiological view: the patient's right is on the viewer's left
    flat = np.stack([-corner[front, :, 0], corner[front, :, 2]], axis=2) * 1e3
    axes.add_collection(
        PolyCollection(list(flat), facecolors=color, edgecolors="face", linewidths=0.2)
    )
    axes.plot(-tip[0] * 1e3, tip[2] * 1e3, "o", ms=9, mfc="none", mec="crimson", mew=2)
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_xlabel("patient right  <-  x [mm]  ->  left")
    axes.set_ylabel("z, superior [mm]")
    axes.set_title(f"{vademecum.name}: deformed organ, tool tip circled")
    figure.colorbar(scale, ax=axes, label="displacement [mm]", shrink=0.8)


def _draw_curve(figure, vademecum: Vademecum, indentation: np.ndarray, force: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    axes = figure.add_subplot(1, 2, 2)
    certificate = vademecum.certificate
    axes.plot(indentation, force, lw=2, label="1 kHz step")
    if certificate is not None:
        for error, alpha, label in (
            (certificate.force_worst, 0.15, "worst"),
            (certificate.force_mean, 0.35, "mean"),
        ):
            axes.fill_between(
                indentation,
                force * (1 - error),
                force * (1 + error),
                alpha=alpha,
                color="C0",
                lw=0,
                label=f"{label} certified error ({100 * error:.1f} %)",
            )
    axes.set_xlim(left=min(0.0, indentation.min()))
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("indentation of the tip [mm]")
    axes.set_ylabel("force on the tool [N]")
    axes.set_title("force over indentation, linear elastic")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=8)
