"""Disney's principled surface in NumPy, as far as `qs3.sensor.light.materials.Material` has it.

A diffuse base with retro-reflection (Burley 2012) below a GGX coat (Walter et al. 2007) with
Fresnel's reflectance of a dielectric, Schlick's of a metal. The mean of many samples is what
Mitsuba's ``principled`` gives (``test_principled_surfaces_are_those_of_mitsuba``).

Convention:
    Directions are unit vectors that leave the surface; ``normals`` face the viewer.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int

from qs3.sensor.light.materials import Material

Directions = Float32[np.ndarray, "n 3"]
Numbers = Float32[np.ndarray, "n"]

_LEAST_ALPHA = 1e-3  # Mitsuba's: smoother surfaces are as smooth as this


@dataclass(frozen=True)
class Surfaces:
    """Numbers of the surface at each of n places."""

    principled: Bool[np.ndarray, "n"]
    """False is Lambert's."""
    albedo: Numbers
    roughness: Numbers
    metallic: Numbers
    ior: Numbers

    @classmethod
    def of(cls, materials: list[Material]) -> "Surfaces":
        """One for each material."""
        numbers = (
            np.array([getattr(material, name) for material in materials], np.float32)
            for name in ("albedo", "roughness", "metallic", "ior")
        )
        return cls(np.array([m.model == "principled" for m in materials]), *numbers)

    def __getitem__(self, which: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> "Surfaces":
        """Return those of some places."""
        return Surfaces(*(values[which] for values in vars(self).values()))

    @property
    def alpha(self) -> Numbers:
        """Width of the lobe about the mirror's direction."""
        return np.maximum(self.roughness**2, np.float32(_LEAST_ALPHA))

    def reflected(self, normals: Directions, viewer: Directions, way: Directions) -> Numbers:
        """Return π times the share of light from ``way`` that goes to the viewer, times its cosine.

        So a white Lambert surface has the cosine.
        """
        cosine = np.maximum(_dot(normals, way), 0)
        shares = self.albedo * cosine
        if self.principled.any():
            which = self.principled
            shares[which] = self[which]._shine(normals[which], viewer[which], way[which])
        return shares

    def _shine(self, normals: Directions, viewer: Directions, way: Directions) -> Numbers:
        seen, lit = _dot(normals, viewer), _dot(normals, way)
        half = viewer + way
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), np.float32(1e-12))
        between, up = _dot(half, way), _dot(half, normals)
        squared = self.alpha**2
        base = 1 - up**2 + squared * up**2
        spread = squared / np.maximum(np.pi * base**2, np.float32(1e-30))
        masked = _unmasked(seen, squared) * _unmasked(lit, squared)
        coat = (1 - self.metallic) * _fresnel(between, self.ior)
        coat += self.metallic * (self.albedo + (1 - self.albedo) * _schlick(between))
        specular = np.pi * coat * spread * masked / (4 * np.maximum(seen, np.float32(1e-6)))
        towards, back = _schlick(lit), _schlick(seen)
        retro = 2 * self.roughness * between**2
        diffuse = (1 - towards / 2) * (1 - back / 2)
        diffuse += retro * (towards + back + towards * back * (retro - 1))
        diffuse *= (1 - self.metallic) * self.albedo * lit
        return np.where((seen > 0) & (lit > 0), specular + diffuse, 0).astype(np.float32)

    def sample(
        self, normals: Directions, viewer: Directions, p: Numbers, q: Numbers
    ) -> tuple[Directions, Numbers]:
        """Draw directions from numbers in 0…1, with the weight of the light from each.

        By Lambert's cosine, or for the coat by the slopes that the viewer sees (Heitz 2018); the
        weights are those of a mixture of both (Veach and Guibas 1995).
        """
        share = np.zeros_like(p)
        which = np.flatnonzero(self.principled)
        own, up, eye = self[which], normals[which], viewer[which]
        share[which] = own._coat_share(_dot(up, eye))
        coat = p < share
        p = np.where(coat, p / np.maximum(share, 1e-6), (p - share) / np.maximum(1 - share, 1e-6))
        way, weight = cosine_directions(normals, p, q), self.albedo.copy()
        if len(which):
            shiny, mine = np.flatnonzero(coat), coat[which]
            way[shiny] = _seen_slopes(up[mine], eye[mine], own.alpha[mine], p[shiny], q[shiny])
            there, share = way[which], share[which]
            density = (1 - share) * np.maximum(_dot(up, there), 0)
            density += share * np.pi * _seen_density(up, eye, there, own.alpha)
            shine = own.reflected(up, eye, there)
            weight[which] = np.where(shine > 0, shine / np.maximum(density, 1e-12), 0)
        return way, weight

    def _coat_share(self, seen: Numbers) -> Numbers:
        """Return the share of samples that go to the coat; 1 for a metal."""
        coat = (1 - self.metallic) * _fresnel(seen, self.ior)
        coat += self.metallic * (self.albedo + (1 - self.albedo) * _schlick(seen))
        base = (1 - self.metallic) * self.albedo
        return np.clip(coat / np.maximum(coat + base, np.float32(1e-6)), np.float32(0.1), 1)


def cosine_directions(normals: Directions, p: Numbers, q: Numbers) -> Directions:
    """Directions around ``normals`` by Lambert's cosine."""
    radius, angle = np.sqrt(np.maximum(0, p)), np.float32(2 * np.pi) * q
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(np.maximum(0, 1 - p))
    first, second = _frame(normals)
    return x[:, None] * first + y[:, None] * second + z[:, None] * normals


def _frame(normals: Directions) -> tuple[Directions, Directions]:
    """Two directions across each normal (Duff et al. 2017)."""
    nx, ny, nz = normals.T
    sign = np.copysign(np.float32(1), nz)
    a = -1 / (sign + nz)
    b = nx * ny * a
    first = np.stack([1 + sign * nx * nx * a, sign * b, -sign * nx], axis=1)
    second = np.stack([b, sign + ny * ny * a, -ny], axis=1)
    return first, second


def _seen_slopes(
    normals: Directions, viewer: Directions, alpha: Numbers, p: Numbers, q: Numbers
) -> Directions:
    """Draw mirror directions about half vectors by the density that the viewer sees."""
    first, second = _frame(normals)
    flat = np.stack([alpha, alpha, np.ones_like(alpha)], axis=1)
    eye = flat * np.stack([_dot(viewer, axis) for axis in (first, second, normals)], axis=1)
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    aside = np.hypot(eye[:, 0], eye[:, 1])
    turned = np.stack([-eye[:, 1], eye[:, 0]], axis=1) / np.maximum(aside, 1e-12)[:, None]
    across = np.zeros_like(eye)
    across[:, :2] = np.where((aside > 1e-6)[:, None], turned, [1, 0])
    along = np.cross(eye, across)
    # A disc across the line of sight, of which the half that turns away is seen shortened.
    radius, angle = np.sqrt(p), np.float32(2 * np.pi) * q
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    rim, share = np.sqrt(np.maximum(0, 1 - x**2)), (1 + eye[:, 2]) / 2
    y = (1 - share) * rim + share * y
    z = np.sqrt(np.maximum(0, 1 - x**2 - y**2))
    slope = flat * (x[:, None] * across + y[:, None] * along + z[:, None] * eye)
    slope[:, 2] = np.maximum(slope[:, 2], 1e-6)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    half = slope[:, :1] * first + slope[:, 1:2] * second + slope[:, 2:] * normals
    way = 2 * _dot(viewer, half)[:, None] * half - viewer
    return way.astype(np.float32)


def _seen_density(
    normals: Directions, viewer: Directions, way: Directions, alpha: Numbers
) -> Numbers:
    """Density over the sphere of the directions that `_seen_slopes` draws."""
    half = viewer + way
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), np.float32(1e-12))
    up, seen, squared = _dot(half, normals), _dot(viewer, normals), alpha**2
    base = 1 - up**2 + squared * up**2
    spread = squared / np.maximum(np.pi * base**2, np.float32(1e-30))
    density = spread * _unmasked(seen, squared) / (4 * np.maximum(seen, np.float32(1e-6)))
    return np.where(_dot(viewer, half) > 0, density, 0)


def _unmasked(cosine: Numbers, squared: Numbers) -> Numbers:
    """Share of the slopes that a direction sees (Smith)."""
    cosine = np.maximum(cosine, np.float32(1e-6))
    tangent = np.maximum(1 / cosine**2 - 1, 0)
    return 2 / (1 + np.sqrt(1 + squared * tangent))


def _schlick(cosine: Numbers) -> Numbers:
    return (1 - np.clip(cosine, 0, 1)) ** 5


def _fresnel(cosine: Numbers, ior: Numbers) -> Numbers:
    """Reflectance of a dielectric for unpolarised light."""
    inside = np.sqrt(np.maximum(0, 1 - (1 - cosine**2) / ior**2))
    across = (cosine - ior * inside) / (cosine + ior * inside)
    along = (inside - ior * cosine) / (inside + ior * cosine)
    return (across**2 + along**2) / 2


def _dot(a: Directions, b: Directions) -> Numbers:
    return np.einsum("ij,ij->i", a, b)
