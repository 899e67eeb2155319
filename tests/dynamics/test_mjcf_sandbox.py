"""An untrusted vehicle file reads only its folder, cannot crash skysim, and has limits of memory and time."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import pytest

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.dynamics.multibody import mjcf, mjcf_trial
from skysim.dynamics.multibody.mjcf import xml_root

BUS = '<body name="bus"><camera name="star_camera"/><geom size=".1"/></body>'
SECRET = '<body name="secret"><geom size=".1"/></body>'
OUT = '<include file="../out/secret.xml"/>'
CHILD = f"<mujoco>{OUT}</mujoco>"
SOLID = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
USED = '<worldbody><geom type="mesh" mesh="m"/></worldbody>'
ATTACHED = (
    '<asset><model name="c" file="c.xml" content_type="text/xml"/></asset><worldbody><body name="z">'
    '<geom size=".1"/><attach model="c" body="secret" prefix="p"/></body></worldbody>'
)
URDF = (
    '<robot name="r"><mujoco><compiler strippath="false"/></mujoco><link name="secret"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>'
    '<mesh filename="../out/x.obj"/></geometry></collision></link></robot>'
)
MESHED = (
    '<mujoco><compiler meshdir="dd"/><asset><mesh name="m" file="x.obj"/></asset><worldbody><body name="secret">'
    '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)


def mesh(name: str, compiler: str = "") -> str:
    return f'<compiler {compiler}/><asset><mesh name="m" file="{name}"/></asset>{USED}'


def whole(names: str, attributes: str = "") -> str:
    return f"<mujoco{attributes}>{names}<worldbody>{BUS}</worldbody></mujoco>"


# The files of the stranger's folder, and its links into the folder above it.
WAYS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "attached model": ({"v.xml": whole(ATTACHED), "c.xml": CHILD}, {}),
    "attached model of another suffix": (
        {"v.xml": whole(ATTACHED.replace("c.xml", "c.bin")), "c.bin": CHILD},
        {},
    ),
    "attached URDF": ({"v.xml": whole(ATTACHED), "c.xml": URDF}, {}),
    "attached meshdir": (
        {"v.xml": whole(ATTACHED), "c.xml": MESHED},
        {"dd/x.obj": "out/x.obj"},
    ),
    "namespace of an include": (
        {"v.xml": whole('<include xmlns="a" file="c.xml"/>'), "c.xml": CHILD},
        {},
    ),
    "namespace of all": ({"v.xml": whole(OUT, ' xmlns="a"')}, {}),
    "backslash": ({"v.xml": whole(OUT.replace("/o", "\\o").replace("t/", "t\\"))}, {}),
    "character by number": ({"v.xml": whole(OUT.replace("..", "&#46;."))}, {}),
    "link beneath meshdir": (
        {"v.xml": whole(mesh("x.obj", 'meshdir="dd"'))},
        {"dd/x.obj": "out/x.obj"},
    ),
    "link without its folder": (
        {"v.xml": whole(mesh("a/x.obj", 'strippath="true"'))},
        {"x.obj": "out/x.obj"},
    ),
    "link before ..": (
        {"v.xml": whole('<include file="lnk/../x.xml"/>'), "d/e/f": ""},
        {"lnk": "theirs/d/e", "x.xml": "out/secret.xml"},
    ),
    "linked model": (
        {"d/real.xml": whole('<include file="x.xml"/>')},
        {"v.xml": "theirs/d/real.xml", "x.xml": "out/secret.xml"},
    ),
    "linked include": (
        {
            "v.xml": whole('<include file="a/c.xml"/>'),
            "d/c.xml": '<mujoco><include file="x.xml"/></mujoco>',
        },
        {"a/c.xml": "theirs/d/c.xml", "a/x.xml": "out/secret.xml"},
    ),
    "another encoding": (
        {
            "v.xml": whole('<include file="c.xml"/>'),
            "c.xml": f'<?xml version="1.0" encoding="utf-7"?>{CHILD}',
        },
        {},
    ),
    "mark of bytes": ({"v.xml": "\ufeff" + whole(OUT)}, {}),
    "DOCTYPE": (
        {"v.xml": f"<!DOCTYPE mujoco [<!-- > {whole(OUT)} --> ]><mujoco/>"},
        {},
    ),
    "CDATA in a comment": ({"v.xml": whole(f"<!-- <![CDATA[ -->{OUT}<!-- ]]> -->")}, {}),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_path_out_of_the_folder_that_mujoco_follows_is_refused(
    tmp_path: Path, way: str
) -> None:
    """MuJoCo compiles each, and could not without the file outside."""
    files, links = WAYS[way]
    folder = tmp_path / "theirs"
    out = tmp_path / "out"
    out.mkdir()
    (out / "secret.xml").write_text(f"<mujoco><worldbody>{SECRET}</worldbody></mujoco>")
    (out / "x.obj").write_text(SOLID)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name, target in links.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(tmp_path / target)
    mujoco.MjSpec.from_file(str(folder / "v.xml")).compile()
    with pytest.raises(
        InputError, match=r"allowed: (files in it|.*XML without|MJCF, not URDF)"
    ) as refusal:
        mjcf.load(folder / "v.xml")
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize(
    "names",
    [
        '<deformable><skin file="../out/s.skn"/></deformable>',
        '<asset><hfield name="h" file="/h.png" size="1 1 1 1"/></asset>',
        '<worldbody><flexcomp name="f" type="gmsh" file="../x.msh"/></worldbody>',
        '<compiler texturedir="../out"/>',
        *(
            f'<asset><texture type="cube" name="t" file{side}="../out/x.png"/></asset>'
            for side in ("right", "left", "up", "down", "front", "back")
        ),
        '<compiler ASSETDIR="/"/>',
        '<asset><model name="c" file="../x.mjz"/></asset>',
        '<include file="round.xml"/>',
        '<worldbody><INCLUDE file="part.xml"/></worldbody>',
    ],
)
def test_any_file_name_outside_the_folder_is_refused(tmp_path: Path, names: str) -> None:
    (tmp_path / "v.xml").write_text(whole(names))
    (tmp_path / "part.xml").write_text(CHILD)
    (tmp_path / "round.xml").symlink_to(tmp_path / "round.xml")
    with pytest.raises(InputError, match=r"is outside .*; allowed: files in it$"):
        mjcf.load(tmp_path / "v.xml")


def test_a_file_that_includes_itself_in_many_ways_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without this, every include path would be read separately, for hours."""
    read = list[Path]()

    def noted(path: Path) -> ElementTree.Element:
        read.append(path)
        return xml_root(path)

    monkeypatch.setattr(mjcf, "xml_root", noted)
    (tmp_path / "sub").mkdir()
    (tmp_path / "v.xml").write_text(
        whole("".join(f'<include file="{"sub/../" * n}v.xml"/>' for n in (1, 2, 3)))
    )
    with pytest.raises(InputError, match="not a MuJoCo model"):
        mjcf.load(tmp_path / "v.xml")
    assert read == [tmp_path / "v.xml"]


def test_other_encodings_archives_and_pipes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "v.xml"
    pipe = tmp_path / "pipe.xml"
    path.write_bytes(whole(OUT).encode("utf-16"))
    with pytest.raises(InputError, match="not a MuJoCo model: not text in UTF-8"):
        mjcf.load(path)
    path.write_text(whole('<asset><model name="c" file="c.mjz"/></asset>'))
    (tmp_path / "c.mjz").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"c\.mjz: not a MuJoCo model"):
        mjcf.load(path)
    os.mkfifo(pipe)
    path.write_text(whole('<include file="pipe.xml"/>'))
    with pytest.raises(InputError, match="is not a regular file"):
        mjcf.load(path)
    path.unlink()
    path.symlink_to(pipe)
    with pytest.raises(InputError, match="no such file"):
        mjcf.load(path)


def test_files_within_the_folder_are_read(tmp_path: Path) -> None:
    """Includes of includes from a folder beneath, meshes, an attached model; `..` that stays inside."""
    for name, text in {
        "v.xml": whole(
            ATTACHED + mesh("sub/../x.obj", 'meshdir="dd"') + '<include file="sub/c.xml"/>'
        ),
        "sub/c.xml": '<mujoco><include file="sub/d.xml"/></mujoco>',
        "sub/d.xml": "<mujoco><worldbody><site name='in'/></worldbody></mujoco>",
        "c.xml": f"<mujoco><worldbody>{SECRET}</worldbody></mujoco>",
        "dd/x.obj": SOLID,
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    model = mjcf.load(tmp_path / "v.xml")
    assert model.compile().nmesh == 1
    assert model.site("in") is not None
    assert model.body("psecret") is not None


def nested(count: int) -> str:
    """40,000 geoms by two levels of replication."""
    opening = f'<replicate count="{count}" offset="1 0 0">'
    return f'{opening}{opening}<geom size=".1"/></replicate></replicate>'


def flexcomp(count: str) -> str:
    flex = f'<flexcomp name="f" dim="2" count="{count}" spacing=".1 .1 .1" radius=".01" mass="1"/>'
    return f'<body name="f">{flex}</body>'


def texture(side_px: int) -> str:
    return (
        f'<asset><texture name="t" type="2d" builtin="flat" width="{side_px}"'
        f' height="{side_px}"/></asset>'
    )


# MuJoCo rejects a joint between bodies without mass, which the caller may lock.
LIGHT = '<worldbody><body name="w"><joint name="wheel_1"/></body></worldbody>'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            whole(ATTACHED.replace("c.xml", "v.xml").replace("secret", "bus")),
            r"crashes its reader \(SIGSEGV\)",
        ),
        (whole(f"<worldbody>{flexcomp('200 200 1')}</worldbody>"), "takes more than 1 s"),
        (
            whole(f"<worldbody>{flexcomp('20 20 1')}</worldbody>"),
            "nv 1200; allowed: up to 1000",
        ),
        (whole(f"<worldbody>{nested(60)}</worldbody>"), "ngeom 3601; allowed: up to 2000"),
        (
            whole(
                '<asset><hfield name="h" nrow="1000000" ncol="1000000" size="1 1 1 1"/></asset>'
            ),
            "more than 1024 MiB of memory",
        ),
        (whole('<size nuser_body="2147483647"/>'), "more than 1024 MiB of memory"),
        (whole(texture(20_000)), "more than 1024 MiB of memory"),
        (whole(texture(60_000)), "more than 1024 MiB of memory"),
        (whole(texture(10_000)), "nbuffer 3000.....; allowed: up to 268435456"),
        (whole('<size memory="100G"/>'), "more than 1024 MiB of memory"),
        (whole('<size nuserdata="2147483647"/>'), "more than 1024 MiB of memory"),
        (whole(f'<size memory="100G"/>{LIGHT}'), "more than 1024 MiB of memory"),
    ],
    ids=[
        "contains itself",
        "flexcomp",
        "joints",
        "replicate",
        "height field",
        "nuser_body",
        "texture",
        "large texture",
        "texture of 300 MB",
        "arena",
        "user data",
        "arena and a joint to lock",
    ],
)
def test_a_model_that_would_crash_or_never_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    if "1 s" in message:
        monkeypatch.setattr(mjcf, "TRIAL_CPU_S", 1)
    (tmp_path / "v.xml").write_text(text)
    with pytest.raises(
        InputError, match=rf"v\.xml: not a MuJoCo model that skysim reads: it .*{message}$"
    ):
        mjcf.load(tmp_path / "v.xml")


@pytest.mark.parametrize("error", ["no memory", "a message that no version has had"])
def test_only_a_model_that_has_been_compiled_survives_its_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: str
) -> None:
    """Any error of the compiler is a refusal, since a limit may be its cause."""
    path = tmp_path / "v.xml"
    path.write_text(whole(""))

    class Spec:
        keys = joints = ()

        @staticmethod
        def from_file(_path: str) -> type[Spec]:
            return Spec

        @staticmethod
        def compile() -> None:
            raise ValueError(error)

    mjcf_trial.run_trial(str(path))
    monkeypatch.setattr(mujoco, "MjSpec", Spec)
    with pytest.raises(ValueError, match=error):
        mjcf_trial.run_trial(str(path))


def test_a_joint_that_mujoco_rejects_is_left_to_the_caller(tmp_path: Path) -> None:
    path = tmp_path / "v.xml"
    path.write_text(whole(LIGHT))
    with pytest.raises(ValueError, match="mass and inertia of moving bodies"):
        mjcf.load(path).compile()


@pytest.mark.parametrize("value", ["inf", "1 NaN 1", "-1e300", "Infinity"])
def test_numbers_that_are_not_finite_or_excessive_are_refused(
    tmp_path: Path, value: str
) -> None:
    (tmp_path / "v.xml").write_text(
        whole("").replace('size=".1"', f'size=".1" pos="{value}"')
    )
    with pytest.raises(
        InputError, match=r"v\.xml: geom pos='.*'; allowed: finite numbers up to 1e\+12$"
    ):
        mjcf.load(tmp_path / "v.xml")


def test_a_shipped_vehicle_is_loaded_in_process_and_any_other_in_a_child(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child process would import MuJoCo a second time and delay every run."""
    tried = list[str]()
    monkeypatch.setattr(
        mjcf, "run_guarded", lambda _script, path, **_limits: tried.append(path) or ""
    )
    for shipped in (SCENES / "vehicles").glob("*.xml"):
        mjcf.load(shipped)
    own = tmp_path / "v.xml"
    own.write_text(whole(""))
    mjcf.load(own)
    mjcf.load(own)
    assert tried == [str(own)]
