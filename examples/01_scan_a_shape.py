"""Scan a built-in shape and see how far the noisy cloud lies from the mesh.

Takes a few seconds. The rig has half the released scanner's resolution, to be quick.
"""

import numpy as np
from scipy.spatial import KDTree

import qs3
from qs3.meshes import sample_surface
from qs3.sensor.presets import load_sensor

rig = qs3.StereoRig(width=540, height=540, focal=750.0, baseline=0.1)
scan = qs3.scan(qs3.shapes.make("chair", seed=3), rig=rig, views=2, seed=0, num_points=1024)

surface = KDTree(sample_surface(scan.mesh, 50_000, np.random.default_rng(0)))
for name, cloud in (("noisy", scan.points), ("clean", scan.clean)):
    distance = surface.query(cloud)[0]
    print(f"{name} cloud {cloud.shape}: median distance to the mesh {np.median(distance):.4f}")
for number, view in enumerate(scan.views):
    print(
        f"view {number}: disparity σ {view.disparity_sigma:.3f} px, valid {view.valid_fraction:.0%}"
    )
print(f"released sensor: {load_sensor('paper').rig}")
