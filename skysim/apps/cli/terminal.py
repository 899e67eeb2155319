"""Terminal output of the command line: progress bars, tables, summaries. Slow imports are inside the functions."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from skysim.core.errors import printable, shortened
from skysim.core.paths import shipped_files, title_of
from skysim.results.report import (
    Cell,
    Column,
    Table,
    print_table,
    print_wrapped,
)

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import ProgressColumn

    from skysim.core.types import Record, Telemetry
    from skysim.experiments.study.execution.runner import Progress
    from skysim.experiments.tracker_comparison import TrackerScore
    from skysim.simulation.lab import Lab


T = TypeVar("T")
ANIMATION_FRAMES = 60
LINE_S = 60.0  # longest time without a line of progress if stderr is no terminal


def progress(items: Iterable[T], total: int, what: str, quiet: bool = False) -> Iterator[T]:
    """Yield the items, with a progress bar on stderr that disappears at the end."""
    if quiet or not sys.stderr.isatty():  # saves the import of the bar
        yield from items
        return
    with bar() as shown:
        yield from shown.track(items, total=total, description=printable(what))


def bar(*columns: ProgressColumn) -> Bar:
    """A transient progress bar on stderr: description, then columns. Disabled if stderr is not a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    what = TextColumn("{task.description}", markup=False)  # a title may contain brackets
    columns = columns or (BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    return Progress(
        what, *columns, console=console, transient=True, disable=not console.is_terminal
    )


@contextmanager
def progress_callback(what: str) -> Iterator[Callable[[float, float], None]]:
    """Show a progress bar on stderr and yield its update function done(completed, total)."""
    with bar() as shown:
        task = shown.add_task(printable(what))
        yield lambda now, everything: shown.update(task, completed=now, total=everything)


@contextmanager
def trial_progress(
    what: str, total: int, unit: str = "trials"
) -> Iterator[Callable[[Progress], None]]:
    """Show a progress bar for trials on stderr: done, rate, time left, failures. Yields its update function.

    If stderr is not a terminal, print a line at the beginning, after every tenth of the trials, and once a minute.
    """
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    what = printable(what)
    text = "{task.completed:.0f}/{task.total:.0f}  {task.fields[rate]:.2g}/s  {task.fields[faults]}"
    tenth = 0
    shown_s = time.monotonic()
    with bar(BarColumn(), TextColumn(text), TimeRemainingColumn()) as shown:
        if not shown.console.is_terminal:
            print(f"{what}: {total} {unit}", file=sys.stderr, flush=True)
        task = shown.add_task(what, total=total, rate=0.0, faults="")

        def update(done: Progress) -> None:
            nonlocal tenth, shown_s
            faults = f"{done.failed} failed" + (f", {done.wrong} wrong" if done.wrong else "")
            shown.update(task, completed=done.done, rate=done.rate, faults=faults)
            late = time.monotonic() - shown_s > LINE_S
            if not shown.console.is_terminal and (late or 10 * done.done // total > tenth):
                tenth = 10 * done.done // total
                shown_s = time.monotonic()
                line = f"{what}: {done.done} of {total}, {done.rate:.2g} {unit}/s, {faults}"
                print(line, file=sys.stderr, flush=True)

        yield update


def fail_if_not_met(judged: Iterable[Mapping[str, Any]]) -> None:
    """End with exit code 1 if a requirement is not met; one that is not shown yet is no failure."""
    from typer import Exit

    from skysim.results.requirements import NOT_MET

    if any(one["answer"] == NOT_MET for one in judged):
        raise Exit(1)


def print_scores(lines: list[TrackerScore], folder: Path) -> None:
    """Print the scoreboard of a comparison, and the reasons for unsolved frames."""
    columns = [
        "tracker",
        Column("frames"),
        Column("right", "%", ".1f"),
        *map(Column, ("(95 %)", "wrong", "refused", "failed")),
        *(Column(head, "″", ".3g") for head in ("cross", "worst", "roll", "worst")),
        *(Column(head, format=".3g") for head in ("NEES", "ms", "95 % ms")),
    ]
    rows = [
        [
            line.tracker,
            line.frames,
            100 * line.right.value,
            f"{100 * line.right.low:.1f} to {100 * line.right.high:.1f}",
            Cell(str(line.wrong), "bad" if line.wrong else ""),
            line.refused,
            line.failed,
            line.cross_arcsec_median,
            line.cross_arcsec_worst,
            line.roll_arcsec_median,
            line.roll_arcsec_worst,
            line.nees,
            line.time_ms_median,
            line.time_ms_p95,
        ]
        for line in lines
    ]
    left_out = ((13,), (12,), (3,), (10,), (8,))  # the times, the interval, the worst errors
    print_table(Table(columns, rows, optional=left_out))
    for line in lines:
        for status, count in line.refusals.items():
            print(f"{line.tracker}: {count} × {status}")
    print_wrapped(f"scoreboard.ecsv, solutions.NAME.ecsv and the frames are in {folder}")


def print_solutions(solutions: list[Record], out: Path) -> None:
    """Print the attitudes of pictures of the sky, or of a dome's LEDs, with remarks."""
    if "leds" in solutions[0]:
        keys = (
            "roll_deg pitch_deg yaw_deg cross_sigma_arcsec roll_sigma_arcsec matches rms_px"
        )
        columns = [Column(name, "°", ".4f") for name in ("roll", "pitch", "yaw")]
        columns += [Column(name, "″", ".3g") for name in ("cross 1σ", "roll 1σ")]
        columns += [Column("LEDs"), Column("rms px", "", ".2f")]
    else:
        keys = "ra_deg dec_deg roll_deg fov_deg matches rms_arcsec"
        columns = [Column(name, "°", ".4f") for name in ("RA", "Dec", "roll", "fov")]
        columns += [Column("stars"), Column("rms", "″", ".1f")]
    rows = []
    for one in solutions:
        status = one["status"] if one["time_ms"] is not None else "bad input"
        rows.append([one["file"], status, *(one[key] for key in (*keys.split(), "time_ms"))])
    print_table(Table(["file", "status", *columns, Column("ms", format=".0f")], rows))
    for solution in solutions:
        print_remarks(solution)
    print(f"annotated images and solutions.json in {out}")


def print_remarks(solution: Record) -> None:
    """Print what `skysim solve` saw, tried and concluded for a refused image, or assumed for a solved one."""
    if not solution["hint"]:
        return
    print(f"\n{printable(solution['file'])}: {printable(solution['status'])}")
    refused = solution["roll_deg"] is None
    if refused:
        print(
            f"  seen:   {solution['lights']} lights, the brightest pixel {solution['brightest_dn']:g} DN,"
            f" the background {solution['background_dn']:g} DN"
        )
    if refused and "leds" not in solution:
        fields = " and ".join(
            f"{narrow:g}° to {wide:g}°" for narrow, wide in solution["tried_fov_deg"]
        )
        print(f"  tried:  fields {fields} wide, stars to V {solution['catalog_limit_mag']:g}")
    print(f"  {'likely' if refused else 'note'}: {printable(solution['hint'])}")


def print_json(data: Any) -> None:
    from skysim.core.files import to_json

    print(to_json(data))


def print_list(entries: list[Record], json: bool, line: Callable[[Record], str]) -> None:
    """Print entries as JSON or, one per line, as text."""
    if json:
        print_json(entries)
        return
    for entry in entries:
        print(line(entry))


def print_catalog(catalog: Record, json: bool) -> None:
    if json:
        print_json(catalog)
        return
    sources = ", ".join(f"{count} {name}" for name, count in catalog["sources"].items())
    print(
        f"{catalog['path']}: {catalog['stars']} stars ({sources}), epoch J{catalog['meta']['epoch_jyear']}"
    )
    print(
        "  ".join(f"V<{limit}: {count}" for limit, count in catalog["brighter_than"].items())
    )
    for key, value in catalog["meta"].items():
        print(f"  {key}: {printable(value)}")


def print_titles(folder: Path, json: bool) -> None:
    """Print names and titles of the YAML files in a folder."""
    listed = [
        {"name": path.stem, "title": title_of(path), "file": path}
        for path in shipped_files(folder).values()
    ]
    print_list(listed, json, lambda entry: f"{entry['name']:20s} {printable(entry['title'])}")


def print_error(message: str) -> int:
    """Print one line to stderr and return the exit code."""
    print(f"skysim: {shortened(message)}", file=sys.stderr)
    return 2


def write_3d_views(lab: Lab, log: Telemetry, folder: Path) -> list[Path]:
    """Write a still and an animation of the laboratory in 3-D; return their paths.

    Without OpenGL print a message and return an empty list, so that the run continues.
    """
    from skysim.core import files
    from skysim.dynamics.multibody import scene_picture

    mjcf = lab.export_mjcf()
    joints = log.joints
    image_path = folder / "scene_3d.png"
    animation_path = folder / "scene_3d.gif"
    steps = max(len(joints) // ANIMATION_FRAMES, 1)
    states = joints[::steps]
    try:
        files.write_image(
            image_path, scene_picture.picture(mjcf, joints[len(joints) // 2])[:, :, ::-1]
        )
        shown = progress(
            scene_picture.film(mjcf, states), len(states), "rendering the animation"
        )
        scene_picture.write_film(
            shown, animation_path, len(states) / float(log.t_s[-1] + 1e-9)
        )
    except scene_picture.NoPicture as error:
        print_error(str(error))
        return []
    return [image_path, animation_path]


# Terminal output of `skysim study`, except its report: progress and provenance, worst and replayed trials.


REPLAYED = (
    "trial",
    "point",
    "replicate",
    "seed",
    "status",
    "x_arcsec",
    "y_arcsec",
    "roll_arcsec",
    "stars",
    "matched",
)


def print_replay(replay: Record) -> None:
    """Print the outcome of a repeated trial, and whether it differs from the stored one."""
    for name in REPLAYED:
        print(f"{name:12s} {replay[name]}")
    if replay["changed"]:
        print_error(
            f"differs from the store in {', '.join(replay['changed'])}: another code version"
        )
    for reason in filter(None, [replay["error"], *replay["reasons"]]):
        print_wrapped(reason)
    tables = [path for path in replay["files"] if not path.endswith(".fits")]
    for path in [*replay["pictures"][:10], *tables]:
        print(path)
