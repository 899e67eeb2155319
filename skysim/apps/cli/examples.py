"""Examples of every command, at the end of its `--help` and in docs/reference/command_line.md."""

from __future__ import annotations

import typer

EXAMPLES: dict[str, tuple[str, ...]] = {
    "": (
        "skysim run shefex2 --frames 5",
        "skysim check afit_simsat",
        "skysim study run led_count --set replicates=3",
    ),
    "run": (
        "skysim run shefex2 --frames 5 --open",
        'skysim run afit_simsat --frames 2 --set exposure.time="5 ms" --out out/short',
        "skysim run simsat_slew --frames 2 --scene-3d",
    ),
    "check": (
        "skysim check afit_simsat",
        'skysim check afit_simsat --set light.led.intensity="60 mcd"',
    ),
    "availability": (
        "skysim availability orbit.yaml --law zenith --off-deg 30",
        "skysim availability orbit.yaml --span year --picture out/year.png",
    ),
    "render": ("skysim render shefex2 --frames 1 --preview",),
    "stream": (
        "skysim stream shefex2 --folder out/stream --frames 5",
        "skysim stream afit_simsat --http 8090 --endless",
        "skysim stream shefex2 --pipe - --speed 0 --frames 3",
    ),
    "compare": (
        "skysim compare shefex2 --tracker own --tracker tetra3rs --frames 5",
        "skysim compare shefex2 --tracker own --tracker mine --program mine='./mine.py'",
    ),
    "trackers": ("skysim trackers",),
    "solve": (
        "skysim solve photo.jpg --fov 14.9",
        "skysim solve out/shefex2/frame_0000.fits --camera shefex2 --json",
        "skysim solve night.png --time 2012-06-22T21:00:00",
    ),
    "survey": ("skysim survey afit_simsat --frames 60 --checks 5 --out out/surveyed",),
    "datasheet": (
        "skysim datasheet shefex2 --quick",
        "skysim datasheet afit_simsat --fields 200 --out out/afit_sheet",
    ),
    "dataset": (
        "skysim dataset shefex2 --frames 1000 --out out/frames",
        "skysim dataset shefex2 --frames 64 --vary night.yaml --out s3://bucket/night",
    ),
    "characterize": (
        "skysim characterize --camera imx264 --darks lab/darks --flats lab/flats",
        "skysim characterize --camera mine.yaml --frames-to out/lab",
    ),
    "balance": (
        "skysim balance cubesat_table",
        "skysim balance simsat_slew --estimate-only --offset-bar '5 um'",
    ),
    "camera": ("skysim camera", "skysim camera shefex2", "skysim camera new --out my.yaml"),
    "camera show": (
        "skysim camera shefex2 --out out/shefex2.yml",
        "skysim camera imx264 --set camera.focal_length='16 mm'",
    ),
    "camera new": (
        "skysim camera new --out my.yaml",
        'skysim camera new --pixels 1936x1216 --pitch "5.86 um" --out my.yaml',
    ),
    "reproduce": (
        "skysim reproduce",
        "skysim reproduce afit-table-1 --quick",
        "skysim reproduce all --report --open",
    ),
    "gui": ("skysim gui", "skysim gui afit_simsat --port 8090 --no-open"),
    "validate": (
        "skysim validate mine.yaml",
        "skysim validate shefex2 led_count",
        "skysim validate --schema scene",
    ),
    "export": (
        "skysim export out/shefex2 --to aem --to tiff",
        "skysim export out/shefex2 --to video --out out/exported",
    ),
    "scenes": ("skysim scenes", "skysim scenes show shefex2", "skysim scenes export simsat_cmg"),
    "scenes show": (
        "skysim scenes show shefex2",
        'skysim scenes show mine.yaml --set camera.focal_length="16 mm"',
    ),
    "scenes parts": (
        "skysim scenes parts coded_spiral",
        "skysim scenes parts afit_simsat --out out/parts.csv",
    ),
    "scenes export": ("skysim scenes export simsat_cmg --out out/simsat.xml",),
    "catalog": (
        "skysim catalog info",
        "skysim catalog build --source gaia --limit 9 --out deep.ecsv",
    ),
    "catalog build": ("skysim catalog build --source gaia --limit 9 --out deep.ecsv",),
    "catalog info": ("skysim catalog info hipparcos_hp6.5",),
    "study": ("skysim study", "skysim study run led_count --set replicates=3 --open"),
    "study run": (
        "skysim study run led_count --set replicates=3 --open",
        "skysim study run mine.yaml --workers 4 --out out/mine",
    ),
    "study resume": ("skysim study resume led_count", "skysim study resume led_count --failed"),
    "study status": ("skysim study status led_count",),
    "study report": ("skysim study report led_count --open",),
    "study export": ("skysim study export led_count out/led_count.csv",),
    "study replay": ("skysim study replay led_count 38 --open",),
    "study worst": ("skysim study worst led_count --response roll_arcsec --where leds=1000",),
    "study optimize": ("skysim study optimize dome_for_the_money --set replicates=5",),
}


def epilog(name: str) -> str:
    """The examples of a command as the last paragraphs of its help."""
    return "\n".join(["Examples:", *(f"  {line}" for line in EXAMPLES[name])])


def add_examples(app: typer.Typer, name: str = "") -> None:
    """Add the examples to a group of commands and to all commands in it. Raises KeyError where there are none."""
    app.info.epilog = epilog(name)
    for command in app.registered_commands:
        function = command.callback
        own = command.name or (function.__name__ if function else "")
        command.epilog = epilog(f"{name} {own}".strip())
    for group in app.registered_groups:
        if group.typer_instance:
            add_examples(group.typer_instance, f"{name} {group.name}".strip())
