"""Boxes as STEP, IGES and 3MF, written as text: the libraries that read them write none."""

import re
import textwrap
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

FACES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
"""Corners of a box's sides, seen from outside."""
_SPACE = "http://schemas.microsoft.com/3dmanufacturing"
Place = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Where a part stands: origin, its z and its x."""


def corners(size: Sequence[float]) -> np.ndarray:
    return np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]) * np.array(size)


def step(
    size: Sequence[float], unit: str = "mm", places: Sequence[Place] = (), depth: int = 1
) -> str:
    """A box (ISO 10303-21, AP214: a faceted brep); with places an assembly of as many.

    ``depth`` assemblies lie in each other, each with all places.
    """
    lines: list[str] = []

    def add(text: str) -> str:
        lines.append(text)
        return f"#{len(lines)}"

    def triple(kind: str, values: Sequence[float]) -> str:
        return add(f"{kind}('',({','.join(str(float(value)) for value in values)}))")

    def axes(origin: Sequence[float], z: Sequence[float], x: Sequence[float]) -> str:
        turns = f"{triple('DIRECTION', z)},{triple('DIRECTION', x)}"
        return add(f"AXIS2_PLACEMENT_3D('',{triple('CARTESIAN_POINT', origin)},{turns})")

    def product(name: str) -> tuple[str, str]:
        item = add(f"PRODUCT('{name}','','',({kind}))")
        form = add(f"PRODUCT_DEFINITION_FORMATION('','',{item})")
        definition = add(f"PRODUCT_DEFINITION('','',{form},{stage})")
        return definition, add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")

    prefix = "$" if unit == "m" else ".MILLI."
    length = add(f"(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT({prefix},.METRE.))")
    if unit == "in":
        inch = add(f"LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),{length})")
        powers = add("DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)")
        length = add(f"(CONVERSION_BASED_UNIT('INCH',{inch})LENGTH_UNIT()NAMED_UNIT({powers}))")
    angle = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    context = add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},"
        f"{solid}))REPRESENTATION_CONTEXT('',''))"
    )
    application = add("APPLICATION_CONTEXT('')")
    kind = add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    stage = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    points = corners(size)
    names = [triple("CARTESIAN_POINT", point) for point in points]
    sides = []
    for side in FACES:
        a, b, c = points[list(side[:3])]
        plane = add(f"PLANE('',{axes(a, np.cross(b - a, c - b), b - a)})")
        loop = add(f"POLY_LOOP('',({','.join(names[i] for i in side)}))")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        sides.append(add(f"FACE_SURFACE('',({bound}),{plane},.T.)"))
    shell = add(f"CLOSED_SHELL('',({','.join(sides)}))")
    body = add(f"FACETED_BREP('',{shell})")
    base = axes((0, 0, 0), (0, 0, 1), (1, 0, 0))
    part, part_shape = product("part")
    shape = add(f"FACETED_BREP_SHAPE_REPRESENTATION('',({body},{base}),{context})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({part_shape},{shape})")
    for _ in range(depth if places else 0):
        whole, whole_shape = product("whole")
        stands = [axes(*place) for place in places]
        scene = add(f"SHAPE_REPRESENTATION('',({','.join([base, *stands])}),{context})")
        add(f"SHAPE_DEFINITION_REPRESENTATION({whole_shape},{scene})")
        for number, stand in enumerate(stands):
            use = add(f"NEXT_ASSEMBLY_USAGE_OCCURRENCE('{number}','','',{whole},{part},$)")
            move = add(f"ITEM_DEFINED_TRANSFORMATION('','',{base},{stand})")
            relation = add(
                f"(REPRESENTATION_RELATIONSHIP('','',{shape},{scene})"
                f"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION({move})"
                "SHAPE_REPRESENTATION_RELATIONSHIP())"
            )
            used = add(f"PRODUCT_DEFINITION_SHAPE('','',{use})")
            add(f"CONTEXT_DEPENDENT_SHAPE_REPRESENTATION({relation},{used})")
        part, shape = whole, scene
    data = "\n".join(f"#{number}={line};" for number, line in enumerate(lines, 1))
    return (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\n"
        "FILE_NAME('','',(''),(''),'','','');\n"
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\n"
        f"DATA;\n{data}\nENDSEC;\nEND-ISO-10303-21;\n"
    )


def with_twin(text: str, link: str = "", binding: str = "definition") -> str:
    """The box of `step` with its corners as a tessellated shape beside the exact one (AP242).

    ``link`` is the exact shape that the tessellated one names. ``binding`` is the record that binds
    it: a ``definition`` of the same product, a ``relationship`` of both shapes, or ``none``, in
    which case the exact shape has none either.
    """
    exact, context = re.search(
        r"(#\d+)=FACETED_BREP_SHAPE_REPRESENTATION.*,(#\d+)\);", text
    ).groups()
    definition = re.search(rf"SHAPE_DEFINITION_REPRESENTATION\((#\d+),{exact}\)", text)[1]
    rows = re.findall(r"CARTESIAN_POINT\('',(\(.*\))\)", text)[:8]
    triangles = [c for a, b, c, d in FACES for c in ((a, b, c), (a, c, d))]
    indices = ",".join(f"({a + 1},{b + 1},{c + 1})" for a, b, c in triangles)
    bound = {
        "definition": f"#9005=SHAPE_DEFINITION_REPRESENTATION({definition},#9004);",
        "relationship": f"#9005=SHAPE_REPRESENTATION_RELATIONSHIP('','',{exact},#9004);",
        "none": f"#9005=SHAPE_DEFINITION_REPRESENTATION({definition},#9004);",
    }[binding]
    if binding == "none":
        text = re.sub(rf"#\d+=SHAPE_DEFINITION_REPRESENTATION\(#\d+,{exact}\);\n", "", text)
    more = (
        f"#9001=COORDINATES_LIST('',8,({','.join(rows)}));\n"
        f"#9002=TRIANGULATED_FACE('a;b',#9001,8,(),$,(),({indices}));\n"
        f"#9003=TESSELLATED_SOLID('',(#9002),{link or '$'});\n"
        f"#9004=TESSELLATED_SHAPE_REPRESENTATION('',(#9003),{context});\n{bound}\n"
    )
    head, end, tail = text.rpartition("ENDSEC;")
    return head + more + end + tail


def curved(kind: str, height: float = 0.0) -> str:
    """One face (AP214) in mm: a ball of radius 10, or a square of 10 mm that bulges.

    The square is a B-spline with straight edges, whose middle poles are at ``height``.
    """
    text = step((1, 1, 1))
    text = text.replace("FACETED_BREP_SHAPE", "MANIFOLD_SURFACE_SHAPE")
    text = re.sub(r"FACETED_BREP\('',#\d+\)", "SHELL_BASED_SURFACE_MODEL('',(#9000))", text)
    points = [(0, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0)]
    rows = ["#9000=OPEN_SHELL('',(#9001))", "#9001=ADVANCED_FACE('',(#9002),#9003,.T.)"]
    rows += ["#9002=FACE_OUTER_BOUND('',#9004,.T.)"]
    if kind == "square":
        for at, (point, after) in enumerate(zip(points, points[1:] + points[:1], strict=True)):
            way = ",".join(str(float(b - a) / 10) for a, b in zip(point, after, strict=True))
            number = 9100 + 10 * at
            rows += [
                f"#{number}=CARTESIAN_POINT('',({','.join(f'{x}.' for x in point)}))",
                f"#{number + 1}=VERTEX_POINT('',#{number})",
                f"#{number + 2}=DIRECTION('',({way}))",
                f"#{number + 3}=VECTOR('',#{number + 2},1.)",
                f"#{number + 4}=LINE('',#{number},#{number + 3})",
                f"#{number + 5}=EDGE_CURVE('',#{number + 1},#{9101 + 10 * ((at + 1) % 4)},"
                f"#{number + 4},.T.)",
                f"#{number + 6}=ORIENTED_EDGE('',*,*,#{number + 5},.T.)",
            ]
        poles = [(i, j) for i in range(4) for j in range(4)]
        rows += [
            f"#{9200 + 4 * i + j}=CARTESIAN_POINT('',({10 * i / 3},{10 * j / 3},"
            f"{height if {i, j} <= {1, 2} else 0.0}))"
            for i, j in poles
        ]
        grid = ",".join(
            "(" + ",".join(f"#{9200 + 4 * i + j}" for j in range(4)) + ")" for i in range(4)
        )
        rows += [
            "#9004=EDGE_LOOP('',(#9106,#9116,#9126,#9136))",
            f"#9003=B_SPLINE_SURFACE_WITH_KNOTS('',3,3,({grid}),.UNSPECIFIED.,.F.,.F.,.F.,(4,4),"
            "(4,4),(0.,1.),(0.,1.),.UNSPECIFIED.)",
        ]
    else:
        rows += [
            "#9100=CARTESIAN_POINT('',(0.,0.,0.))",
            "#9101=DIRECTION('',(0.,0.,1.))",
            "#9102=DIRECTION('',(1.,0.,0.))",
            "#9103=AXIS2_PLACEMENT_3D('',#9100,#9101,#9102)",
            "#9104=CARTESIAN_POINT('',(0.,0.,-10.))",
            "#9105=VERTEX_POINT('',#9104)",
            "#9004=VERTEX_LOOP('',#9105)",
            "#9003=SPHERICAL_SURFACE('',#9103,10.)",
        ]
    return text.replace("ENDSEC;\nEND", ";\n".join(rows) + ";\nENDSEC;\nEND")


def iges(
    size: Sequence[float],
    unit: tuple[int, str] = (2, "MM"),
    depth: int = 0,
    scale: str = "1.0",
    trimmed: bool = False,
    matrix: Sequence[float] = (),
    size_of: float = 1.0,
) -> str:
    """A box of six ruled surfaces (IGES 5.3, entity 118) between lines (110).

    ``trimmed`` faces (144) are cut from them. ``depth`` subfigures (308) lie in each other; each is
    placed twice (408), 500 apart and scaled by ``size_of``. A ``matrix`` of three rows (124) places
    the surfaces.
    """
    entities: list[tuple[int, list]] = [(124, [*matrix])] if matrix else []
    points, held = corners(size).tolist(), []
    for a, b, c, d in FACES:
        entities += [(110, points[a] + points[b]), (110, points[d] + points[c])]
        entities.append((118, [2 * len(entities) - 3, 2 * len(entities) - 1, 0, 0]))
        entities += [(144, [2 * len(entities) - 1, 0, 0, 0])] if trimmed else []
        held.append(2 * len(entities) - 1)
    for level in range(depth):
        entities.append((308, [level, "1Hx", len(held), *held]))
        whole = 2 * len(entities) - 1
        entities += [(408, [whole, x, 0.0, 0.0, size_of]) for x in (0.0, 500.0)]
        held = [whole + 2, whole + 4]
    head = (
        f"1H,,1H;,3Hbox,3Hbox,1Hq,1Hq,32,38,6,308,15,3Hbox,{scale},"
        f"{unit[0]},{len(unit[1])}H{unit[1]},1,1.0,15H20260101.000000,1.E-6,1000.0,1Hq,1Hq,11,0,"
        "15H20260101.000000;"
    )
    sections: dict[str, list[str]] = {"S": ["box"], "G": textwrap.wrap(head, 72), "D": [], "P": []}
    for number, (kind, values) in enumerate(entities):
        text = textwrap.wrap(",".join(map(str, [kind, *values])) + ";", 64)
        first, state = len(sections["P"]) + 1, "00000000"
        if kind == 110 or (depth and 2 * number + 1 not in held):
            state = "00020200" if kind == 308 else "00010000"
        sections["P"] += [f"{line:<64}{2 * number + 1:>8}" for line in text]
        placed = int(kind == 118 and bool(matrix))
        rows = [kind, first, *[0] * 4, placed, 0, state], [kind, 0, 0, len(text), 0, "", "", "", 0]
        sections["D"] += ["".join(f"{value:>8}" for value in row) for row in rows]
    ends = "".join(f"{name}{len(lines):>7}" for name, lines in sections.items())
    return "".join(
        f"{line:<72}{name}{number:>7}\n"
        for name, lines in [*sections.items(), ("T", [ends])]
        for number, line in enumerate(lines, 1)
    )


def write_3mf(
    path: Path,
    objects: str,
    build: str,
    unit: str = "millimeter",
    model: str = "",
    settings: tuple[str, str] = ("", ""),
    **parts: str,
) -> Path:
    """A 3MF of the objects and items given as XML, and of parts that hold more objects.

    ``settings`` are the name and the text of a file that a slicer adds.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        if settings[0]:
            archive.writestr(f"Metadata/{settings[0]}", f"<config>{settings[1]}</config>")
        for name, text in ({"3dmodel": objects} | parts).items():
            archive.writestr(
                f"3D/{name}.model",
                f'<model unit="{unit}" xmlns="{_SPACE}/core/2015/02" '
                f'xmlns:p="{_SPACE}/production/2015/06" xmlns:b="{_SPACE}/beamlattice/2017/02" '
                f"{model}><resources>{text}</resources>"
                f"<build>{build if name == '3dmodel' else ''}</build></model>",
            )
    return path


def box_3mf(size: Sequence[float], name: str = "1") -> str:
    """A box as an object of 3MF."""
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in corners(size))
    triangles = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}"/><triangle v1="{a}" v2="{c}" v3="{d}"/>'
        for a, b, c, d in FACES
    )
    return (
        f'<object id="{name}" type="model"><mesh><vertices>{vertices}</vertices>'
        f"<triangles>{triangles}</triangles></mesh></object>"
    )
