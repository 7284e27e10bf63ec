"""STEP, IGES and 3MF: sizes of any unit, assemblies placed, hostile files refused."""

import importlib.util
import re
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from qs3.errors import TOLD, InputError, MissingExtraError
from qs3.meshes import cad, collect, load_mesh
from qs3.meshes.cad import check_extra
from qs3.meshes.cad_text import prepare
from qs3.meshes.sizes import file_size

from ..clouds.hostile import refused
from .cad_files import box_3mf, curved, iges, step, with_twin, write_3mf

SIZE = (0.4, 0.3, 0.85)
PER_METRE = {"mm": 1000, "m": 1, "in": 1 / 0.0254}
step_and_iges = pytest.mark.skipif(
    importlib.util.find_spec("cascadio") is None, reason="cascadio is not here (extra cad)"
)


@pytest.fixture(autouse=True)
def this_process(monkeypatch) -> None:
    """Convert here: a process for each file takes a second to start."""

    def run(command, **_):
        code, fault = 0, ""
        try:
            cad._convert(*map(Path, command[-2:]))
        except (Exception, SystemExit) as error:
            code, fault = 1, str(error)
        return SimpleNamespace(returncode=code, stderr=fault.encode())

    monkeypatch.setattr(cad, "limit_memory", lambda path: None)
    monkeypatch.setattr(cad, "subprocess", SimpleNamespace(**vars(subprocess) | {"run": run}))


@pytest.fixture
def own_process(monkeypatch) -> None:
    """Convert as users do."""
    monkeypatch.setattr(cad, "subprocess", subprocess)


def scaled(unit: str) -> list[float]:
    return [PER_METRE[unit] * side for side in SIZE]


@step_and_iges
@pytest.mark.parametrize("unit", ["mm", "m", "in"])
@pytest.mark.usefixtures("own_process")
def test_step_and_iges_have_the_size_that_they_tell_and_z_up(tmp_path: Path, unit: str) -> None:
    number = {"mm": (2, "MM"), "m": (6, "M"), "in": (1, "IN")}[unit]
    for name, text in (("a.step", step(scaled(unit), unit)), ("a.IGS", iges(scaled(unit), number))):
        path = tmp_path / name
        path.write_text(text)
        mesh = load_mesh(path)
        assert file_size(mesh, "cm")[0] == pytest.approx(0.85, rel=1e-6)
        np.testing.assert_allclose(mesh.extents / mesh.extents[2] * 0.85, SIZE, rtol=1e-5)
        assert mesh.area == pytest.approx(1.43 * (mesh.extents[2] / 0.85) ** 2, rel=1e-5)
        if unit == "mm":
            assert np.array_equal(load_mesh(path).triangles, mesh.triangles)


@step_and_iges
@pytest.mark.parametrize("unit", PER_METRE)
def test_step_in_small_letters_is_the_same(tmp_path: Path, unit: str, caplog) -> None:
    TOLD.clear()
    path = tmp_path / "A.step"
    small = re.sub(r"[^']+|'[^']*'", lambda word: word[0].lower(), step(scaled(unit), unit))
    path.write_text(small)
    assert file_size(load_mesh(path), "cm")[0] == pytest.approx(0.85, rel=1e-6)
    assert f"A.step is in {unit}, not units cm" in caplog.text


@step_and_iges
def test_an_assembly_is_merged_with_its_transforms(tmp_path: Path) -> None:
    path = tmp_path / "two.stp"
    upright = ((0, 0, 0), (0, 0, 1), (1, 0, 0))
    path.write_text(step(scaled("mm"), "mm", [upright, ((2000, 0, 0), (0, 0, 1), (0, 1, 0))]))
    mesh = load_mesh(path)
    # The second is turned by 90° about z: its y, 0.3, goes to −x and its x, 0.4, to y.
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [2, 0.4, 0.85]], atol=1e-6)
    second = mesh.vertices[mesh.vertices[:, 0] > 1]
    np.testing.assert_allclose(second.min(axis=0), [1.7, 0, 0], atol=1e-6)
    assert mesh.area == pytest.approx(2 * 1.43)


@pytest.mark.parametrize("unit", ["millimeter", "inch", "meter"])
def test_3mf_places_its_parts_and_tells_its_unit(tmp_path: Path, unit: str) -> None:
    length = {"millimeter": "mm", "inch": "in", "meter": "m"}[unit]
    size = scaled(length)
    nested = (
        '<object id="2"><components><component objectid="1"/><component objectid="1" '
        f'transform="1 0 0 0 1 0 0 0 1 {PER_METRE[length]} 0 0"/></components></object>'
    )
    path = write_3mf(tmp_path / "a.3mf", box_3mf(size) + nested, '<item objectid="2"/>', unit)
    mesh = load_mesh(path)
    expected = np.array([[0, 0, 0], [1.4, 0.3, 0.85]]) * PER_METRE[length]
    np.testing.assert_allclose(mesh.bounds, expected, atol=1e-9)
    assert file_size(mesh)[0] == pytest.approx(1.4)


def test_damaged_3mf_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write_3mf(tmp_path / "a.3mf", "<object", "")
    with refused("cannot be read as 3MF", path):
        load_mesh(path)
    path.write_bytes(b"PK no archive")
    with refused("cannot be read as 3MF", path):
        load_mesh(path)


@step_and_iges
@pytest.mark.parametrize("name", ["a.step", "a.iges"])
@pytest.mark.usefixtures("own_process")
def test_a_damaged_cad_file_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"ISO-10303-21; dear reader\n\x1b[2J")
    with refused(f"cannot be read as {name[2:].upper()}"):
        load_mesh(path)


@pytest.mark.skipif(sys.platform != "linux", reason="signals end a process elsewhere otherwise")
@pytest.mark.usefixtures("own_process")
def test_a_crash_of_the_library_is_that_file_s_fault(tmp_path: Path, monkeypatch) -> None:
    """Stands in for the interpreter with a program that dies of a segmentation fault."""
    program = tmp_path / "crash"
    program.write_text("#!/bin/sh\nkill -SEGV $$\n")
    program.chmod(0o755)
    monkeypatch.setattr(cad.sys, "executable", str(program))
    (tmp_path / "a.step").write_text("ISO-10303-21;")
    with pytest.raises(InputError, match=r"a\.step.*ended: -11"):
        cad.to_glb(tmp_path / "a.step")


def test_without_the_extra_it_is_named_before_the_first_mesh(tree, monkeypatch) -> None:
    monkeypatch.setattr(cad.importlib.util, "find_spec", lambda name: None)
    root = tree("cup/a.off", "cup/b.step", "lid/c.STEP")
    with pytest.raises(MissingExtraError, match=r"cascadio.*extra 'cad'"):
        collect(root)
    for ending in cad.UNITS:
        with pytest.raises(MissingExtraError, match="cad"):
            check_extra(ending)
    check_extra(".off")


def test_what_is_not_read_is_listed(tree, caplog) -> None:
    root = tree("cup/a.off", "cup/a.dwg", "lid/b.obj", "lid/b.MTL", "lid/c.mtl", "README")
    assert len(collect(root)) == 2
    assert caplog.messages == [f"{root}: not read: 1 .dwg, 2 .mtl, 1 README"]
    with pytest.raises(InputError, match=r"holds no mesh.*it has 1 \.dwg"):
        collect(tree("only/x.dwg") / "only")


def corner_3mf(edge: float) -> str:
    """A tetrahedron with three right angles at its first vertex; its area is 2.366 · edge²."""
    rows = "".join(
        f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in np.vstack([[0] * 3, edge * np.eye(3)])
    )
    sides = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in sides)
    mesh = f"<mesh><vertices>{rows}</vertices><triangles>{triangles}</triangles></mesh>"
    return f'<object id="1">{mesh}</object>'


def chain_3mf(length: int, uses: int = 1, first: int = 1) -> str:
    """Objects from 2 up; each holds the one before it, object 2 holds ``first``."""
    return "".join(
        f'<object id="{name}"><components>'
        + f'<component objectid="{below}"/>' * uses
        + "</components></object>"
        for name, below in enumerate([first, *range(2, length + 1)], 2)
    )


@pytest.mark.parametrize("kind", ["item", "component"])
def test_ids_of_3mf_belong_to_their_own_part(tmp_path: Path, kind: str, caplog) -> None:
    uses = "".join(
        f'<{kind} p:path="/3D/{name}.model" objectid="1" transform="1 0 0 0 1 0 0 0 1 {x} 0 0"/>'
        for name, x in (("a", 0), ("b", 20))
    )
    whole = f'<object id="1"><components>{uses}</components></object>'
    build = ("", uses) if kind == "item" else (whole, '<item objectid="1"/>')
    parts = {"a": corner_3mf(10), "b": corner_3mf(5)}
    mesh = load_mesh(write_3mf(tmp_path / "a.3mf", *build, model='requiredextensions="p"', **parts))
    assert mesh.area == pytest.approx(295.753, abs=1e-3)
    np.testing.assert_allclose(mesh.extents, (25, 10, 10))
    assert mesh.volume == pytest.approx((10**3 + 5**3) / 6)
    # Of several parts on a print plate one is meant; an assembly is one object.
    assert ("a.3mf: holds 2 items of a build" in caplog.text) == (kind == "item")


def test_3mf_leaves_out_what_is_not_printed(tmp_path: Path, caplog) -> None:
    """A tetrahedron of 10 mm beside one of 50 mm that only helps to print it."""
    part, size = corner_3mf(10), 236.6025
    moved = 'transform="1 0 0 0 1 0 0 0 1 100 0 0"'
    items = '<item objectid="1"/><item objectid="2"/>'
    whole = f'<object id="3"><components><component objectid="1"/><component objectid="2" {moved}/>'
    whole += "</components></object>"
    helper = corner_3mf(50).replace('id="1"', 'id="2"')
    for kind in ("support", "solidsupport", "other"):
        typed = helper.replace("<object", f'<object type="{kind}"')
        for objects, build in (
            (part + typed, items),
            (part + typed + whole, '<item objectid="3"/>'),
        ):
            mesh = load_mesh(write_3mf(tmp_path / "a.3mf", objects, build))
            assert mesh.area == pytest.approx(size, rel=1e-6)
    for kind in ("model", "surface"):
        typed = helper.replace("<object", f'<object type="{kind}"')
        mesh = load_mesh(write_3mf(tmp_path / "a.3mf", part + typed, items))
        assert mesh.area == pytest.approx(26 * size, rel=1e-6)
    for kind in ("support", "anti_overhang", "infill", "cutting"):
        for value, area in (("True", size), ("False", 26 * size)):
            named = f'<metadatagroup><metadata name="cura:{kind}_mesh">{value}</metadata>'
            typed = helper.replace("<mesh>", f"{named}</metadatagroup><mesh>")
            mesh = load_mesh(write_3mf(tmp_path / "a.3mf", part + typed, items))
            assert mesh.area == pytest.approx(area, rel=1e-6)
    unprinted = items.replace('objectid="2"', 'objectid="2" printable="0"')
    mesh = load_mesh(write_3mf(tmp_path / "a.3mf", part + helper, unprinted))
    assert mesh.area == pytest.approx(size, rel=1e-6)
    for build in ('<item objectid="2" printable="0"/>', ""):
        with refused("has no faces that are printed; its build has no item to print: place the"):
            load_mesh(write_3mf(tmp_path / "a.3mf", helper, build))


def test_3mf_leaves_out_what_a_slicer_marks_as_no_part(tmp_path: Path, caplog) -> None:
    TOLD.clear()
    both = box_3mf((10, 10, 10)).partition("</mesh>")[0]
    more = "".join(
        f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in np.vstack([[0] * 3, 90 * np.eye(3)])
    )
    both = both.replace("</vertices>", f"{more}</vertices>").replace(
        "</triangles>", '<triangle v1="8" v2="10" v3="9"/></triangles></mesh></object>'
    )
    for kind, is_part in {
        "ModelPart": True,
        "SupportBlocker": False,
        "SupportEnforcer": False,
        "ParameterModifier": False,
        "NegativeVolume": False,
    }.items():
        volumes = "".join(
            f'<volume firstid="{first}" lastid="{last}">'
            f'<metadata type="volume" key="volume_type" value="{value}"/></volume>'
            for first, last, value in ((0, 11, "ModelPart"), (12, 12, kind))
        )
        settings = "Slic3r_PE_model.config", f'<object id="1">{volumes}</object>'
        path = write_3mf(tmp_path / "a.3mf", both, '<item objectid="1"/>', settings=settings)
        assert load_mesh(path).area == pytest.approx(600 + 4050 * is_part)
    assert "negative volumes are left out" in caplog.text
    old = '<volume firstid="12" lastid="12"><metadata key="modifier" value="1"/></volume>'
    settings = "Slic3r_PE_model.config", f'<object id="1">{old}</object>'
    path = write_3mf(tmp_path / "a.3mf", both, '<item objectid="1"/>', settings=settings)
    assert load_mesh(path).area == pytest.approx(600)
    whole = '<object id="9"><components><component p:path="/3D/a.model" objectid="1"/>'
    whole += '<component p:path="/3D/a.model" objectid="2"/></components></object>'
    parts = corner_3mf(10) + corner_3mf(50).replace('id="1"', 'id="2"')
    for kind in ("normal", "negative", "modifier"):
        rows = f'<part id="1" subtype="normal_part"/><part id="2" subtype="{kind}_part"/>'
        settings = "model_settings.config", f'<object id="9">{rows}</object>'
        path = write_3mf(
            tmp_path / "a.3mf", whole, '<item objectid="9"/>', settings=settings, a=parts
        )
        wanted = 26 if kind == "normal" else 1
        assert load_mesh(path).area == pytest.approx(wanted * 236.6025, rel=1e-6)


@pytest.mark.data
@pytest.mark.parametrize("name", ["t_sup", "t_other", "t_prusa"])
def test_supports_and_blockers_of_public_reports_are_left_out(shared_data: Path, name: str) -> None:
    mesh = load_mesh(shared_data / "faults" / f"{name}.3mf")
    assert mesh.area == pytest.approx(236.6025, rel=1e-6)
    assert mesh.extents.tolist() == [10, 10, 10]


def test_a_long_chain_of_components_is_no_circle(tmp_path: Path) -> None:
    mirror = 'transform="-1 0 0 0 1 0 0 0 1 0 0 0"'
    build = f'<item objectid="901" {mirror}/>'
    mesh = load_mesh(write_3mf(tmp_path / "a.3mf", corner_3mf(10) + chain_3mf(900), build))
    assert mesh.bounds.tolist() == [[-10, 0, 0], [0, 10, 10]]
    assert mesh.volume == pytest.approx(1000 / 6)  # its outside stays outside


@pytest.mark.parametrize(
    ("objects", "more", "message"),
    [
        (chain_3mf(3, first=4), {}, "circle"),
        (corner_3mf(1) + chain_3mf(40, uses=2), {}, "when all parts are placed"),
        (chain_3mf(3, first=9), {}, "object 9 of .*, which is not there"),
        (corner_3mf(1) + chain_3mf(3), {"model": 'requiredextensions="b"'}, "beamlattice"),
        (corner_3mf(1) + corner_3mf(2) + chain_3mf(3), {}, "has the object 1 twice"),
        (corner_3mf(1) + chain_3mf(3), {"unit": "parsec"}, "its unit 'parsec' is unknown"),
        *(
            (corner_3mf(1).replace("</mesh>", f"<b:{tag}/></mesh>") + chain_3mf(3), {}, tag)
            for tag in ("beamlattice", "displacementmesh", "levelset", "booleanshape")
        ),
        (
            corner_3mf(1).replace("<object", '<object b:meshresolution="lowres"') + chain_3mf(3),
            {},
            "shape of slices",
        ),
    ],
)
def test_3mf_that_cannot_be_placed_is_refused(tmp_path, objects, more, message) -> None:
    path = write_3mf(tmp_path / "a.3mf", objects, '<item objectid="4"/>', **more)
    with refused(message, path):
        load_mesh(path)


@pytest.mark.parametrize(
    ("target", "name"),
    [
        ("/3D/a%20part.model", "3D/a part.model"),
        ("/3D/a%20part.model", "3D/a%20part.model"),
        ("./3D/b.model", "3D/b.model"),
        ("/3D/b.model", "3D\\b.model"),
    ],
)
def test_parts_of_3mf_are_found_by_any_spelling_of_their_names(tmp_path, target, name) -> None:
    path = write_3mf(tmp_path / "plain.3mf", corner_3mf(10), '<item objectid="1"/>')
    model = zipfile.ZipFile(path).read("3D/3dmodel.model")
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    with zipfile.ZipFile(tmp_path / "a.3mf", "w") as archive:
        archive.writestr("_rels/.rels", f'<a><b Target="{target}" Type="{kind}"/></a>')
        archive.writestr(name, model)
    assert load_mesh(tmp_path / "a.3mf").area == pytest.approx(236.6025)


def test_3mf_larger_than_memory_is_refused_on_every_system(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("qs3.meshes.polygons._MOST", 100)
    path = write_3mf(tmp_path / "a.3mf", corner_3mf(1), '<item objectid="1"/>' * 30)
    with refused("120 triangles or vertices when all parts", path):
        load_mesh(path)
    monkeypatch.setattr("qs3.meshes.threemf._MOST_BYTES", 500)
    with refused("unpacks to .* bytes, over 500", path):
        load_mesh(path)


@step_and_iges
@pytest.mark.parametrize("name", ["a.step", "a.igs"])
def test_parts_of_nested_assemblies_are_counted_before_they_are_copied(
    tmp_path, monkeypatch, name
) -> None:
    path = tmp_path / name
    places = [((x, 0, 0), (0, 0, 1), (1, 0, 0)) for x in (0, 500)]
    size, is_step = (4, 3, 2), name == "a.step"
    path.write_text(step(size, "in", places, 3) if is_step else iges(size, depth=3))
    assert load_mesh(path).area == pytest.approx(2**3 * 52 * (0.0254**2 if is_step else 1))
    path.write_text(step(size, "in", places, 40) if is_step else iges(size, depth=40))
    monkeypatch.setattr(cad.subprocess, "run", None)
    with refused("places over 100000 parts; split it", path):
        load_mesh(path)


@step_and_iges
@pytest.mark.usefixtures("own_process")
def test_a_file_that_takes_too_long_is_refused(tmp_path, monkeypatch) -> None:
    (tmp_path / "a.step").write_text(step((4, 3, 2)))
    monkeypatch.setattr(cad, "_SECONDS", 0)
    with refused("takes over 0 s", tmp_path / "a.step"):
        load_mesh(tmp_path / "a.step")


@step_and_iges
def test_cad_files_that_are_cut_short_or_lack_records_are_refused(tmp_path: Path) -> None:
    whole, lines = step(SIZE), iges(SIZE).splitlines(keepends=True)
    faces = re.findall(r"#\d+=FACE_SURFACE.*\n", whole)
    body = re.search(r"FACETED_BREP_SHAPE_REPRESENTATION\('',\((#\d+)", whole)[1]
    item = "DATA;#9998=MAPPED_ITEM('',#1,#9999);"
    assembly = step(SIZE, places=[((500, 0, 0), (0, 0, 1), (1, 0, 0))])
    for name, text, message in (
        ("face.step", whole.replace(faces[0], ""), "which is missing"),
        ("loop.step", re.sub(r"#\d+=POLY_LOOP.*\n", "", whole, count=1), "which is missing"),
        ("body.step", whole.replace(f"({body},", f"({body},#9999,"), "names #9999"),
        ("place.step", re.sub(r"#\d+=ITEM_DEFINED.*\n", "", assembly, count=1), "which is missing"),
        ("item.step", whole.replace("DATA;", item), "names #9999"),
        ("end.step", whole.replace("END-ISO-10303-21;", ""), "no END-ISO-10303-21"),
        ("end.igs", "".join(lines[:-9]), "the file is cut short"),
        ("row.igs", "".join(lines[:-2] + lines[-1:]), "the file is cut short"),
        ("nan.step", whole.replace("(0.0,", "(-nan(ind),", 1), "holds -nan, which is no number"),
        ("ind.step", whole.replace("(0.0,", "(1.#IND00,", 1), "holds 1.#IND00, which is no number"),
        ("inf.step", whole.replace("(0.0,", "(-Infinity,", 1), "holds -Infinity, which is no"),
        ("nan.igs", "".join(lines).replace("110,0.0,", "110,NaN,", 1), "holds NaN, which is no"),
    ):
        (tmp_path / name).write_text(text)
        with refused(message, tmp_path / name):
            load_mesh(tmp_path / name)
    style = "#9998=DRAUGHTING_CALLOUT('',(#9999));\n"  # no shape
    (tmp_path / "a.step").write_text(whole.replace("DATA;\n", f"DATA;\n{style}"))
    np.testing.assert_allclose(load_mesh(tmp_path / "a.step").extents, np.array(SIZE) / 1000)
    part = iges(SIZE, depth=1)
    named = re.sub(r"1Hx(.*?;) {8}", r"9HNUT (INF)\1", part)
    (tmp_path / "a.igs").write_text(named)
    assert named != part
    assert load_mesh(tmp_path / "a.igs").extents[0] > 500
    for end in ("\n\n\n\n", f"{80 * ' '}\n" * 4):
        (tmp_path / "a.igs").write_text("".join(lines) + end)
        np.testing.assert_allclose(load_mesh(tmp_path / "a.igs").extents, SIZE, rtol=1e-6)


@step_and_iges
@pytest.mark.parametrize(
    ("pattern", "new"),
    [
        (r"\(\(#\d+,(#\d+,#\d+)\)\)", r"((\1))"),
        (r"GLOBAL_UNIT_ASSIGNED_CONTEXT\([^)]*\)\)", ""),
        ("a^", ""),
    ],
)
def test_step_without_a_unit_of_length_says_what_is_assumed(tmp_path, caplog, pattern, new) -> None:
    TOLD.clear()
    text = step(SIZE)
    (tmp_path / "a.step").write_text(re.sub(pattern, new, text))
    np.testing.assert_allclose(load_mesh(tmp_path / "a.step").extents, np.array(SIZE) / 1000)
    assert ("a.step: names no unit of length, and" in caplog.text) == (pattern != "a^")
    caplog.clear()
    (tmp_path / "page.step").write_text("<!DOCTYPE html>")
    with refused("it is a web page", tmp_path / "page.step"):
        load_mesh(tmp_path / "page.step")
    assert not caplog.text


def mapped(operator: str) -> str:
    """The box of `step` as a mapped item that ``operator`` places."""
    text, size = step((3, 2, 1)), "FACETED_BREP_SHAPE_REPRESENTATION"
    found = re.search(rf"(#\d+)={size}\('',\((#\d+),(#\d+)\),(#\d+)\);", text)
    shape, body, base, context = found.groups()
    rows = [
        f"{shape}=SHAPE_REPRESENTATION('',(#9500,{base}),{context})",
        f"#9400={size}('',({body},{base}),{context})",
        f"#9401=REPRESENTATION_MAP({base},#9400)",
        "#9500=MAPPED_ITEM('',#9401,#9510)",
        f"#9510={operator}",
        "#9511=CARTESIAN_POINT('',(10.,0.,0.))",
        *(
            f"#{9512 + at}=DIRECTION('',({x}.,{y}.,{z}.))"
            for at, (x, y, z) in enumerate([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)])
        ),
    ]
    return text.replace(found[0], "".join(f"{row};\n" for row in rows))


@step_and_iges
def test_mapped_items_of_step_stand_where_the_file_places_them(tmp_path: Path) -> None:
    path, name = tmp_path / "a.step", "CARTESIAN_TRANSFORMATION_OPERATOR_3D"
    for operator in (
        "AXIS2_PLACEMENT_3D('',#9511,#9514,#9512)",
        f"{name}('',#9512,#9513,#9511,1.,#9514)",
        f"{name}('','','',#9512,#9513,#9511,$,#9514)",
        f"{name}('',$,$,#9511,1.,$)",
    ):
        path.write_text(mapped(operator))
        np.testing.assert_allclose(
            load_mesh(path).bounds, [[0.01, 0, 0], [0.013, 0.002, 0.001]], atol=1e-8
        )
    for operator in (
        f"{name}('',#9512,#9513,#9511,2.,#9514)",
        f"{name}('',#9512,#9513,#9511,1.,#9515)",
    ):
        path.write_text(mapped(operator))
        with refused("mirrors or scales a part", path):
            load_mesh(path)


@step_and_iges
def test_hidden_shapes_of_step_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.step"
    text = mapped("AXIS2_PLACEMENT_3D('',#9511,#9514,#9512)")
    body, base = re.search(r"#9400=\w+\('',\((#\d+),(#\d+)\)", text).groups()
    shell = re.search(rf"{body}=FACETED_BREP\('',(#\d+)\);", text)[1]
    text = text.replace(f"({body},{base})", f"({body},#9600,{base})")
    text = text.replace("DATA;", f"DATA;\n#9600=SHELL_BASED_SURFACE_MODEL('',({shell}));")
    path.write_text(text)
    assert load_mesh(path).area == pytest.approx(44e-6)
    hide = "#{0}0=STYLED_ITEM('',(),{1});\n#{0}1=INVISIBILITY((#{0}0));\n"
    over = "#9703=OVER_RIDING_STYLED_ITEM('',(),#9600,#9700);\n"
    layers = "#9701=INVISIBILITY((#9702,#9704));\n#9704=PRESENTATION_LAYER_ASSIGNMENT('','',());\n"
    layers += "#9702=PRESENTATION_LAYER_ASSIGNMENT('','',({},#9512));\n"
    for marks in (
        hide.format(970, "#9600"),
        layers.format("#9600,#9511"),
        layers.format("#9703,#9511") + over,
    ):
        path.write_text(text.replace("DATA;", f"DATA;\n{marks}"))
        assert load_mesh(path).area == pytest.approx(22e-6)
    faces = re.search(rf"{shell}=CLOSED_SHELL\('',\((.*)\)\);", text)[1].split(",")
    copies = "".join(
        f"#98{i}={re.search(rf'{face}=(.*);', text)[1]};\n" for i, face in enumerate(faces)
    )
    copies += f"#9601=OPEN_SHELL('',({','.join(f'#98{i}' for i in range(len(faces)))}));\n"
    apart = text.replace(f"MODEL('',({shell}))", "MODEL('',(#9601))")
    for count, marks in (
        (0, hide.format(970, "#9601")),
        (5, "".join(hide.format(970 + i, f"#98{i}") for i in range(5))),
        (6, "".join(hide.format(970 + i, f"#98{i}") for i in range(6))),
    ):
        path.write_text(apart.replace("DATA;", f"DATA;\n{copies}{marks}"))
        assert load_mesh(path).area == pytest.approx(44e-6 if count == 5 else 22e-6)
    both = hide.format(970, "#9600") + hide.format(971, body)
    path.write_text(text.replace("DATA;", f"DATA;\n{both}"))
    assert load_mesh(path).area == pytest.approx(44e-6)  # nothing else is there


def test_small_exponents_and_texts_are_not_made_capital() -> None:
    text = b"#1=CARTESIAN_POINT('a part',(1.e-3,2.5e+1,0.));\n#2=DOCUMENT_FILE('',<#name>);\n"
    assert prepare(text)[0] == text


def test_parts_that_hold_each_other_are_refused(tmp_path: Path) -> None:
    use = "NEXT_ASSEMBLY_USAGE_OCCURRENCE('it''s; #9','',''"
    text = f"ISO-10303-21;\n#1={use},#2,#3,$);\n#4={use},#3,#2,$);\n"
    with pytest.raises(InputError, match=r"each other in a circle: #[23]"):
        prepare(text.encode())
    maps = "".join(
        f"#{level}=SHAPE_REPRESENTATION('',(#{level}1,#{level}2),#9);\n"
        f"#{level}1=MAPPED_ITEM('',#{level}3,#9);\n#{level}2=MAPPED_ITEM('',#{level}3,#9);\n"
        f"#{level}3=REPRESENTATION_MAP(#9,#{level + 1});\n"
        for level in range(100, 140)
    )
    with pytest.raises(InputError, match="places over 100000 parts"):
        prepare(f"{maps}#140=SHAPE_REPRESENTATION('',(#9),#9);".encode())


@step_and_iges
@pytest.mark.parametrize("binding", ["definition", "relationship", "none"])
@pytest.mark.parametrize("is_linked", [True, False])
def test_a_shape_that_is_exact_and_tessellated_comes_once(tmp_path, binding, is_linked) -> None:
    text = step((40, 30, 20))
    link = re.search(r"(#\d+)=FACETED_BREP\(", text)[1] if is_linked and binding != "none" else ""
    path = tmp_path / "a.stp"
    path.write_text("/* it's; one part */" + with_twin(text, link, binding))
    mesh = load_mesh(path)
    assert len(mesh.faces) == 12
    assert mesh.area == pytest.approx(5.2e-3, rel=1e-5)


@step_and_iges
@pytest.mark.parametrize("codec", ["utf-8-sig", "utf-16"])
def test_step_with_a_byte_order_mark_is_read(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "a.step"
    path.write_text(step((40, 30, 20)), encoding=codec)
    assert load_mesh(path).area == pytest.approx(5.2e-3, rel=1e-5)


@step_and_iges
@pytest.mark.parametrize(
    "record",
    [
        "#7001=DOCUMENT_FILE('{}','','',#1,'',$);",
        "#7001=EXTERNAL_SOURCE(IDENTIFIER('{}'));",
        "#7001=APPLIED_EXTERNAL_IDENTIFICATION_ASSIGNMENT('{}','',#1,#1,(#1));",
    ],
)
def test_an_assembly_whose_parts_lie_in_other_files_names_them(tmp_path, caplog, record) -> None:
    TOLD.clear()
    path = tmp_path / "a.step"
    text = step((40, 30, 20))
    more = record.format("parts/bolt.stp") + "\n#7002=DOCUMENT_FILE('a.pdf','','',#1,'',$);\n"
    whole = text.replace("ENDSEC;\nEND", f"{more}ENDSEC;\nEND")
    path.write_text(whole)
    assert len(load_mesh(path).faces) == 12
    assert "a.step: parts lie in other files (parts/bolt.stp)" in caplog.text
    exact = re.search(r"(#\d+)=FACETED_BREP_SHAPE_REPRESENTATION", text)[1]
    path.write_text(re.sub(rf"#\d+=SHAPE_DEFINITION_REPRESENTATION\(#\d+,{exact}\);", "", whole))
    with refused(r"holds no surface: its parts lie in other files \(parts/bolt\.stp\)", path):
        load_mesh(path)


@step_and_iges
@pytest.mark.parametrize(
    ("kind", "faces", "lost"),
    [
        ("placed", 24, 0),
        ("no place", 12, 1),
        ("no transformation", 12, 1),
        ("a whole without a place", 24, 1),
        ("mapped", 24, 0),
        ("a list of parts", 12, 0),
    ],
)
def test_a_part_that_an_assembly_places_nowhere_is_named(
    tmp_path, caplog, kind, faces, lost
) -> None:
    TOLD.clear()
    places = [((at, 0, 0), (0, 0, 1), (1, 0, 0)) for at in (0, 100)]
    text = step((40, 30, 20), "mm", places, depth=1 + (kind == "a whole without a place"))
    uses = re.findall(r"(#\d+)=NEXT_ASSEMBLY_USAGE", text)
    links = re.findall(r"#\d+=CONTEXT_DEPENDENT_SHAPE_REPRESENTATION.*\n", text)
    moves = re.findall(r"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION\(#\d+\)", text)
    if kind in ("no place", "a whole without a place"):
        text = text.replace(links[-1], "")
    elif kind == "no transformation":
        text = text.replace(moves[-1], "")
    elif kind == "mapped":
        part, base = re.search(
            r"(#\d+)=FACETED_BREP_SHAPE_REPRESENTATION\('',\(#\d+,(#\d+)\)", text
        ).groups()
        *_, first, second = re.search(r"=SHAPE_REPRESENTATION\('',\((.*?)\)", text)[1].split(",")
        text = re.sub(r"#\d+=(CONTEXT_DEPENDENT|\(REPRESENTATION_REL|ITEM_DEF).*\n", "", text)
        text = text.replace(f"{first},{second})", "#9501,#9502)")
        maps = f"#9500=REPRESENTATION_MAP({base},{part});\n#9501=MAPPED_ITEM('',#9500,{first});\n"
        text = text.replace("DATA;\n", f"DATA;\n{maps}#9502=MAPPED_ITEM('',#9500,{second});\n")
    elif kind == "a list of parts":  # the box alone has a shape
        text = step((40, 30, 20))
        whole, form, stage = re.search(
            r"(#\d+)=PRODUCT_DEFINITION\('','',(#\d+),(#\d+)\)", text
        ).groups()
        other = f"#9501=PRODUCT_DEFINITION('','',{form},{stage});\n"
        use = f"#9502=NEXT_ASSEMBLY_USAGE_OCCURRENCE('','','',{whole},#9501,$);\n"
        text = text.replace("DATA;\n", f"DATA;\n{other}{use}")
    path = tmp_path / "a.step"
    path.write_text(text)
    assert len(load_mesh(path).faces) == faces
    named = f"a.step: parts have no place and are left out ({uses[-1]})"
    assert (named in caplog.text, bool(caplog.text)) == (bool(lost), bool(lost))


@step_and_iges
@pytest.mark.parametrize(("height", "is_stray"), [(0, False), (3, False), (40, True), (-40, True)])
def test_a_face_that_leaves_the_box_of_its_edges_is_named(
    tmp_path, caplog, height, is_stray
) -> None:
    TOLD.clear()
    (tmp_path / "a.step").write_text(curved("square", height))
    mesh = load_mesh(tmp_path / "a.step")
    top = abs(height) * 0.75**2 / 1000  # of a cubic with poles 0, h, h, 0, along both axes
    np.testing.assert_allclose(mesh.extents, [0.01, 0.01, top], rtol=0.02)
    named = f"a.step: a face reaches {mesh.extents[2]:.3g} m beyond its own edges, and the edges"
    assert (f"{named} of the part span 0.01 m" in caplog.text) == is_stray
    assert is_stray or not caplog.text


@step_and_iges
@pytest.mark.parametrize("kind", ["ball", "box", "iges", "assembly"])
def test_a_sound_part_of_cad_gets_no_warning(tmp_path, caplog, kind) -> None:
    TOLD.clear()
    upright = ((0, 0, 0), (0, 0, 1), (1, 0, 0))
    text = {
        "ball": curved("ball"),
        "box": step((40, 30, 20)),
        "iges": iges((40, 30, 20)),
        "assembly": step((40, 30, 20), "mm", [upright, ((90, 0, 0), (1, 0, 0), (0, 1, 0))]),
    }[kind]
    path = tmp_path / ("a.iges" if kind == "iges" else "a.step")
    path.write_text(text)
    mesh = load_mesh(path)
    assert not caplog.text
    if kind == "ball":
        assert mesh.area == pytest.approx(4 * np.pi * 0.01**2, rel=0.03)


@pytest.mark.data
@step_and_iges
@pytest.mark.parametrize(("name", "area"), [("both.stp", 6e-4), ("bom.stp", 2.2e-5)])
def test_step_files_of_public_reports_have_their_area(shared_data, name, area) -> None:
    assert load_mesh(shared_data / "faults" / name).area == pytest.approx(area, rel=1e-5)


@pytest.mark.parametrize("unit", ["mm", "m", "in"])
def test_the_unit_of_a_cad_file_is_named_as_the_file_has_it(tmp_path, caplog, unit):
    """STEP and IGES are read in metres and millimetres, whichever unit the file is in."""
    number = {"mm": (2, "MM"), "m": (6, "M"), "in": (1, "IN")}[unit]
    for name, text in (("a.step", step(scaled(unit), unit)), ("a.igs", iges(scaled(unit), number))):
        (tmp_path / name).write_text(text)
        mesh = trimesh.creation.box((1, 1, 1))
        mesh.units, mesh.metadata["file_name"] = "meters", str(tmp_path / name)
        for chosen in ("mm", "cm", "in"):
            TOLD.clear()
            caplog.clear()
            file_size(mesh, chosen)
            messages = (
                [] if chosen == unit else [f"{tmp_path / name} is in {unit}, not units {chosen}"]
            )
            assert caplog.messages == messages


@step_and_iges
@pytest.mark.parametrize(
    ("unit", "scale", "message"),
    [
        ((3, "CM"), "1.0", ""),
        ((3, "INCH"), "", ""),
        ((2, "mm"), "1.", ""),
        ((1, "MM"), "1.0", "has unit 1 and calls it MM; export it again in millimetres"),
        ((6, "mm"), "1.0", "has unit 6 and calls it mm"),
        ((3, "cm"), "1.0", "has unit 3 and calls it cm"),
        ((3, "FURLONG"), "1.0", "has unit 3 and calls it FURLONG"),
        ((0, "IN"), "1.0", "has unit 0 and calls it IN"),
        ((2, "MM"), "0.5", "is a model at scale 0.5; export it at scale 1"),
        ((2, "MM"), " 0.5 ", "is a model at scale 0.5; export it at scale 1"),
        ((2, "MM"), "1.,6,2HMM,9, 0.1, 15H20260101.000000", "has unit 6 and calls it MM"),
    ],
)
def test_iges_whose_unit_or_scale_is_unclear_is_refused(tmp_path, unit, scale, message) -> None:
    path = tmp_path / "a.igs"
    path.write_text(iges((10, 20, 30), unit, scale=scale))
    if message:
        with refused(message, path):
            load_mesh(path)
    else:
        side = {"CM": 0.3, "INCH": 0.762, "mm": 0.03}[unit[1]]
        assert file_size(load_mesh(path))[0] == pytest.approx(side)


@step_and_iges
@pytest.mark.parametrize(
    ("matrix", "sides"),
    [
        ([0.0, -1.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0], (20, 10, 30)),
        ([-1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0], (10, 20, 30)),
        ([2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, "2.D0", 0.0], (20, 40, 60)),
        ([1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0], (10, 20, 30)),
        ([2.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0], None),
        ([1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0], None),
    ],
)
def test_matrices_of_iges_place_a_shape_or_are_refused(tmp_path, matrix, sides) -> None:
    """OpenCASCADE leaves out a stretch and a shear."""
    path = tmp_path / "a.igs"
    path.write_text(iges((10, 20, 30), matrix=matrix))
    if sides is None:
        with refused("stretched or sheared where it is placed .entity 124", path):
            load_mesh(path)
    else:
        mesh = load_mesh(path)
        np.testing.assert_allclose(mesh.extents, sides, atol=1e-3)
        assert mesh.volume == pytest.approx(np.prod(sides), rel=1e-4)


@step_and_iges
def test_subfigures_of_iges_are_scaled_and_refused_if_mirrored(tmp_path: Path) -> None:
    path = tmp_path / "a.igs"
    path.write_text(iges((10, 20, 30), depth=1, size_of=2.0))
    np.testing.assert_allclose(load_mesh(path).extents, (520, 40, 60), atol=1e-3)
    path.write_text(iges((10, 20, 30), depth=1, size_of=-1.0))
    with refused("is mirrored.*entity 408", path):
        load_mesh(path)


@step_and_iges
def test_hidden_shapes_of_iges_are_refused_beside_visible_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.igs"

    def write(kind: int, state: str, most: int, **form) -> None:
        """Hide, by its state, each entity of a kind, up to so many."""
        text = iges((1, 2, 3), **form)
        path.write_text(
            re.sub(rf"( {{5}}{kind}.{{56}})\d{{8}}(?=D)", rf"\g<1>{state}", text, count=most)
        )

    for kind, state, form in (
        (118, "01000000", {}),
        (144, " 1020000", {"trimmed": True}),
        (408, "01000000", {"depth": 1}),
    ):
        write(kind, state, 1, **form)
        with refused(f"1 of its {2 if form == {'depth': 1} else 6} shapes are hidden", path):
            load_mesh(path)
        write(kind, state, 6, **form)  # nothing else is there
        assert load_mesh(path).area == pytest.approx(44 if "depth" in form else 22)
    for state in ("01010000", "01000000"):  # the surfaces that visible faces are cut from
        write(118, state, 6, trimmed=True)
        assert load_mesh(path).area == pytest.approx(22)


@step_and_iges
@pytest.mark.parametrize("unit", ["MILLI", "MICRO", "NANO"])
@pytest.mark.parametrize("shape", ["box", "ball", "twin"])
def test_a_part_of_less_than_ten_micrometres_is_refused_at_once(tmp_path, shape, unit):
    """OpenCASCADE takes five minutes for such a box, and makes a lump of such a ball."""
    side = {"MILLI": 3e-4, "MICRO": 3.0, "NANO": 3000.0}[unit]
    if shape == "ball":
        text = curved("ball")
        text = re.sub(r"\b10\.\)", f"{side / 2})", text)
    else:
        text = step((side, side / 2, side / 3))
        text = with_twin(text) if shape == "twin" else text
    path = tmp_path / "a.step"
    path.write_text(text.replace(".MILLI.", f".{unit}."))
    start = time.perf_counter()
    with pytest.raises(InputError, match=r"a\.step: .*no side under 1e-05 m is read"):
        load_mesh(path)
    assert time.perf_counter() - start < 60


@step_and_iges
@pytest.mark.parametrize("unit", ["DECI", "MICRO"])
def test_a_part_in_a_rare_unit_has_its_length(tmp_path, unit):
    side = {"DECI": 0.03, "MICRO": 3000.0}[unit]
    path = tmp_path / "a.step"
    path.write_text(step((side, side / 2, side / 3)).replace(".MILLI.", f".{unit}."))
    np.testing.assert_allclose(load_mesh(path).extents, [0.003, 0.0015, 0.001], rtol=1e-5)
