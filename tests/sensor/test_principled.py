"""The principled surface in NumPy against Mitsuba's."""

import numpy as np
import pytest

from qs3.sensor.light.materials import MATERIALS, Material
from qs3.sensor.light.path import _bsdf
from qs3.sensor.light.principled import Surfaces

UP = np.array([0.0, 0.0, 1.0], np.float32)
SURFACES = {name: MATERIALS[name] for name in ("diffuse", "principled", "glossy-plastic", "metal")}
SURFACES["mixed"] = Material("principled", albedo=0.3, roughness=0.6, metallic=0.5, ior=1.3)


@pytest.fixture
def mi():
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def directions(rng, count):
    way = rng.normal(size=(count, 3))
    return (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("name", SURFACES)
def test_principled_surfaces_are_those_of_mitsuba(mi, rng, name):
    material, count = SURFACES[name], 200
    viewer, way = directions(rng, count), directions(rng, count)
    viewer[:, 2] = np.abs(viewer[:, 2])
    # Half of them near the mirror's direction, where the highlight is.
    near = viewer[::2] * [-1, -1, 1] + 0.1 * rng.normal(size=(count // 2, 3))
    way[::2] = near / np.linalg.norm(near, axis=1, keepdims=True)
    bsdf, si = mi.load_dict(_bsdf(material)), mi.SurfaceInteraction3f()
    theirs = []
    for eye, to in zip(viewer, way, strict=True):
        si.wi = mi.Vector3f(eye.tolist())
        theirs.append(np.pi * bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(to.tolist()))[0])
    surfaces = Surfaces.of([material])[np.zeros(count, int)]
    ours = surfaces.reflected(np.tile(UP, (count, 1)), viewer, way)
    np.testing.assert_allclose(ours, theirs, rtol=5e-3, atol=1e-6)


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("eye", [(0.6, 0.0, 0.8), (0.0, 0.0, 1.0), (0.96, 0.0, 0.28)])
def test_drawn_directions_bring_all_the_light_that_the_surface_reflects(mi, rng, name, eye):
    """Mean weight and direction are those of Mitsuba's own draws: with even light from all sides
    and with light that grows to one side."""
    count, fewer = 100_000, 5_000
    viewer = np.tile(np.array(eye, np.float32), (count, 1))
    surfaces = Surfaces.of([SURFACES[name]])[np.zeros(count, int)]
    numbers = rng.random((2, count)).astype(np.float32)
    way, weight = surfaces.sample(np.tile(UP, (count, 1)), viewer, *numbers)
    np.testing.assert_allclose(np.linalg.norm(way[weight > 0], axis=1), 1, atol=1e-4)
    bsdf, si = mi.load_dict(_bsdf(SURFACES[name])), mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*eye)
    theirs = []
    for one, two in zip(rng.random(fewer), rng.random((fewer, 2)), strict=True):
        sample, value = bsdf.sample(mi.BSDFContext(), si, one, mi.Point2f(two.tolist()))
        theirs.append(value[0] * np.array([1, *sample.wo]))
    mine = weight[:, None] * np.c_[np.ones(count), way]
    error = np.sqrt(mine.var(axis=0) / count + np.var(theirs, axis=0) / fewer)
    assert (np.abs(mine.mean(axis=0) - np.mean(theirs, axis=0)) < 4 * error + 1e-5).all()
