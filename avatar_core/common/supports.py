"""Names and limits of supports, for modules that need neither mesh nor finite elements."""

from __future__ import annotations

LEAST_STIFFNESS, MOST_STIFFNESS = 1.0, 1e12  # per area [N/m^3]
SUPPORT = "support."  # before the name of a support, the name of its coordinate
# Supports with a rule for a liver (avatar_core.geometry.attachments); other groups have any name.
ATTACHMENTS = ("cava_groove", "bare_area", "right_triangular", "left_triangular", "falciform")
