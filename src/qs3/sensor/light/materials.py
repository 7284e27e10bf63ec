"""Surface materials: a few parameters that every renderer understands."""

from dataclasses import dataclass
from typing import Annotated, Literal

from qs3.checks import Bounds, Share, check
from qs3.errors import InputError, no_such


@dataclass(frozen=True)
class Material:
    """The surface of a body. ``principled`` is Disney's model, as Blender and Mitsuba have it."""

    model: Literal["diffuse", "principled", "mirror", "glass"] = "diffuse"
    """``diffuse`` (Lambert), ``principled``, perfect ``mirror`` or clear ``glass``."""
    albedo: Share = 0.8
    """Reflectance, 0 to 1: base colour of ``diffuse``, ``principled`` and ``mirror``."""
    roughness: Share = 0.5
    """Roughness of a principled surface, 0 to 1."""
    metallic: Share = 0.0
    """1 is a metal, 0 is not; principled only."""
    ior: Annotated[float, Bounds(1, above=True)] = 1.5
    """Index of refraction of glass and of a principled surface's coat, above 1."""

    def __post_init__(self) -> None:
        check(self, "material")
        for name, readers in _READERS.items():
            if not self.reads(name) and getattr(self, name) != getattr(type(self), name):
                raise InputError(
                    f"material: {self.model} never reads {name}; leave it out, or take model "
                    f"{' or '.join(readers)}"
                )

    def reads(self, name: str) -> bool:
        """Return whether a field of this name has an effect on this model."""
        return self.model in _READERS.get(name, (self.model,))

    @property
    def rough(self) -> bool:
        """Return whether both cameras may be shown the same soft light on it: no mirror, no glass.

        NOTE: of a principled surface the projector's highlight is exact for each camera; what its
        coat mirrors of the soft light is taken as the left camera sees it. Of plastic that is a
        twentieth of the light.
        """
        return self.model in ("diffuse", "principled")

    @property
    def coat(self) -> float:
        """Return the share of the light it reflects straight back that is not diffuse."""
        if self.model != "principled":
            return 0.0 if self.model == "diffuse" else 1.0
        plastic = (1 - self.metallic) * ((self.ior - 1) / (self.ior + 1)) ** 2
        coat, base = plastic + self.metallic * self.albedo, (1 - self.metallic) * self.albedo
        return coat / (coat + base) if coat else 0.0


_READERS = {
    "albedo": ("diffuse", "principled", "mirror"),
    "roughness": ("principled",),
    "metallic": ("principled",),
    "ior": ("principled", "glass"),
}
"""Models that read a setting."""

MATERIALS: dict[str, Material] = {
    "diffuse": Material(),
    # Blender's default surface, the one of the paper's scenes.
    "principled": Material("principled"),
    "rough-specular": Material("principled", roughness=0.3),
    "glossy-plastic": Material("principled", albedo=0.6, roughness=0.08),
    "metal": Material("principled", albedo=0.9, roughness=0.25, metallic=1.0),
    "dark": Material(albedo=0.04),
    "mirror": Material("mirror", albedo=0.95),
    "glass": Material("glass"),
}


def get_material(name: Material | str) -> Material:
    """Return the named material, or raise an `InputError` that lists those there are.

    A material is returned as it is.
    """
    if isinstance(name, Material):
        return name
    if name not in MATERIALS:
        raise no_such(f"material: no {name!r}", str(name), MATERIALS)
    return MATERIALS[name]
