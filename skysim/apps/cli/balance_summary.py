"""Terminal output of `skysim balance`: one line per flight, then what was found."""

from __future__ import annotations

from typing import Any

from skysim.apps.cli.terminal import print_table, print_wrapped
from skysim.experiments.balance import report


def print_flight(row: dict[str, Any]) -> None:
    """Print one flight: offset with its standard deviation, torque, where the trim masses go."""
    found = zip(row["offset_um"], row["offset_sigma_um"], strict=True)
    offset = ", ".join(f"{value:.3g} ± {sigma:.2g}" for value, sigma in found)
    places = "/".join(f"{one:.3f}" for one in row["next_trim_mm"])
    moved = f"; trim masses to {places} mm" if row["next_trim_mm"] != row["trim_mm"] else ""
    contact = f", {row['after_contact']} of them after a contact" if row["after_contact"] else ""
    print_wrapped(
        f"flight {row['flight']}: {row['solved']} of {row['frames']} frames solved{contact};"
        f" center of mass at {offset} um;"
        f" gravity torque {row['torque_nm']:.2g} N m, at most {row['torque_bound_nm']:.2g} N m{moved}"
    )


def print_balance(result: dict[str, Any]) -> None:
    """Print the mass properties and the end."""
    for title, rows in report.tables(result):
        lines = [[row["what"], *(f"{row[key]:.5g}" for key in ("estimate", "sigma", "truth"))] for row in rows]
        print_table(title, ["what", "estimate", "1σ", "simulated vehicle"], lines)
    last = result["flights"][-1]
    end = "balanced" if result["balanced"] else "not balanced"
    print_wrapped(
        f"{end}: gravity torque at most {last['torque_bound_nm']:.2g} N m, bar {result['torque_bar_nm']:.2g} N m; the"
        f" simulated vehicle's is {last['true_torque_nm']:.2g} N m; misfit {result['misfit']:.2f}; report"
        f" {result['report']}"
    )
