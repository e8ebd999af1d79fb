"""Materials to choose from on the planning page, with the source of each stiffness."""

from __future__ import annotations

from typing import NamedTuple

from avatar_core.common.supports import ATTACHMENTS, SUPPORT
from avatar_core.contact.effects import Tumour
from avatar_core.reduction.coordinates import RESECTION
from avatar_core.scene.model import Scene
from avatar_ros.ui.view.organ import Organ

# label and unit of each coordinate of the material, and the shown unit in SI
SLIDERS = {
    "young": ("E [kPa]", 1e3),
    "poisson": ("nu [-]", 1.0),
    "contrast": ("Tumour / E [-]", 1.0),
    RESECTION: ("Resection [-]", 1.0),
}

HINTS = {
    "young": "Young's modulus",
    "poisson": "Poisson's ratio",
    "contrast": "Young's modulus in the tumour over that around it",
    RESECTION: "Opened part of the cut: 0 whole, 1 opened as far as planned",
}
for _name in ATTACHMENTS:
    _words = _name.replace("_", " ").capitalize()
    SLIDERS[SUPPORT + _name] = (f"{_words} [kPa/mm]", 1e6)
    HINTS[SUPPORT + _name] = "Stiffness per area of this support"


class Preset(NamedTuple):
    """Young's modulus of a tissue.

    young_modulus : [Pa]; source : publication of the number
    """

    young_modulus: float
    source: str


_CASTERA = (
    "transient elastography at 50 Hz, least value of this stage (Castera et al., Gastroenterology "
    "128, 2005)"
)
PRESETS = {
    "as in the paper, 170 kPa": Preset(
        170e3, "González, Cueto and Chinesta, Computational patient avatars for surgery planning"
    ),
    "healthy liver, 5.5 kPa": Preset(
        5.5e3,
        "transient elastography at 50 Hz, mean of 429 healthy adults (Roulot et al., Journal of "
        "Hepatology 48, 2008)",
    ),
    "fibrosis F2, 7.1 kPa": Preset(7.1e3, _CASTERA),
    "fibrosis F3, 9.5 kPa": Preset(9.5e3, _CASTERA),
    "cirrhosis F4, 12.5 kPa": Preset(12.5e3, _CASTERA),
}


def source_of(name: str) -> str:
    """Return the source of a preset's stiffness, as Markdown."""
    return f"E from {PRESETS[name].source}."


def material_text(organ: Organ, values: dict[str, float]) -> str:
    """Return the material in force, by coordinate of an organ [SI], in one line."""
    poisson = values.get("poisson", organ.vademecum.material.poisson_ratio)
    contrast = values.get("contrast", organ.vademecum.contrast)
    inside = "; as stiff inside" if organ.structures else ""
    tumour = inside if contrast is None else f", tumour {contrast:.3g} x E"
    return f"E {values['young'] / 1e3:.4g} kPa, nu {poisson:.3g}{tumour}"


def values_of(scene: Scene) -> dict[str, float]:
    """Return a scene's values by coordinate [SI]; without its effect, a contrast is 1."""
    tumours = [effect.contrast for effect in scene.effects if isinstance(effect, Tumour)]
    contrast = tumours[0] if tumours else 1.0
    return scene.values | ({} if contrast is None else {"contrast": contrast})
