"""Every format read back, and one clear line for every bad file."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import TOLD, InputError
from qs3.meshes import load_mesh

from ..clouds.hostile import refused

TETRA = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def tetra() -> trimesh.Trimesh:
    return trimesh.Trimesh(TETRA, FACES, process=False)


def same_surface(mesh: trimesh.Trimesh, triangles: np.ndarray) -> bool:
    def rows(values: np.ndarray) -> np.ndarray:
        flat = np.round(values.astype(float), 5).reshape(-1, 9)
        return flat[np.lexsort(flat.T)]

    return np.array_equal(rows(np.asarray(mesh.triangles)), rows(triangles))


@pytest.mark.parametrize("ending", ["off", "obj", "ply", "stl"])
def test_z_up_formats_come_back_as_written(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"solid.{ending}"
    tetra().export(path)
    mesh = load_mesh(path)
    assert same_surface(mesh, TETRA[FACES])
    again = load_mesh(path)
    assert np.array_equal(mesh.vertices, again.vertices)
    assert np.array_equal(mesh.faces, again.faces)


@pytest.mark.parametrize("ending", ["glb", "gltf"])
def test_convention_gltf_is_turned_from_y_up_to_z_up(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"solid.{ending}"
    if ending == "glb":
        tetra().export(path)
    else:
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(tetra())).items():
            (tmp_path / name.replace("model", "solid")).write_bytes(data)
    upright = np.stack([TETRA[:, 0], -TETRA[:, 2], TETRA[:, 1]], axis=1)
    assert same_surface(load_mesh(path), upright[FACES])
    assert same_surface(load_mesh(path, up="z"), TETRA[FACES])
    # A chair written by the standard stands again.
    chair = shapes.make("chair", 1)
    lying = chair.copy()
    lying.vertices = chair.vertices[:, [0, 2, 1]] * [1, 1, -1]
    lying.export(tmp_path / "chair.glb")
    np.testing.assert_allclose(load_mesh(tmp_path / "chair.glb").bounds, chair.bounds, atol=1e-5)


def test_y_up_obj_by_request(tmp_path: Path) -> None:
    tetra().export(tmp_path / "solid.obj")
    mesh = load_mesh(tmp_path / "solid.obj", up="y")
    upright = np.stack([TETRA[:, 0], -TETRA[:, 2], TETRA[:, 1]], axis=1)
    assert same_surface(mesh, upright[FACES])
    assert mesh.volume == pytest.approx(1)  # a turn, not a mirror


@pytest.mark.parametrize("head", ["OFF\n5 2 0", "OFF5 2 0", "OFF 5 2 0", "OFF\n# note\n\n5 2 7"])
def test_off_heads_and_polygons(tmp_path: Path, head: str) -> None:
    body = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n4 0 1 2 3\n3 0 1 4 255 0 0\n"
    path = tmp_path / "a.off"
    path.write_text(f"{head}\n{body}")
    mesh = load_mesh(path)
    assert len(mesh.faces) == 3
    assert mesh.area == pytest.approx(1.5)


def test_faces_without_area_and_loose_vertices_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "a.off"
    path.write_text("OFF\n5 3 0\n0 0 0\n1 0 0\n0 1 0\n2 0 0\n9 9 9\n3 0 1 2\n3 0 1 3\n3 1 1 2\n")
    mesh = load_mesh(path)
    assert len(mesh.faces) == 1
    assert len(mesh.vertices) == 3


POINTS_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
)
OFF3 = "OFF\n3 1 0\n{}\n{}\n{}\n3 0 1 {}\n"
BAD = {
    "garbage.off": ("hello, this is a letter\n", "cannot be read as OFF"),
    "empty.off": ("", "empty"),
    "noface.off": ("OFF\n2 0 0\n0 0 0\n1 1 1\n", "no faces"),
    "short.off": ("OFF\n4 4 0\n0 0 0\n1 0 0\n", "cut short"),
    "face.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "fewer corners"),
    "range.off": (OFF3.format("0 0 0", "1 0 0", "0 1 0", 7), "outside the range"),
    "nan.off": (OFF3.format("nan 0 0", "1 0 0", "0 1 0", 2), "NaN or infinite"),
    "zero.off": (OFF3.format("1 1 1", "1 1 1", "1 1 1", 2), "zero size"),
    "sliver.off": (OFF3.format("0 0 0", "1 0 0", "2 0 0", 2), "no face with an area"),
    "points.ply": (POINTS_PLY, "no faces"),
    "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", ""),
    "garbage.obj": ("dear reader\n", ""),
    "garbage.ply": ("dear reader\n", ""),
    "garbage.stl": ("dear reader\n", ""),
    "garbage.glb": ("dear reader\n", ""),
    "garbage.gltf": ("dear reader\n", ""),
    "mesh.xyz": ("0 0 0\n", "not a mesh format"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_give_one_line_with_their_name(tmp_path: Path, name: str) -> None:
    content, reason = BAD[name]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with refused(f"^{path}.*{reason}"):
        load_mesh(path)


FAULTS = {
    "g_vis.glb": 1,
    "s_endsolid.stl": 1,
    "s_nul.stl": 1,
    "o_2.obj": 0.5,
    "f_nohead.off": 0.5,
    "p_upper.ply": 0.5,
    "m3sparse.gltf": 5,
    "m3fan.gltf": 2,
}


@pytest.mark.data
@pytest.mark.parametrize("name", FAULTS)
def test_files_of_public_reports_have_their_area(shared_data: Path, name: str) -> None:
    assert load_mesh(shared_data / "faults" / name).area == pytest.approx(FAULTS[name], rel=1e-6)


@pytest.mark.parametrize("ending", ["ply", "stl", "glb", "off", "obj"])
def test_truncated_files_are_refused(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"cut.{ending}"
    trimesh.creation.icosphere(subdivisions=2).export(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.3 * len(whole))])
    with pytest.raises(InputError, match="cut"):
        load_mesh(path)


@pytest.mark.data
def test_artists_meshes_load(shared_data: Path) -> None:
    files = sorted((shared_data / "cad").glob("*/*.ply"))
    assert len(files) == 147
    for path in files:
        mesh = load_mesh(path)
        reference = trimesh.load(path, force="mesh", process=False)
        assert mesh.area == pytest.approx(reference.area, rel=1e-6)


@pytest.mark.parametrize("name", ["a.stl", "a.ply", "a.off", "a.obj", "a.glb"])
def test_faces_that_look_inwards_are_turned_and_said(tmp_path, caplog, name):
    """Of a closed mesh only: what is open has no inside."""
    outwards = trimesh.creation.cylinder(0.2, 1.0)
    inwards = outwards.copy()
    inwards.invert()
    for number, mesh in enumerate((outwards, inwards)):
        TOLD.clear()
        caplog.clear()
        path = tmp_path / f"{number}{name}"
        mesh.export(path)
        read = load_mesh(path)
        assert read.volume == pytest.approx(outwards.volume, rel=1e-4)
        assert [f"{path}: its faces look inwards, and are turned"] * number == caplog.messages
    open_one = inwards.copy()
    open_one.update_faces(np.arange(len(inwards.faces)) > 0)
    open_one.export(tmp_path / name)
    caplog.clear()
    assert load_mesh(tmp_path / name).volume < 0
    assert not caplog.messages


@pytest.mark.parametrize("part", ["bracket", "gear", "touching solids"])
def test_faces_that_look_inwards_are_turned_beside_slivers_and_touching_solids(tmp_path, part):
    """The faces without area of the parts are left out."""
    if part == "touching solids":
        solid = trimesh.util.concatenate([
            trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]]),
            trimesh.creation.box(bounds=[[1, 1, 0], [2, 2, 1]]),
        ])  # fmt: skip
    else:
        solid = shapes.make(part, seed=3)
    volume = solid.volume
    solid.invert()
    solid.export(tmp_path / "a.stl")
    assert load_mesh(tmp_path / "a.stl").volume == pytest.approx(volume, rel=1e-4)
