"""Templates for a dome's builder: the printed pattern against spherical trigonometry, the mesh against the surface."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.results.files import templates
from skysim.results.files.templates import Drawing, SheetText, to_dxf
from skysim.scene import loader
from skysim.simulation.lab import Lab, build_lab
from skysim.sources.dome.surface import Ellipsoid, Plane

RADIUS_M = 1.2
SPHERE = Ellipsoid(np.zeros(3), np.full(3, RADIUS_M))
DOME = {
    "light.surface": "{kind: sphere, apex: 1.2 m, radius: 1.2 m}",
    "light.layout": "{kind: poisson_disk, count: 150, cap_deg: 35}",
}
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def lab() -> Lab:
    return build_lab(
        loader.load("afit_simsat", DOME | {"motion.maneuver": "[]", "motion.control": "null"})
    )


def rays(count: int) -> Floats:
    rng = np.random.default_rng(3)
    tilt_rad = rng.uniform(0.05, 0.7, count)
    azimuth_rad = rng.uniform(-0.3, 0.3, count)
    return templates.directions(tilt_rad, azimuth_rad)


def test_on_a_sphere_templates_use_cassini_s_coordinates() -> None:
    """sin(x / R) = sin t sin a and tan(y / R) = tan t cos a; here from vectors, about the meridian of x."""
    some = rays(200)
    x_m, y_m = templates.on_paper_m(SPHERE, some, 0.0).T
    assert x_m == pytest.approx(RADIUS_M * np.arcsin(some[:, 1]), abs=1e-5)
    assert y_m == pytest.approx(RADIUS_M * np.arctan2(some[:, 0], some[:, 2]), abs=1e-4)


def test_the_template_of_a_flat_panel_is_the_panel() -> None:
    some = rays(200)
    height_m = 1.5
    place_m = height_m * some / some[:, 2:]
    paper_m = templates.on_paper_m(Plane(np.array([0.0, 0.0, height_m])), some, 0.0)
    assert paper_m == pytest.approx(place_m[:, 1::-1], abs=1e-12)


def test_the_printed_leds_are_where_the_scene_has_them(lab: Lab) -> None:
    """Each circle, measured from its gore's apex, names its LED's direction from the bearing."""
    place_m = dict(
        zip(lab.camera.sources.id.tolist(), lab.camera.sources.place[:, :3], strict=True)
    )
    root = ElementTree.fromstring(templates.template(lab, ".svg"))
    assert root.get("width") == f"{root.get('viewBox', '').split()[2]}mm"
    gores = 0
    seen = set()
    for element, after in zip(root, [*root[3:], None, None, None], strict=True):
        if element.tag == SVG + "polygon":
            points = np.array(
                [pair.split(",") for pair in str(element.get("points")).split()], float
            )
            assert np.ptp(points[:, 0]) <= 1e3 * templates.MAX_WIDTH_M + 1
            apex_mm = points[0]
            gores = gores + 1
        elif element.tag == SVG + "circle":
            assert after is not None
            number = int(str(after.text))
            seen.add(number)
            left, y = (
                np.array([float(str(element.get(key))) for key in ("cx", "cy")]) - apex_mm
            )
            # From inside, with the apex up, azimuths grow to the left.
            across = -left / 1e3 / RADIUS_M
            along = y / 1e3 / RADIUS_M
            own = np.array(
                [
                    np.cos(across) * np.sin(along),
                    np.sin(across),
                    np.cos(across) * np.cos(along),
                ]
            )
            meridian_rad = 2 * np.pi * (gores - 1) / 18
            cosine = np.cos(meridian_rad)
            sine = np.sin(meridian_rad)
            expected = (
                place_m[number]
                / RADIUS_M
                @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
            )
            assert own == pytest.approx(expected, abs=2e-5)
    assert gores == 18  # 2 pi 1.2 m sin 35 deg over 0.25 m, rounded up
    assert seen == place_m.keys()


def test_the_cutting_pattern_matches_the_printed_one(lab: Lab, tmp_path: Path) -> None:
    """DXF as ezdxf reads it, whose y points up from the sheet's lower edge, against the SVG of the same gores."""
    path = tmp_path / "gores.dxf"
    path.write_text(templates.template(lab, ".dxf"))
    document = ezdxf.readfile(path)
    assert (document.dxfversion, document.header["$INSUNITS"]) == ("AC1009", 4)
    assert not document.audit().errors
    root = ElementTree.fromstring(templates.template(lab, ".svg"))
    height_mm = float(str(root.get("viewBox")).split()[3])
    drawn = document.modelspace()
    circles = [
        (c.dxf.center.x, height_mm - c.dxf.center.y, c.dxf.radius)
        for c in drawn.query("CIRCLE[layer=='LEDS']")
    ]
    printed = [
        [float(str(c.get(key))) for key in ("cx", "cy", "r")]
        for c in root.iter(SVG + "circle")
    ]
    assert len(printed) == 150
    assert np.array(circles) == pytest.approx(np.array(printed), abs=1e-3)
    outlines = [
        np.array([[v.dxf.location.x, height_mm - v.dxf.location.y] for v in one.vertices])
        for one in drawn.query("POLYLINE[layer=='OUTLINE']")
        if one.is_closed
    ]
    polygons = [
        np.array([p.split(",") for p in str(g.get("points")).split()], float)
        for g in root.iter(SVG + "polygon")
    ]
    assert len(outlines) == len(polygons) == 18
    for cut, paper in zip(outlines, polygons, strict=True):
        assert cut == pytest.approx(paper, abs=1e-3)
    words = [(one.dxf.text, one.dxf.height) for one in drawn.query("TEXT")]
    assert words == [
        (one.text, float(str(one.get("font-size")))) for one in root.iter(SVG + "text")
    ]
    assert len(drawn.query("POLYLINE[layer=='HELP']")) == 18
    assert len(drawn.query("POLYLINE[layer=='CENTERS']")) == 300
    rule = [one for one in drawn.query("POLYLINE[layer=='OUTLINE']") if not one.is_closed]
    assert [
        abs(one.vertices[1].dxf.location.x - one.vertices[0].dxf.location.x) for one in rule
    ] == [100]


def test_words_of_a_cutting_pattern_are_ascii() -> None:
    text = to_dxf(Drawing(10, 10, [SheetText(1, 2, 3, "Kuppel größer\u2033")]))
    assert text.isascii()
    assert "gr\\U+00F6\\U+00DFer\\U+2033" in text


def test_the_mesh_is_the_surface_with_a_mark_at_each_led(lab: Lab) -> None:
    objects = re.split(r"^o ", templates.template(lab, ".obj"), flags=re.M)[1:]
    vertices = {
        one.split("\n", 1)[0]: np.array(
            [line.split()[1:] for line in one.split("\n") if line.startswith("v ")], float
        )
        for one in objects
    }
    shell_mm = vertices.pop("shell")
    assert np.linalg.norm(shell_mm, axis=1) == pytest.approx(1e3 * RADIUS_M, abs=1e-3)
    assert np.degrees(np.arccos(shell_mm[:, 2].min() / 1200)) == pytest.approx(35, abs=0.01)
    assert set(vertices) == {f"led_{number}" for number in lab.camera.sources.id}
    for number, place in zip(lab.camera.sources.id, lab.camera.sources.place, strict=True):
        mark_mm = vertices[f"led_{number}"]
        assert mark_mm[:3].mean(axis=0) == pytest.approx(1e3 * place[:3], abs=1e-3)
        assert np.linalg.norm(mark_mm[3]) == pytest.approx(1204, abs=1e-3)
    used = [
        int(word)
        for one in objects
        for line in one.split("\n")
        if line.startswith("f ")
        for word in line.split()[1:]
    ]
    assert set(used) == set(range(1, len(shell_mm) + 4 * len(vertices) + 1))


def test_every_face_looks_inward_or_out_of_its_mark(lab: Lab) -> None:
    """The shell is seen from inside, a mark from all sides: its volume is positive."""
    lines = templates.template(lab, ".obj").split("\n")
    points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    corners = [np.array(line.split()[1:], int) - 1 for line in lines if line.startswith("f ")]
    first = 1 + templates.RINGS * templates.SECTORS
    for face in corners[::5]:
        a, b, c = points[face[:3]]
        normal = np.cross(b - a, c - a)
        if face.max() < first:
            assert normal @ a < 0
        else:
            mark = points[first + (face[0] - first) // 4 * 4 :][:4]
            assert normal @ (a - mark.mean(axis=0)) > 0


def test_a_sky_scene_has_no_templates() -> None:
    with pytest.raises(
        InputError, match=r"light.kind: stars has no templates; allowed: dome"
    ):
        templates.template(build_lab(loader.load("shefex2")), ".svg")
