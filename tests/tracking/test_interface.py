"""External trackers: called and scored as ours is, and never able to stop a run."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.core.plugins import ProgramError
from skysim.experiments import tracker_comparison
from skysim.experiments.study import study_file as study_loader
from skysim.experiments.study.execution import runner, store, trials
from skysim.experiments.study.execution.engines import Serial
from skysim.results import metrics
from skysim.scene import loader
from skysim.simulation.flight import Flight, open_flight
from skysim.simulation.lab import build_lab
from skysim.sources import stars
from skysim.tracking import tracker_interface
from skysim.tracking.tracker_interface import (
    Answer,
    Leds,
    Picture,
    Setup,
    Stars,
    check_answer,
)

PAGE = (ROOT / "docs/howto/external_tracker.md").read_text(encoding="utf-8")
SETUP = Setup(
    "icrs", "2012-06-22T21:00:00", 8, 6, 100.0, (3.5, 2.5), (0.0,) * 5, 1.0, 4095.0, 1
)
PICTURE = Picture(np.arange(48, dtype=np.uint16).reshape(6, 8), 7, 0.5, 0.04)
UNIT = [0.5, -0.5, 0.5, 0.5]


# --- answers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"status": "solved"}, "without cam_from_ref_xyzw"),
        (Answer("solved"), "without cam_from_ref_xyzw"),
        (Answer("lost", UNIT), "with cam_from_ref_xyzw"),
        (Answer("solved", [0, 0, 0, np.nan]), "not finite"),
        (Answer("solved", [0, 0, 0, 1.01]), "norm 1.01"),
        (Answer("solved", [0, 0, 1]), r"shape \(3,\)"),
        (Answer("solved", "north"), "not an array of numbers"),
        (Answer("solved", [[1, 2], [3]]), "not an array of numbers"),
        (Answer("solved", UNIT, np.zeros((3, 3))), "eigenvalues"),
        (Answer("solved", UNIT, [[1, 1, 0], [0, 1, 0], [0, 0, 1]]), "not symmetric"),
        (Answer("solved", UNIT, np.diag([1e-9, -1e-9, 1e-9])), "eigenvalues"),
        (Answer("solved", UNIT, None, [[1, 2, 3]]), "centroids_px has shape"),
        (Answer("solved", UNIT, None, 3.0), "centroids_px"),
        (
            Answer("solved", UNIT, None, [[1, 2], [-1e300, 2]]),
            r"1e\+300; allowed: up to 1e\+06 px",
        ),
        (Answer("solved", UNIT, None, None, -1.0), "allowed: 0 or more"),
        (Answer(""), "allowed: text"),
        (Answer(5), "allowed: text"),
        ({}, "allowed: Answer"),
    ],
)
def test_an_invalid_answer_is_refused_in_one_line(answer: object, message: str) -> None:
    with pytest.raises(
        ValueError, match=message if isinstance(answer, Answer) else "allowed: Answer"
    ) as raised:
        check_answer(answer)
    assert "\n" not in str(raised.value)


def test_an_answer_in_single_precision_is_normalized() -> None:
    checked = check_answer(
        Answer("solved", np.array(UNIT, np.float32) * np.float32(1.0005), np.eye(3) * 1e-9)
    )
    np.testing.assert_allclose(checked.cam_from_ref_xyzw, UNIT, rtol=0, atol=1e-15)
    assert check_answer(Answer("no\nstars")).status == "no stars"


def test_a_setup_round_trips_through_json() -> None:
    stars = Stars(np.array([5, 9]), np.eye(3)[:2], np.array([1.25, 3.0]))
    leds = Leds(np.array([1]), np.ones((1, 3)), np.array([0.1, 0, 0.2]), np.array(UNIT))
    for setup in (
        replace(SETUP, stars=stars, options={"a": 1.5}),
        replace(SETUP, reference="lab", leds=leds),
    ):
        again = Setup.of_tree(json.loads(json.dumps(setup.as_tree())))
        assert again.as_tree() == setup.as_tree()
    np.testing.assert_array_equal(
        Setup.of_tree(replace(SETUP, stars=stars).as_tree()).stars.direction, np.eye(3)[:2]
    )


# --- programs -----------------------------------------------------------------------------------------------

READY = "import json, sys, os, time; g = sys.stdin.buffer; g.readline(); print('{\"ready\": true}', flush=True)\n"
FRAMES = READY + "for line in g:\n    h = json.loads(line); p = g.read(h['bytes'])\n    "


def program(
    text: str, limit_s: float = 5.0, kind: str | None = None
) -> tracker_interface.TrackerProgram:
    parts = [sys.executable, "-c", text, "{folder}"]
    return tracker_interface.TrackerProgram("mine", parts, kind, SETUP, limit_s)


def test_a_program_gets_the_pixels_and_its_answer_is_returned() -> None:
    """The sum of the pixels of its lower right corner and the header come back as centroids."""
    text = (
        FRAMES + "import array; a = array.array('H', p); w = h['width_px']\n"
        "    print(json.dumps({'frame': h['frame'], 'status': 'solved', 'cam_from_ref_xyzw': [0, 0, 0, 1],"
        " 'centroids_px': [[a[-1], a[w]], [h['t_s'], h['exposure_s']]], 'seconds': 1e-6}), flush=True)"
    )
    solution = program(text).solve(PICTURE)
    assert solution.status == "solved"
    np.testing.assert_array_equal(solution.centroids_px, [[47, 8], [0.5, 0.04]])
    assert solution.seconds == 1e-6


@pytest.mark.parametrize("kind", ["png", "fits"])
def test_the_frame_s_folder_is_removed_with_the_program(kind: str) -> None:
    """The folder has the frame alone, without the truth of a run's files."""
    text = "for line in g:\n    h = json.loads(line); print(json.dumps({'frame': 7, 'status': h['file']}), flush=True)"
    runs = program(READY + text, kind=kind)
    path = Path(runs.solve(PICTURE).status)
    assert path.name == f"frame_0007.{kind}"
    image = (
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if kind == "png" else fits.getdata(path)
    )
    np.testing.assert_array_equal(image, PICTURE.image_dn)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    assert b"CRVAL" not in path.read_bytes()
    runs.close()
    assert not path.parent.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time.sleep(60)", "no answer within 0.5 s"),
        (
            "sys.stderr.write('bad star\\nout of luck\\n'); sys.exit(3)",
            r"ended \(code 3\): bad star \| out of luck",
        ),
        ("os.abort()", r"ended \(SIGABRT\)"),
        ("print('hello', flush=True)", "'hello' is not JSON"),
        ("print('[' * 100000, flush=True)", "is not JSON"),
        ('print(\'{"frame": 6, "status": "x"}\', flush=True)', "no answer to frame 7"),
        ("print('[]', flush=True)", "no answer to frame 7"),
        ("print('{\"frame\": 7}', flush=True)", "a JSON object with a status"),
        (
            'print(\'{"frame": 7, "status": "solved", "quat": 1}\', flush=True)',
            "unknown key 'quat'; allowed: status",
        ),
        (
            'print(\'{"frame": 7, "status": "solved", "cam_from_ref_xyzw": [NaN,0,0,1]}\', flush=True)',
            "finite",
        ),
        ("sys.stdout.write('x' * 17_000_000)", "more than 16000000 bytes"),
    ],
)
def test_every_fault_of_a_program_is_one_line_within_the_time_limit(
    text: str, message: str
) -> None:
    runs = program(FRAMES + text, 0.5 if "sleep" in text else 5.0)
    begin_s = time.monotonic()
    with pytest.raises(ProgramError, match=message) as raised:
        runs.solve(PICTURE)
    assert "\n" not in str(raised.value)
    assert time.monotonic() - begin_s < 4
    runs.close()


@pytest.mark.parametrize("kind", ["png", "fits"])
@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        ("shutil.rmtree(sys.argv[1])", "No such file or directory"),
        (
            "os.remove(h['file']); os.mkdir(h['file'])",
            r"Is a directory|Operation not permitted",
        ),
    ],
)
def test_a_program_that_damages_its_folder_is_reported_and_restarted(
    kind: str, harm: str, reason: str
) -> None:
    answer = 'print(\'{"frame": 7, "status": "x"}\', flush=True)'
    text = f"import shutil\nfor line in g:\n    h = json.loads(line); {harm}; {answer}"
    runs = program(READY + text, kind=kind)
    assert runs.solve(PICTURE).status == "x"
    with pytest.raises(
        ProgramError, match=f"the program's folder takes no frame: ({reason})$"
    ):
        runs.solve(PICTURE)
    assert runs.solve(PICTURE).status == "x"
    runs.close()


def test_a_program_that_does_not_read_times_out() -> None:
    """A frame larger than any pipe's buffer."""
    large = replace(PICTURE, image_dn=np.zeros((2000, 2000), np.uint16))
    with pytest.raises(ProgramError, match=r"no answer within 0\.5 s"):
        program(READY + "time.sleep(60)", 0.5).solve(large)


def test_a_program_is_restarted_and_abandoned_after_three_successive_failures(
    tmp_path: Path,
) -> None:
    """The first program dies once; the other dies at every start."""
    mark = str(tmp_path / "mark")
    answer = 'print(\'{"frame": 7, "status": "fine"}\', flush=True)'
    once = f"if not os.path.exists({mark!r}): open({mark!r}, 'x'); sys.exit(1)\n    "
    flaky = program(FRAMES + once + answer)
    with pytest.raises(ProgramError, match="code 1"):
        flaky.solve(PICTURE)
    assert [flaky.solve(PICTURE).status for _ in range(2)] == ["fine", "fine"]
    assert flaky.failures == 0
    hopeless = program(FRAMES + "sys.exit(1)")
    for _ in range(3):
        with pytest.raises(ProgramError, match="code 1"):
            hopeless.solve(PICTURE)
    with pytest.raises(ProgramError, match="given up after 3 failures in a row"):
        hopeless.solve(PICTURE)


def test_child_processes_of_a_program_end_with_it(tmp_path: Path) -> None:
    beat = tmp_path / "beat"
    child = (
        f"import time\nwhile True:\n    open({str(beat)!r}, 'a').write('x'); time.sleep(0.02)"
    )
    runs = program(
        f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {child!r}])\n"
        + FRAMES
        + "pass"
    )
    until_s = time.monotonic() + 5
    while not (beat.exists() and beat.stat().st_size) and time.monotonic() < until_s:
        time.sleep(0.01)
    runs.close(0.1)
    size = beat.stat().st_size
    assert size > 0
    time.sleep(0.2)
    assert beat.stat().st_size == size


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            'print(\'{"ready": false, "status": "no LEDs please"}\')',
            "tracker.name: mine: no LEDs please",
        ),
        ("import sys; sys.exit('no licence')", r"ended \(code 1\): no licence"),
    ],
)
def test_a_program_that_does_not_start_is_refused_with_the_reason(
    text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        program(text)


@pytest.mark.parametrize(
    "program_text",
    ["mine", "=x", "own=x", "Mine=x", "a b=x", "mine=", "mine='x", "mine=x {folder:bmp}"],
)
def test_a_program_s_name_and_command_are_checked(program_text: str) -> None:
    with pytest.raises(InputError, match=r"^programs"):
        tracker_interface.program_commands([program_text])


# --- runs ---------------------------------------------------------------------------------------------------

OFFSET = """
import numpy as np
from scipy.spatial.transform import Rotation
from skysim.tracking.tracker_interface import Answer

class Offset:
    '''Its options hold each frame's truth; it answers with a known error.'''
    def __init__(self, setup):
        assert setup.reference == 'icrs' and len(setup.stars.id) > 1000 and setup.stars.magnitude.max() <= 5.75
        self.options, self.frames = setup.options, 0
        print('what it prints disturbs nothing')

    def solve(self, picture):
        assert picture.frame == self.frames, 'every frame comes once, in order'
        self.frames += 1
        if picture.frame == 1:
            raise RuntimeError('cloudy\\ntoday')
        n = picture.frame
        truth = Rotation.from_quat([self.options[f'q{n}_{i}'] for i in range(4)])
        error = Rotation.from_rotvec(np.radians([0.01, 0.0, self.options['roll_deg'] * (n == 2)]))
        return Answer('solved', (error * truth).as_quat(), np.eye(3) * 1e-8, [[1.0, 2.0]])
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package with an entry point, as pip makes it."""
    (tmp_path / "offset.py").write_text(OFFSET)
    about = tmp_path / "offset-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: offset\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[skysim.trackers]\noffset = offset:Offset\n")
    monkeypatch.syspath_prepend(str(tmp_path))


def test_another_release_of_a_tracker_changes_the_trial_s_hash(
    installed: None, tmp_path: Path
) -> None:
    scene = loader.load("shefex2", {"tracker.name": "offset"})
    before = trials.scene_hash(scene)
    assert tracker_interface.TRACKERS.release("offset") == "offset 1.0"
    (tmp_path / "offset-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: offset\nVersion: 1.1\n"
    )
    assert tracker_interface.TRACKERS.release("offset") == "offset 1.1"
    assert trials.scene_hash(scene) != before


@pytest.mark.slow
def test_a_package_s_tracker_is_scored_by_its_error(installed: None) -> None:
    """36 arcsec across in frame 0; raised in 1; in 2 a roll of 0.2 deg as well, which is wrong."""
    scene = loader.load("shefex2", {"exposure.frames": "3"})
    truths = [shot.truth.cam_from_lab for shot in open_flight(scene).shots(solves=False)]
    options = {
        f"q{n}_{i}": float(x) for n, t in enumerate(truths) for i, x in enumerate(t.as_quat())
    }
    config = scene.tracker.model_copy(
        update={"name": "offset", "options": options | {"roll_deg": 0.2}}
    )
    lab = build_lab(scene.model_copy(update={"tracker": config}))
    trackers = tracker_comparison.build_trackers(lab, ["offset", "own"], {})
    shots = tracker_comparison.compare_frames(Flight(lab), trackers)
    both = [answers for _, _, answers in shots]
    rows = [answers["offset"] for answers in both]
    own = [answers["own"] for answers in both]
    assert [(row.status, row.wrong, row.matched > 5) for row in own] == [
        ("solved", False, True)
    ] * 3
    assert [row.truth_deg for row in own] == [row.truth_deg for row in rows]
    assert [row.status for row in rows] == [
        "solved",
        "failed: RuntimeError: cloudy today",
        "solved",
    ]
    assert [row.wrong for row in rows] == [False, False, True]
    np.testing.assert_allclose(
        [rows[0].cross_arcsec, rows[0].roll_arcsec], [36, 0], rtol=0, atol=1e-6
    )
    assert rows[2].roll_arcsec == pytest.approx(720, abs=1e-3)
    assert rows[0].roll_sigma_arcsec == pytest.approx(1e-4 / ARCSEC_RAD, rel=1e-9)
    assert [row.detected for row in rows] == [1, 0, 1]
    summed = tracker_comparison.score_tracker("offset", rows)
    assert (summed.frames, summed.wrong, summed.refused, summed.failed) == (3, 1, 0, 1)
    assert summed.right == metrics.proportion(1, 3)
    assert summed.cross_arcsec_worst == pytest.approx(36, abs=1e-6)  # of the right ones


def test_the_list_of_trackers_states_requirements(monkeypatch: pytest.MonkeyPatch) -> None:
    for there, needs in ((None, "skysim[oracle]"), (object(), "")):
        monkeypatch.setattr(tracker_interface, "find_spec", lambda name, there=there: there)
        listed = json.loads(CliRunner().invoke(main.app, ["trackers", "--json"]).stdout)
        assert {one["name"]: one["needs"] for one in listed}["tetra3rs"] == needs
        assert {one["name"]: one["needs"] for one in listed}["own"] == ""


def test_a_scene_names_a_tracker_and_never_a_command() -> None:
    scene = loader.load(
        "shefex2", {"tracker.name": "mine", "tracker.options": "{command: rm}"}
    )
    with pytest.raises(
        InputError,
        match=r"tracker\.name: unknown tracker 'mine'; .*a program: mine=COMMAND by the option program",
    ):
        build_lab(scene)
    for key in ("tracker.command", "tracker.program"):
        with pytest.raises(InputError, match="unknown key"):
            loader.load("shefex2", {key: "x"})


STUDY = """
schema: 1
title: Who?
scene: shefex2
seed: 1
trial: {kind: frames}
factors: {who: {key: tracker.name, values: [own, mine]}}
responses: [identified, refused]
"""


def test_a_tracker_can_be_a_study_s_factor(tmp_path: Path) -> None:
    path = tmp_path / "who.yaml"
    path.write_text(STUDY)
    with pytest.raises(
        InputError,
        match=r"factors\.who: 'mine': tracker\.name: unknown tracker 'mine'; allowed:",
    ):
        study_loader.load(path, programs={})
    (tmp_path / "mine.py").write_text(
        FRAMES + 'print(\'{"frame": 0, "status": "cloudy"}\', flush=True)'
    )
    commands = tracker_interface.program_commands(
        [f"mine={shlex.join([sys.executable, str(tmp_path / 'mine.py')])}"]
    )
    with pytest.raises(InputError, match="needs frames; allowed: own"):
        study_loader.load(path, {"trial.kind": "centroids"}, commands)
    study_plan = study_loader.load(path, programs=commands)
    with store.writing(tmp_path / "study.sqlite") as kept:
        runner.prepare_store(study_plan, kept, resume=False)
        runner.run(study_plan, kept, Serial())
        assert [kept.trial(n)["status"] for n in range(2)] == ["solved", "cloudy"]


# --- the page -----------------------------------------------------------------------------------------------


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def commands() -> list[list[str]]:
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the page's files, its package as installed by pip, and this `python`."""
    folder = tmp_path_factory.mktemp("page")
    for block in blocks("python"):
        (folder / re.match(r"# (\w+\.py)\n", block)[1]).write_text(block)
    (folder / "who.yaml").write_text(blocks("yaml")[0])
    project = tomllib.loads(blocks("toml")[0])["project"]
    about = folder / f"{project['name']}-{project['version']}.dist-info"
    about.mkdir()
    named = "Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n".format(**project)
    (about / "METADATA").write_text(named)
    points = [
        f"{name} = {place}"
        for name, place in project["entry-points"]["skysim.trackers"].items()
    ]
    (about / "entry_points.txt").write_text("\n".join(["[skysim.trackers]", *points]))
    (folder / "bin").mkdir()
    (folder / "bin/python").symlink_to(sys.executable)
    return folder


def said(folder: Path, words: list[str]) -> str:
    path = os.pathsep.join([str(folder), str(ROOT)])
    environment = os.environ | {
        "PYTHONPATH": path,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    command = [sys.executable, "-m", "skysim", *words]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{words}: {done.stderr}"
    return done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    "words", [w for w in commands() if "tetra3rs" not in w], ids=" ".join
)
def test_the_page_s_commands_run_without_wrong_attitudes(
    folder: Path, words: list[str]
) -> None:
    page = said(folder, words)
    wrong = re.search(r"(\d+) wrong", page)
    assert wrong is None or wrong[1] == "0"
    assert "failed:" not in page


def test_the_page_s_json_follows_the_protocol() -> None:
    header, *answers = [json.loads(block) for block in blocks("json")]
    said = json.loads(program(FRAMES + "pass").frame_message(PICTURE)[0])
    assert list(header) == list(said)
    assert header["bytes"] == header["width_px"] * header["height_px"] * 2
    for answer in answers:
        check_answer(
            Answer.of_tree({key: value for key, value in answer.items() if key != "frame"})
        )


# What stands where the page has LOST: of the frame it sees one pixel, which says what it is to print.
LOST = """#!{python}
import shutil, sys, cv2
options = dict(zip(sys.argv[2::2], sys.argv[3::2]))
image = cv2.imread(options["--png"], cv2.IMREAD_UNCHANGED)
assert sys.argv[1] == "pipeline" and image.dtype == "uint8" and image.shape == (6, 8)
assert float(options["--focal-length"]) * 1000 / float(options["--pixel-size"]) == 100  # FocalLengthFromOptions
print("PNG Read status: no error has occurred")
shutil.copy(str(image[0, 0]), options["--print-attitude"])
"""
# RA, Dec, roll in degrees; LOST's own example of a solved picture is the first.
POINTED = [
    (225.102, 28.9928, 81.3329),
    (0, 0, 0),
    (10, -70, 200),
    (359, 89, 300),
    (83, 2, 20),
]


def multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """LOST's Quaternion::operator*: real, i, j, k."""
    real = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([real, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def of_lost(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """LOST's SphericalToQuaternion: the conjugate of turns by ra about z, by -dec about y, by -roll about x."""
    a, b, c = np.radians([ra_deg, -dec_deg, -roll_deg]) / 2
    about_z = np.array([np.cos(a), 0, 0, np.sin(a)])
    about_y = np.array([np.cos(b), 0, np.sin(b), 0])
    about_x = np.array([np.cos(c), np.sin(c), 0, 0])
    return multiplied(multiplied(about_z, about_y), about_x) * [1, -1, -1, -1]


def pixel_of_lost(quaternion: np.ndarray, star: np.ndarray) -> list[float]:
    """LOST's Attitude::Rotate and Camera::SpatialToCamera: pixel of a star from the upper left corner."""
    _, x, y, z = multiplied(
        multiplied(quaternion, np.array([0, *star])), quaternion * [1, -1, -1, -1]
    )
    assert x > 0
    return [-y / x * 100 + 8 / 2, -z / x * 100 + 6 / 2]


@pytest.mark.long
def test_the_page_s_adapter_reads_lost_s_axes_and_quaternion(tmp_path: Path) -> None:
    """By LOST's own formulas: its stars and ours fall on the same pixels, whose corner is (-0.5, -0.5) for us."""
    lost = tmp_path / "lost"
    adapter = tmp_path / "lost.py"
    adapter.write_text(
        next(block for block in blocks("python") if block.startswith("# lost.py"))
    )
    lost.mkdir()
    (lost / "lost").write_text(LOST.format(python=sys.executable))
    (lost / "lost").chmod(0o755)
    for n, pointed in enumerate(POINTED):
        values = [1, *pointed, *of_lost(*pointed)[[1, 2, 3, 0]]]
        keys = ("known", "ra", "de", "roll", "i", "j", "k", "real")
        rows = [
            f"attitude_{key} {value:.6g}\n" for key, value in zip(keys, values, strict=True)
        ]
        (lost / str(n)).write_text("".join(rows))
    (lost / str(len(POINTED))).write_text("attitude_known 0\n")
    words = [sys.executable, str(adapter), str(lost), "{folder}"]
    runs = tracker_interface.TrackerProgram(
        "lost", words, "png", replace(SETUP, saturation_dn=255.0), 20.0
    )
    answers = [
        check_answer(
            runs.solve(replace(PICTURE, frame=n, image_dn=np.full((6, 8), n, np.uint16)))
        )
        for n in range(len(POINTED) + 1)
    ]
    runs.close()
    assert [answer.status for answer in answers] == ["solved"] * len(POINTED) + [
        "no attitude"
    ]
    for pointed, answer in zip(POINTED, answers, strict=False):
        turn = Rotation.from_quat(answer.cam_from_ref_xyzw)
        assert (turn * stars.cam_from_icrs(*pointed).inv()).magnitude() < 5e-6  # six digits
        for ray in ([0, 0, 1], [0.03, 0, 1], [-0.02, 0.025, 1]):
            star = turn.inv().apply(ray / np.linalg.norm(ray))
            seen = 100 * np.array(ray[:2]) + SETUP.center_px + 0.5
            np.testing.assert_allclose(
                pixel_of_lost(of_lost(*pointed), star), seen, rtol=0, atol=1e-3
            )


def test_every_key_of_the_protocol_is_on_the_page() -> None:
    keys = [
        *Setup.__slots__,
        *Picture.__slots__,
        *Answer.__slots__,
        *Stars.__slots__,
        *Leds.__slots__,
    ]
    assert [key for key in keys if f"`{key}`" not in PAGE] == []
