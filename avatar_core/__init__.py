"""Patient avatars: an organ becomes a vademecum that answers a haptic tool at 1 kHz.

::

    import avatar_core as av

    surface = av.read_surface("liver.obj")          # metres, RAS
    vademecum = av.build(surface)                   # about a minute; carries its own errors
    av.save(vademecum, "liver.h5")
    moved = vademecum.displacement_at(point, 2.0)   # (n_vertices, 3) [m] under 2 N
    model = av.prepare(vademecum, av.Scene())       # lays out and compiles; may fail
    data = model.data()                             # of one loop
    status = av.step(model, data, tips)             # 1 kHz; never fails: see data.out

Further doors: ``av.effects`` (friction, viscoelasticity, jaws, ...), ``av.register`` (to a cloud),
``av.calibrate`` (from touches), ``av.uncertainty`` (bands), ``av.mor`` (PGD, POD, Galerkin) and
``av.shapes`` (LLE, kriging, level sets). Each public name has an example. There, ``liver`` is
``av.phantom_liver(12e-3)`` and ``v`` its vademecum over Poisson's ratio. ``point`` lies on its
surface with the outward ``normal``; ``K`` is a sparse stiffness and ``F`` holds loads.

All lengths are in metres, forces in newtons. An error that a user can cure raises
:class:`AvatarError`, with one line that names cause and remedy.

``msg_docs/background/architecture.md`` has the rooms, in the order in which data flows and imports
may run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from avatar_core.common.lazy import lazy

# Imported when first asked for: the command and the nodes start without compiling or meshing.
_ORIGIN = {
    "Atlas": "atlas.model",
    "AtlasOptions": "atlas.growth",
    "AvatarError": "errors",
    "Budget": "vademecum.accuracy",
    "BuildRule": "offline.rule",
    "Calibration": "uncertainty.calibration",
    "Certificate": "vademecum.certificate",
    "Cloud": "registration.cloud",
    "ContactData": "contact.model",
    "ContactModel": "contact.model",
    "Coordinate": "reduction.coordinates",
    "CutSurface": "geometry.cut_surface",
    "Jaw": "geometry.tip",
    "LargeRule": "offline.large_deformation",
    "Material": "fem.elasticity",
    "OrganOptions": "pipeline",
    "OrganProblem": "pipeline",
    "Patient": "atlas.patient",
    "PatientOptions": "atlas.patient",
    "Registered": "registration.register",
    "RegistrationRule": "registration.rule",
    "ResponseSolver": "atlas.response",
    "Scene": "scene.model",
    "Status": "contact.status",
    "SupportOption": "offline.supports",
    "SurfaceMesh": "geometry.surface",
    "Tip": "geometry.tip",
    "Tool": "scene.model",
    "Vademecum": "vademecum.model",
    "Workers": "atlas.workers",
    "build": "pipeline",
    "calibrate": "uncertainty.calibration",
    "create_atlas": "atlas.growth",
    "effects": "contact.effects:",
    "estimate_error": "contact.model",
    "export": "scene.export",
    "extend_atlas": "atlas.growth",
    "load": "vademecum.storage:load_vademecum",
    "load_atlas": "atlas.storage",
    "mor": "reduction:",
    "organ_problem": "pipeline",
    "patient": "atlas.patient:patient_vademecum",
    "phantom_liver": "geometry.phantom",
    "prepare": "scene.prepare",
    "read_cloud": "registration.cloud",
    "read_scene": "scene.file",
    "read_surface": "geometry.surface",
    "register": "registration.register",
    "save": "vademecum.storage:save_vademecum",
    "shapes": "shapes:",
    "step": "contact.model",
    "step_many": "contact.many",
    "uncertainty": "uncertainty:",
}

__all__ = [*_ORIGIN]

if TYPE_CHECKING:
    from avatar_core import reduction as mor  # noqa: F401
    from avatar_core import shapes as shapes
    from avatar_core import uncertainty as uncertainty
    from avatar_core.atlas.growth import AtlasOptions as AtlasOptions
    from avatar_core.atlas.growth import create_atlas as create_atlas
    from avatar_core.atlas.growth import extend_atlas as extend_atlas
    from avatar_core.atlas.model import Atlas as Atlas
    from avatar_core.atlas.patient import Patient as Patient
    from avatar_core.atlas.patient import PatientOptions as PatientOptions
    from avatar_core.atlas.patient import patient_vademecum as patient  # noqa: F401
    from avatar_core.atlas.response import ResponseSolver as ResponseSolver
    from avatar_core.atlas.storage import load_atlas as load_atlas
    from avatar_core.atlas.workers import Workers as Workers
    from avatar_core.contact import effects as effects
    from avatar_core.contact.many import step_many as step_many
    from avatar_core.contact.model import ContactData as ContactData
    from avatar_core.contact.model import ContactModel as ContactModel
    from avatar_core.contact.model import estimate_error as estimate_error
    from avatar_core.contact.model import step as step
    from avatar_core.contact.status import Status as Status
    from avatar_core.errors import AvatarError as AvatarError
    from avatar_core.fem.elasticity import Material as Material
    from avatar_core.geometry.cut_surface import CutSurface as CutSurface
    from avatar_core.geometry.phantom import phantom_liver as phantom_liver
    from avatar_core.geometry.surface import SurfaceMesh as SurfaceMesh
    from avatar_core.geometry.surface import read_surface as read_surface
    from avatar_core.geometry.tip import Jaw as Jaw
    from avatar_core.geometry.tip import Tip as Tip
    from avatar_core.offline.large_deformation import LargeRule as LargeRule
    from avatar_core.offline.rule import BuildRule as BuildRule
    from avatar_core.offline.supports import SupportOption as SupportOption
    from avatar_core.pipeline import OrganOptions as OrganOptions
    from avatar_core.pipeline import OrganProblem as OrganProblem
    from avatar_core.pipeline import build as build
    from avatar_core.pipeline import organ_problem as organ_problem
    from avatar_core.reduction.coordinates import Coordinate as Coordinate
    from avatar_core.registration.cloud import Cloud as Cloud
    from avatar_core.registration.cloud import read_cloud as read_cloud
    from avatar_core.registration.register import Registered as Registered
    from avatar_core.registration.register import register as register
    from avatar_core.registration.rule import RegistrationRule as RegistrationRule
    from avatar_core.scene.export import export as export
    from avatar_core.scene.file import read_scene as read_scene
    from avatar_core.scene.model import Scene as Scene
    from avatar_core.scene.model import Tool as Tool
    from avatar_core.scene.prepare import prepare as prepare
    from avatar_core.uncertainty.calibration import Calibration as Calibration
    from avatar_core.uncertainty.calibration import calibrate as calibrate
    from avatar_core.vademecum.accuracy import Budget as Budget
    from avatar_core.vademecum.certificate import Certificate as Certificate
    from avatar_core.vademecum.model import Vademecum as Vademecum
    from avatar_core.vademecum.storage import load_vademecum as load  # noqa: F401
    from avatar_core.vademecum.storage import save_vademecum as save  # noqa: F401
else:
    __getattr__, __dir__ = lazy(__name__, _ORIGIN)
