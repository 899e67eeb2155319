"""Commands `skysim catalog select`, `readcat` and `proc-cat`: the shipped files, PTASE's way, and refusals."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from estimator.catalog import cat_file, catalog
from skysim.apps.cli.main import app
from skysim.core.errors import InputError
from skysim.core.paths import CATALOGS
from skysim.tracking.onboard_model import onboard_catalog


def answer(*words: str | Path) -> dict:
    """What a command prints as JSON. Raises the command's error."""
    ran = CliRunner().invoke(app, ["catalog", *map(str, words), "--json"])
    if ran.exception:
        raise ran.exception
    return json.loads(ran.output)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["asymmetric", "uniform", "chosen"])
def test_the_shipped_catalogs_are_what_select_writes(tmp_path: Path, rule: str) -> None:
    out = tmp_path / "new.ecsv"
    facts = answer("select", "hipparcos_hp6.5", "--rule", rule, "--out", out)
    shipped = CATALOGS / f"shefex_{rule}.ecsv"
    assert out.read_bytes() == shipped.read_bytes()
    assert facts["stars"] == len(catalog.read(shipped)) == facts["meta"]["rows"]


def test_a_selection_of_a_selection_says_both_rules(tmp_path: Path) -> None:
    out = tmp_path / "new.ecsv"
    words = ("--rule", "asymmetric", "--north", "3", "--south", "4", "--out", out)
    meta = answer("select", "shefex_chosen", *words)["meta"]
    assert meta["selection"] == (
        "chosen of hipparcos_hp6.5; then asymmetric of shefex_chosen, north_mag 3, south_mag 4"
    )
    stars = catalog.read(out)
    assert np.all(stars.v_mag <= np.where(stars.vectors[:, 2] >= 0, 3, 4))


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            "uniform --north 3 --out x.ecsv",
            "--north: has no effect with --rule uniform; allowed: --count, --faintest, --bright",
        ),
        (
            "asymmetric --count 9 --out x.ecsv",
            "--count: has no effect with --rule asymmetric; allowed: --north, --south",
        ),
        ("chosen --out x.csv", "--out: x.csv; allowed: a file .ecsv"),
    ],
)
def test_an_option_without_effect_is_refused(words: str, complaint: str) -> None:
    with pytest.raises(InputError) as error:
        answer("select", "hipparcos_hp6.5", "--rule", *words.split())
    assert str(error.value) == complaint


def test_ptase_s_two_programs_prepare_a_tracker_s_catalog(tmp_path: Path) -> None:
    raw = tmp_path / "raw.cat"
    out = tmp_path / "m5.cat"
    words = ("--limit", "5", "--epoch", "2010", "--color", "0.1", "0", "0", "--out", raw)
    found = answer("readcat", "hipparcos_hp6.5", *words)
    assert found["entries"] == found["stars"]
    assert found["faintest_mag"] == pytest.approx(5.1, abs=0.01)  # V 5 + 0.1
    merged = answer("proc-cat", raw, "--closer", "60", "--out", out)
    assert merged["stars"] == found["stars"] > merged["entries"]
    assert answer("info", out) == merged
    # The log has the histogram and a line for every entry.
    lines = out.with_suffix(".log").read_text().splitlines()
    assert lines[0].startswith(f"{merged['entries']} entries from {merged['stars']} stars")
    stars = onboard_catalog("tracker.catalog", str(out))
    assert stars.epoch_yr == 2010
    np.testing.assert_array_equal(stars.id, cat_file.read(out).id)
