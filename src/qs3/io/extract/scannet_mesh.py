"""ScanNet10-like clouds: vertices of each object of the fused mesh.

The target domain S* of PointDA-10 was cut so: the vertices of one annotated instance of
``_vh_clean_2.ply``, moved to the origin, 2,048 of them drawn at random. The mesh is fused over
thousands of frames, so these clouds are smooth where those of raw depth are noisy.

Convention:
    z is up, the axes are the scene's (turned by its axisAlignment), right-handed: an object keeps
    its handedness. NOTE: the released ScanNet10 writes (x, z, y), which mirrors every object; the
    clouds made here are not mirrored. The box's middle is at x = y = 0, its lowest point at z = 0.

Source: Qin et al., "PointDAN", NeurIPS 2019 (https://github.com/canqin001/PointDAN).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import InputError
from qs3.files import read_json
from qs3.geometry import transform_points
from qs3.io.extract.run import ExtractedCloud
from qs3.io.extract.scannet import ScanNetSettings
from qs3.io.extract.scannet_scene import (
    ScanNetScene,
    SceneObject,
    axis_alignment,
    object_seed,
    read_objects,
    rest,
)
from qs3.reading import reading

NO_OBJECT = -1
_MESH, _SEGMENTS = "_vh_clean_2.ply", "_vh_clean_2.0.010000.segs.json"


def read_scene_mesh(
    scene: ScanNetScene, objects: Sequence[SceneObject]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Read the decimated mesh of a scene and give its vertices to objects.

    The vertices are in the scene's own frame, metres; with each comes the `SceneObject.id` of its
    object, −1 if it has none. A segment of two objects belongs to the first.
    """
    # Imported here: scenes cut by masks need no mesh library.
    import trimesh

    path, segments_path = scene.file(_MESH), scene.file(_SEGMENTS)
    with reading(path):
        mesh = trimesh.load(path, file_type="ply", process=False)
        vertices = np.asarray(getattr(mesh, "vertices", None), dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(vertices).all():
            raise InputError("a vertex is not finite")
    with reading(segments_path, "a list of segments"):
        segments = np.array(read_json(segments_path)["segIndices"], dtype=np.int64)
        if len(segments) != len(vertices):
            raise InputError(
                f"has {len(segments)} segIndices for {len(vertices)} vertices of {path.name}; "
                "they are of different releases"
            )
    owner = np.full(len(vertices), NO_OBJECT, dtype=np.int64)
    for item in reversed(objects):
        owner[np.isin(segments, np.array(item.segments, dtype=np.int64))] = item.id
    return vertices, owner


def cut_mesh_scene(
    scene: ScanNetScene, settings: ScanNetSettings, num_points: int = 2048
) -> Iterator[ExtractedCloud]:
    """Yield the objects of one scene as vertices of its fused mesh.

    Of an object ``num_points`` are drawn; one of fewer comes whole. Of the settings ``classes``,
    ``min_points`` and ``seed`` matter here.
    """
    objects = read_objects(scene, settings.class_names)
    align = axis_alignment(scene)
    vertices, owner = read_scene_mesh(scene, objects)
    for item in objects:
        own = np.flatnonzero(owner == item.id)
        if len(own) < settings.min_points:
            continue
        drawn = own
        if len(own) > num_points:
            rng = np.random.default_rng(object_seed(settings.seed, scene, item.id))
            drawn = np.sort(rng.choice(own, num_points, replace=False))
        points, origin = rest(transform_points(align, vertices[drawn]))
        source = {"label": item.label, "vertices": len(own), "origin": origin}
        yield ExtractedCloud(f"{scene.id}/{item.id}", item.class_name, points, scene.split, source)
