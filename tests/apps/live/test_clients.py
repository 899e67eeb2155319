"""The two clients of docs/howto/live.md close the attitude loop over the wire, and the page's other blocks run.

Those of docs/howto/protocols.md run here, in test_gige and in test_indi.
"""

import re
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.apps.live.commands import CommandState
from skysim.apps.live.pacing import Live, Pace
from skysim.apps.live.wire import WireServer
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from tests.docs.test_docs_blocks import blocks

HOWTO = Path(__file__).parents[3] / "docs/howto"
ANSWER_S = 60.0  # time for an answer on a loaded machine


def block(language: str, first: str) -> str:
    """The block of the two pages that has this text in it."""
    every = [one for page in ("live.md", "protocols.md") for one in blocks(HOWTO / page)]
    (found,) = (one.text for one in every if one.language == language and first in one.text)
    return found


def client(language: str, folder: Path) -> list[str]:
    """Command of a client of the page, without the port."""
    if language == "python":
        path = folder / "loop.py"
        path.write_text(block("python", "# loop.py"))
        return [sys.executable, str(path)]
    path = folder / "loop.c"
    path.write_text(block("c", "/* loop.c"))
    program = str(folder / "loop")
    subprocess.run(["gcc", "-O2", "-Wall", "-Werror", path, "-lm", "-o", program], check=True)
    return [program]


def lines_of_code(language: str, first: str) -> int:
    return len([line for line in block(language, first).splitlines() if line.strip()])


def test_the_clients_are_as_short_as_the_page_promises() -> None:
    assert lines_of_code("python", "# loop.py") <= 24
    assert lines_of_code("c", "/* loop.c") <= 62


@pytest.mark.slow
@pytest.mark.parametrize("language", ["python", "c"])
def test_a_client_turns_the_vehicle_over_the_wire(language: str, tmp_path: Path) -> None:
    """By 5 degrees about its z axis, as it does with neither the scene's law nor its tracker's truth.

    No clock paces the flight: once the client knows the attitude, each period waits for its torque.
    """
    flight = open_flight(
        loader.load("simsat_bump", {"exposure.frames": "16"}), keeps_history=False
    )
    live = Live(flight, Pace(0.0, 2.0), [], CommandState(flight, 0.5, False), may_solve=True)
    server = WireServer(live, "127.0.0.1", 0, "")
    live.outputs.append(server)
    start = flight.state.lab_from_body
    live.warm_up()
    with subprocess.Popen([*client(language, tmp_path), str(server.port)]) as process:
        assert live.entered.wait(ANSWER_S)
        while flight.now_s < 7.5:
            knows_attitude = live.rendered > 0
            live.advance()
            until_s = time.monotonic() + ANSWER_S
            while knows_attitude and not live.inbox.waiting:
                assert time.monotonic() < until_s, "the client does not answer"
                time.sleep(1e-4)
        server.close()
        assert process.wait(ANSWER_S) in (0, 1)
    turned_deg = np.degrees((start.inv() * flight.state.lab_from_body).as_rotvec())
    # exp(-0.7 / s 7 s) of the turn is left. Across it gravity turns by m g offset / (J 1 / s^2).
    gravity_deg = np.degrees(80 * 9.81 * 0.02e-3 / 6)
    np.testing.assert_allclose(turned_deg[:2], 0, atol=gravity_deg + 0.03)
    assert turned_deg[2] == pytest.approx(5, abs=0.07)
    assert live.commands.refused == 0
    assert live.commands.received > 500
    assert server.counters()["dropped"] == {}


@pytest.mark.slow
def test_the_page_s_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = block("sh", "--tcp 8091") + block("sh", "--display")
    if find_spec("mcap_ros2"):
        lines += block("sh", "--mcap")
    for line in lines.splitlines():
        words = re.sub(r"8091|8765", "0", line.partition("#")[0]).split()[1:]
        done = CliRunner().invoke(main.app, [*words, "--speed", "0"], catch_exceptions=False)
        assert re.search(r"\d frames rendered, 0 dropped", done.output)
    exec(compile(block("python", "unpack"), "live.md", "exec"), {})
