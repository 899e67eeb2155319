"""Terminal output of the command line: progress bars, tables, summaries. Slow imports are inside the functions."""

from __future__ import annotations

import itertools
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from skysim.core.errors import printable

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import ProgressColumn
    from rich.text import Text

    from skysim.core.types import FrameRow, Telemetry
    from skysim.experiments.study.execution.runner import Progress
    from skysim.experiments.tracker_comparison import TrackerScore
    from skysim.simulation.checks.facts import Fact
    from skysim.simulation.lab import Lab

T = TypeVar("T")
WIDE = 240  # characters in a line of a file
ANIMATION_FRAMES = 60


def eager_first(items: Iterable[T]) -> Iterator[T]:
    """Return the same items, the first computed at once: its errors then appear before old results are cleared."""
    iterator = iter(items)
    return itertools.chain([next(iterator)], iterator)


def progress(items: Iterable[T], total: int, what: str, quiet: bool = False) -> Iterator[T]:
    """Yield the items, with a progress bar on stderr that disappears at the end."""
    if quiet or not sys.stderr.isatty():  # without the time that it takes to import the bar
        yield from items
        return
    with bar() as shown:
        yield from shown.track(items, total=total, description=printable(what))


def bar(*columns: ProgressColumn, quiet: bool = False) -> Bar:
    """A transient progress bar on stderr: description, then columns. Disabled if stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    what = TextColumn("{task.description}", markup=False)  # a title may contain brackets
    columns = columns or (BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    return Progress(what, *columns, console=console, transient=True, disable=quiet or not console.is_terminal)


def colored(text: str, color: str) -> Text:
    """Colored text for a table cell."""
    from rich.text import Text

    return Text(text, color)


def print_table(title: str, headers: Sequence[str], lines: Sequence[Sequence[str | Text]]) -> None:
    """Print a table. Strings are printed literally: rich's markup in them has no effect."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, header_style="bold", pad_edge=False)
    table.title = Text(printable(title), "table.title", justify="left")
    for head in headers:
        table.add_column(
            Text(printable(head)),
            justify="left" if head in ("what", "file", "status", "peer", "verdict") else "right",
            no_wrap=True,
        )
    for line in lines:
        table.add_row(*(Text(printable(cell)) if isinstance(cell, str) else cell for cell in line))
    Console(width=terminal_width()).print(table)


def terminal_width() -> int:
    """Characters in a line: of the terminal, or WIDE if the output goes to a file."""
    from rich.console import Console

    console = Console()
    return console.width if console.is_terminal else max(console.width, WIDE)


def print_rows(rows: list[FrameRow], names: tuple[str, str, str], exposures_ms: list[float]) -> None:
    """Print one line per frame of a run; a narrow terminal gets fewer columns, and their names.

    exposures_ms : exposure time of each frame;  names : of the three angles
    """
    triple = "/".join(names)
    headers = ["frame", "t s", "exp ms", "deg/s", f"true {triple}", f"estimate {triple}"]
    headers += ["cross ″", "roll ″", "used", "ms", "status"]
    lines = [
        [
            str(row.frame),
            f"{row.t_s:.2f}",
            f"{exposure_ms:.5g}",
            f"{row.rate_deg_s:.2f}",
            format_angles(row.truth_deg),
            format_angles(row.estimate_deg),
            f"{row.cross_arcsec:.3f}" if row.estimate_deg else "",
            f"{row.roll_arcsec:+.3f}" if row.estimate_deg else "",
            f"{row.matched}/{row.detected}",
            f"{row.time_ms:.1f}",
            colored("WRONG", "red") if row.wrong else row.status,
        ]
        for row, exposure_ms in zip(rows, exposures_ms, strict=True)
    ]
    print_fitting(headers, lines, [headers.index(name) for name in (f"estimate {triple}", "exp ms", "ms", "deg/s")])


def print_fitting(headers: list[str], lines: Sequence[Sequence[str | Text]], optional: Sequence[int]) -> None:
    """Print a table; optional columns are left out, the first of them first, if the terminal is too narrow."""
    shown = list(range(len(headers)))
    for column in optional:
        if table_width([headers[n] for n in shown], [[line[n] for n in shown] for line in lines]) > terminal_width():
            shown.remove(column)
    print_table("", [headers[n] for n in shown], [[line[n] for n in shown] for line in lines])
    if left_out := [headers[n] for n in optional if n not in shown]:
        print_wrapped(f"in the report, or in a wider terminal: {', '.join(left_out)}")


def print_wrapped(text: str, first: str = "", others: str = "  ") -> None:
    """Print a text in lines of the terminal's width. first, others : what the first line and the others begin with"""
    import textwrap

    width = max(terminal_width(), 40)
    print(textwrap.fill(printable(text), width, initial_indent=first, subsequent_indent=others, break_on_hyphens=False))


def table_width(headers: Sequence[str], lines: Sequence[Sequence[str | Text]]) -> int:
    """Characters in a line of a table whose columns are two characters apart."""
    return sum(max(map(len, column)) for column in zip(headers, *lines, strict=True)) + 2 * (len(headers) - 1)


def format_angles(angles_deg: tuple[float, float, float] | None) -> str:
    return " ".join(f"{angle:9.4f}" for angle in angles_deg) if angles_deg else ""


@contextmanager
def progress_callback(what: str, quiet: bool = False) -> Iterator[Callable[[float, float], None]]:
    """Show a progress bar on stderr and yield its update function done(completed, total)."""
    with bar(quiet=quiet) as shown:
        task = shown.add_task(printable(what))
        yield lambda now, everything: shown.update(task, completed=now, total=everything)


@contextmanager
def trial_progress(what: str, total: int, unit: str = "trials") -> Iterator[Callable[[Progress], None]]:
    """Show a progress bar for trials on stderr: done, rate, time left, failures. Yields its update function.

    If stderr is no terminal, print a line after every tenth of the trials instead.
    """
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    console, what = Console(stderr=True), printable(what)
    text = "{task.completed:.0f}/{task.total:.0f}  {task.fields[rate]:.0f}/s  {task.fields[faults]}"
    tenth = 0
    with bar(BarColumn(), TextColumn(text), TimeRemainingColumn()) as shown:
        task = shown.add_task(what, total=total, rate=0.0, faults="")

        def update(done: Progress) -> None:
            nonlocal tenth
            faults = f"{done.failed} failed" + (f", {done.wrong} wrong" if done.wrong else "")
            shown.update(task, completed=done.done, rate=done.rate, faults=faults)
            if not console.is_terminal and 10 * done.done // total > tenth:
                tenth = 10 * done.done // total
                line = f"{what}: {done.done} of {total}, {done.rate:.0f} {unit}/s, {faults}"
                print(line, file=sys.stderr, flush=True)

        yield update


def print_motion(run: dict[str, float]) -> None:
    """Print the metrics of the motion; those that a scene does not have are skipped."""
    templates = {
        "pointing_deg_worst": "pointing: worst {pointing_deg_worst:.3g}°, at the end {pointing_deg_end:.2g}°; "
        "maximum commanded torque {torque_nm_worst:.3g} N m",
        "momentum_nms_worst": "maximum stored momentum {momentum_nms_worst:.3g} N m s",
        "wheel_rpm_worst": "maximum wheel speed {wheel_rpm_worst:.0f} rpm",
        "manipulability_least": "minimum CMG manipulability {manipulability_least:.2g}",
        "imu_deg_worst": "IMU alone: error {imu_deg_end:.3g}° at the end; gyros saturated for {gyro_saturated_s:.2g} s",
        "filter_deg_worst": "filter: worst {filter_deg_worst:.3g}°, at the end {filter_arcsec_end:.3g}″, "
        "bias error {filter_bias_deg_h_end:.2g}°/h",
    }
    lines = [text.format(**run) for key, text in templates.items() if key in run]
    mounts = re.findall(r"mounting_(\w+)_arcsec_end", " ".join(run))
    if mounts:
        errors = ", ".join(f"{name} {run[f'mounting_{name}_arcsec_end']:.3g}″" for name in mounts)
        lines.append(f"mounting error at the end: {errors}")
    for n, line in enumerate(lines):
        print_wrapped(line, first=" " * 8 if n else "motion: ", others=" " * 8)


def print_summary(run: dict[str, Any]) -> None:
    print()
    print_wrapped(
        f"{run['solved']} of {run['frames']} frames solved, {run['wrong']} wrong; "
        f"cross-boresight median {run['cross_arcsec_median']:.3g}″ worst {run['cross_arcsec_worst']:.3g}″, "
        f"roll median {run['roll_arcsec_median']:.3g}″ worst {run['roll_arcsec_worst']:.3g}″"
    )
    stages = ", ".join(f"{name} {ms:.2f}" for name, ms in run["stages_ms"].items())
    print_wrapped(f"median ms per frame: {stages}")
    print_motion(run["flight"])
    print(f"report: {run['report']}")


def print_head(name: str, run: dict[str, Any]) -> None:
    """Print the result of a further star camera."""
    print_wrapped(
        f"{name}: {run['solved']} of {run['frames']} frames solved, {run['wrong']} wrong; "
        f"cross-boresight median {run['cross_arcsec_median']:.3g}″, roll median {run['roll_arcsec_median']:.3g}″; "
        f"report: {run['report']}"
    )


FACT_COLUMN = 21  # of the text of a fact
MAX_WIDTH = 80  # of the lines of a check


def print_check(facts: Sequence[Fact], findings: Sequence[str]) -> None:
    """Print the facts of a plan, names at the left, and its warnings; lines of at most 80 columns."""
    import textwrap

    for fact in facts:
        print_fact(fact)
    for finding in findings:
        print(textwrap.fill(f"warning: {printable(finding)}", MAX_WIDTH, subsequent_indent="  "))
    if not findings:
        print("no warnings")


def print_fact(fact: Fact) -> None:
    """Print one fact of a plan, its name at the left."""
    import textwrap

    lines = [part for line in fact.lines for part in textwrap.wrap(line, MAX_WIDTH - FACT_COLUMN)]
    for name, line in zip([fact.name, *[""] * (len(lines) - 1)], lines, strict=True):
        print(f"{name:{FACT_COLUMN}}{line}")


def print_scores(lines: list[TrackerScore], folder: Path) -> None:
    """Print the scoreboard of a comparison, and the reasons for unsolved frames."""
    headers = ["what", "frames", "right %", "(95 %)", "wrong", "refused", "failed"]
    headers += ["cross ″", "worst ″", "roll ″", "worst ″", "ms", "95 % ms"]
    optional = [12, 11, 3, 10, 8]  # the times, the interval, the worst errors
    rows = [
        [
            line.tracker,
            str(line.frames),
            f"{100 * line.right.value:.1f}",
            f"{100 * line.right.low:.1f} to {100 * line.right.high:.1f}",
            colored(str(line.wrong), "red") if line.wrong else "0",
            str(line.refused),
            str(line.failed),
            *(f"{value:.3g}" for value in (line.cross_arcsec_median, line.cross_arcsec_worst)),
            *(f"{value:.3g}" for value in (line.roll_arcsec_median, line.roll_arcsec_worst)),
            *(f"{value:.3g}" for value in (line.time_ms_median, line.time_ms_p95)),
        ]
        for line in lines
    ]
    print_fitting(headers, rows, optional)
    for line in lines:
        for status, count in line.refusals.items():
            print(f"{line.tracker}: {count} × {status}")
    print_wrapped(f"scoreboard.ecsv, solutions.NAME.ecsv and the frames are in {folder}")


def print_solutions(solutions: list[dict[str, Any]], out: Path) -> None:
    headers = ["file", "status", "RA °", "Dec °", "roll °", "fov °", "stars", "rms ″", "ms"]
    lines = [
        [
            a["file"],
            a["status"] if a["time_ms"] is not None else "bad input",
            *(format_number(a[key], 4) for key in ("ra_deg", "dec_deg", "roll_deg", "fov_deg")),
            str(a["matches"]),
            format_number(a["rms_arcsec"], 1),
            format_number(a["time_ms"], 0),
        ]
        for a in solutions
    ]
    print_table("", headers, lines)
    for solution in solutions:
        print_remarks(solution)
    print(f"annotated images and solutions.json in {out}")


def print_remarks(solution: dict[str, Any]) -> None:
    """Print what `skysim solve` saw, tried and concludes, for a refused image; or what it assumed."""
    if not solution["hint"]:
        return
    print(f"\n{printable(solution['file'])}: {printable(solution['status'])}")
    if solution["ra_deg"] is None:
        fields = " and ".join(f"{narrow:g}° to {wide:g}°" for narrow, wide in solution["tried_fov_deg"])
        print(
            f"  seen:   {solution['lights']} lights, the brightest pixel {solution['brightest_dn']:g} DN,"
            f" the background {solution['background_dn']:g} DN\n"
            f"  tried:  fields {fields} wide, stars to V {solution['catalog_limit_mag']:g}"
        )
    print(f"  {'likely' if solution['ra_deg'] is None else 'note'}: {printable(solution['hint'])}")


def print_json(data: Any) -> None:
    from skysim.core.io.files import to_json

    print(to_json(data))


def print_list(entries: list[dict[str, Any]], json: bool, line: Callable[[dict[str, Any]], str]) -> None:
    """Print entries as JSON or, one per line, as text."""
    if json:
        print_json(entries)
        return
    for entry in entries:
        print(line(entry))


def print_catalog(catalog: dict[str, Any], json: bool) -> None:
    if json:
        print_json(catalog)
        return
    sources = ", ".join(f"{count} {name}" for name, count in catalog["sources"].items())
    print(f"{catalog['path']}: {catalog['stars']} stars ({sources}), epoch J{catalog['meta']['epoch_jyear']}")
    print("  ".join(f"V<{limit}: {count}" for limit, count in catalog["brighter_than"].items()))
    for key, value in catalog["meta"].items():
        print(f"  {key}: {printable(value)}")


def print_titles(folder: Path, json: bool) -> None:
    """Print names and titles of the YAML files in a folder."""
    from skysim.core.paths import title_of

    listed = [{"name": path.stem, "title": title_of(path), "file": str(path)} for path in sorted(folder.glob("*.yaml"))]
    print_list(listed, json, lambda entry: f"{entry['name']:20s} {printable(entry['title'])}")


def format_number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def print_error(message: str, code: int = 2) -> int:
    """Print one line to stderr and return the exit code."""
    print(f"skysim: {printable(message)}", file=sys.stderr)
    return code


def write_3d_views(lab: Lab, log: Telemetry, folder: Path) -> list[Path]:
    """Write a still and an animation of the laboratory in 3-D; return their paths.

    Without OpenGL print a message and return an empty list, so that the run continues.
    """
    from skysim.core.io import files
    from skysim.dynamics.multibody.view import picture

    mjcf, joints = lab.export_mjcf(), log.joints
    image_path, animation_path = folder / "scene_3d.png", folder / "scene_3d.gif"
    steps = max(len(joints) // ANIMATION_FRAMES, 1)
    states = joints[::steps]
    try:
        files.write_image(image_path, picture.picture(mjcf, joints[len(joints) // 2])[:, :, ::-1])
        shown = progress(picture.film(mjcf, states), len(states), "rendering the animation")
        picture.write_film(shown, animation_path, len(states) / float(log.t_s[-1] + 1e-9))
    except picture.NoPicture as error:
        print_error(str(error))
        return []
    return [image_path, animation_path]
