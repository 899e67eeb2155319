"""Our attitude messages, read and checked against the standard by ccsds-ndm-py (extra `oracle`)."""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.dynamics.profiles import read_profile
from skysim.results.files import run_export

ndm = pytest.importorskip("ccsds_ndm", reason="the package ccsds-ndm-py is not installed")

START = datetime.datetime(2016, 12, 31, 23, 59, 58, 250_000)


def utc(count: int) -> list[datetime.datetime]:
    return [START + n * datetime.timedelta(seconds=0.1) for n in range(count)]


@pytest.mark.parametrize(
    "frames", [(run_export.ICRF, run_export.CAMERA), (run_export.LAB, run_export.BODY)]
)
@pytest.mark.parametrize("count", [1, 2, 200])
def test_our_aem_is_valid_and_has_the_intended_metadata(
    tmp_path: Path, frames: tuple[str, str], count: int
) -> None:
    """Version, frames, span and every digit of every quaternion; also after ccsds-ndm-py rewrites it as XML."""
    meant = Rotation.random(count, rng=np.random.default_rng(count))
    path = tmp_path / "truth.aem"
    files.write_text(
        path,
        run_export.message("afit_simsat", ["LED dome, 3″ off"], frames, utc(count), meant),
    )
    read = ndm.Aem.from_file(str(path), format="kvn")
    assert read.validate(strict=False) is None
    assert (read.version, read.header.originator) == ("2.0", "SKYSIM")
    for message in (read, ndm.Aem.from_str(read.to_str("xml"))):
        (segment,) = message.segments
        metadata = segment.metadata
        assert (metadata.ref_frame_a, metadata.ref_frame_b) == frames
        assert (metadata.time_system, metadata.attitude_type, metadata.object_name) == (
            "UTC",
            "QUATERNION",
            "AFIT_SIMSAT",
        )
        epochs = [
            datetime.datetime.fromisoformat(text)
            for text in segment.data.attitude_states_epochs
        ]
        assert epochs == utc(count)
        assert (metadata.start_time, metadata.stop_time) == (
            run_export.epoch(epochs[0]),
            run_export.epoch(epochs[-1]),
        )
        off = (
            Rotation.from_quat(segment.data.attitude_states_numpy) * meant.inv()
        ).magnitude()
        assert off.max() < 1e-14


def test_ccsds_ndm_refuses_a_malformed_aem() -> None:
    """This shows that the tests above can fail."""
    good = run_export.message(
        "x", [], (run_export.LAB, run_export.BODY), utc(2), Rotation.identity(2)
    )
    for old, new in (
        ("REF_FRAME_A = LAB\n", ""),
        ("= QUATERNION", "= QUATRNION"),
        ("VERS = 2.0", "VERS = 7.0"),
    ):
        assert old in good
        with pytest.raises(ValueError, match=r"REF_FRAME_A|QUATRNION|7\.0"):
            ndm.Aem.from_str(good.replace(old, new), "kvn")
    with pytest.raises(InputError):
        run_export.message(
            "x", [], (run_export.LAB, run_export.BODY), utc(2)[::-1], Rotation.identity(2)
        )


def test_an_aem_written_by_ccsds_ndm_is_read_by_skysim(tmp_path: Path) -> None:
    """Both readers take the same numbers for the same epochs. Theirs does not know the keywords of version 1.0."""
    meant = Rotation.from_rotvec(np.outer(np.arange(9.0), [0.01, -0.02, 0.005]))
    text = run_export.message(
        "x", ["of ours"], (run_export.ICRF, run_export.BODY), utc(9), meant
    )
    theirs = ndm.Aem.from_str(text, "kvn")
    path = tmp_path / "theirs.aem"
    path.write_text(theirs.to_str("kvn"))
    read = read_profile(path, START)
    assert read.direction == "icrs_from_body"
    np.testing.assert_allclose(read.t_s, np.arange(9) / 10, rtol=0, atol=1e-9)
    (segment,) = theirs.segments
    their_attitudes = Rotation.from_quat(segment.data.attitude_states_numpy)
    assert (read.a_from_b * their_attitudes.inv()).magnitude().max() < 1e-14
    assert (read.a_from_b * meant.inv()).magnitude().max() < 1e-14


def test_the_page_s_code_reads_our_aem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs/howto/export.md").read_text(encoding="utf-8")
    (block,) = [
        block
        for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        if "ccsds_ndm" in block
    ]
    (tmp_path / "out/shefex2").mkdir(parents=True)
    # The camera's boresight along the ICRF's x.
    meant = Rotation.from_euler("y", [[90]], degrees=True)
    text = run_export.message(
        "shefex2", [], (run_export.ICRF, run_export.CAMERA), utc(1), meant
    )
    files.write_text(tmp_path / "out/shefex2/truth.aem", text)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "docs/howto/export.md", "exec"), {})
    frame, epoch, *sight = capsys.readouterr().out.replace("[", " ").replace("]", " ").split()
    assert (frame, epoch) == ("ICRF", run_export.epoch(START))
    np.testing.assert_allclose(np.array(sight, dtype=float), [1, 0, 0], rtol=0, atol=1e-8)
