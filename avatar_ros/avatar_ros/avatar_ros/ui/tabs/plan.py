"""The plan: kept states, a report of them, and export of surfaces."""

from __future__ import annotations

from typing import Any

from avatar_ros.ui.plan.plan import Plan
from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.tabs.choices import NOTHING, set_options

REPORTS = {"HTML": ".html", "PDF": ".pdf"}
FORMATS = (".stl", ".vtp", ".obj")


class PlanTab:
    """Controls of the kept states."""

    def __init__(self, gui: Any, plan: Plan, chosen: Chosen) -> None:
        self._plan = plan
        gui.add_button("Undo the last change", hint="Ctrl+Z").on_click(lambda _: chosen.undo())
        self._note = gui.add_text("Note", "")
        gui.add_button("Keep this state").on_click(
            lambda event: plan.keep(self._note.value, event.client)
        )
        self._kept = gui.add_dropdown("Kept", (NOTHING,))
        group = gui.add_button_group("Kept state", ("return to it", "delete it"))
        group.on_click(self._on_kept)
        reports = gui.add_button_group("Report", tuple(REPORTS))
        reports.on_click(lambda event: plan.report(REPORTS[event.target.value], event.client))
        self._format = gui.add_dropdown("Format", FORMATS)
        gui.add_button("Export deformed surfaces").on_click(
            lambda _: plan.export(self._format.value)
        )
        gui.add_button(
            "Write the cut as a resection", hint="the plane of the cut, to build a new vademecum"
        ).on_click(lambda _: plan.resect())
        gui.add_markdown("Surfaces are in mm and LPS, as 3D Slicer takes them.")

    def _on_kept(self, event: Any) -> None:
        if event.target.value == "delete it":
            self._plan.drop(self._kept.value)
        else:
            self._plan.go_back(self._kept.value, event.client)

    def offer(self, labels: list[str]) -> None:
        """Offer kept states, the newest first."""
        set_options(self._kept, labels[::-1])
