"""Programs, and the one that is an external tracker: it answers each frame with a line of JSON.

Commands come only from the user's command line; no file can name one.
"""

from __future__ import annotations

import json
import re
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
import numpy as np
from skysim.core.errors import InputError
from skysim.core.plugins import FOLDER, Program, ProgramError
from skysim.dynamics.controllers import CONTROLLERS
from skysim.tracking import tracker_interface
from skysim.tracking.tracker_interface import (TRACKERS, Answer, Picture, Setup)



MAX_FAILURES = 3  # consecutive failures after which a program is not restarted
NAME = re.compile(r"[a-z][a-z0-9_-]*")


def program_commands(options: Sequence[str] | None) -> dict[str, str]:
    """Parse texts `NAME=COMMAND` (trackers, controllers) to commands by name. Raises InputError."""
    programs: dict[str, str] = {}
    for option in options or ():
        name, equals, command = option.partition("=")
        if not equals or not NAME.fullmatch(name) or not command.strip():
            raise InputError(
                "programs", option, "NAME=COMMAND, NAME of lower-case letters, digits, _ and -"
            )
        taken = {
            *programs,
            *(
                known
                for kind in (TRACKERS, CONTROLLERS)
                for known in (*kind.own, *kind.entry_points())
            ),
        }
        if name in taken:
            raise InputError(f"programs.{name}", "name already in use", "another one")
        split_command(name, command)
        programs[name] = command
    return programs


def split_command(name: str, command: str) -> tuple[list[str], str | None]:
    """Split a command into its arguments; also return the file format of `{folder}`, None without one."""
    try:
        arguments = shlex.split(command)
    except ValueError as error:
        raise InputError(f"programs.{name}", error) from None
    formats = {image_format or "png" for image_format in FOLDER.findall(command)}
    if formats - set(WRITERS) or len(formats) > 1:
        raise InputError(
            f"programs.{name}",
            "",
            f"{{folder}}, or one of {{folder:{'}, {folder:'.join(WRITERS)}}}",
        )
    return arguments, formats.pop() if formats else None


def write_png(path: Path, picture: Picture) -> None:
    """Write the frame as a 16-bit PNG."""
    from skysim.core import files

    files.write_png16(path, picture.image_dn)


def write_fits(path: Path, picture: Picture) -> None:
    """Write the frame as FITS with times in the header, without the truth that a run's own frames carry."""
    from astropy.io import fits

    from skysim.core import files

    header = fits.Header(
        {"EXPTIME": picture.exposure_s, "TMID": picture.t_s, "FRAME": picture.frame}
    )
    with files.atomic_file(path) as temporary:
        fits.PrimaryHDU(picture.image_dn, header).writeto(temporary, overwrite=True)


WRITERS: dict[str, Callable[[Path, Picture], None]] = {"png": write_png, "fits": write_fits}


class TrackerProgram(Program):
    """An external tracker program. After a failure it is restarted for the next frame, up to MAX_FAILURES in a row.

    arguments, image_format : of `split_command`;  limit_s : time limit per frame
    environment : in place of this process's
    Raises InputError where it cannot be started or refuses the set-up.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        image_format: str | None,
        setup: Setup,
        limit_s: float,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.image_format = image_format
        self.failures = 0
        self.last_failure = ""
        super().__init__(TRACKERS.key, name, arguments, setup.as_tree(), limit_s, environment)

    def solve(self, picture: Picture) -> Answer:
        """The program's answer to a frame, with the seconds it took. Raises ProgramError."""
        if self.failures >= MAX_FAILURES:
            raise ProgramError(
                f"given up after {MAX_FAILURES} failures in a row, the last: {self.last_failure}"
            )
        try:
            if self.running is None:
                self.start()
            begin_s = time.perf_counter()
            reply = self.exchange(self.frame_message(picture), self.limit_s)
            spent_s = time.perf_counter() - begin_s
            answer = self.to_answer(reply, picture.frame)
        except ProgramError as error:
            if self.running is None:
                self.failures = self.failures + 1
                self.last_failure = str(error)
            raise
        self.failures = 0
        own_s = spent_s if answer.seconds is None else min(answer.seconds, spent_s)
        return replace(answer, seconds=own_s)

    def to_answer(self, reply: Any, frame: int) -> Answer:
        """Convert JSON to an Answer. Raises ProgramError; an answer to another frame ends the program."""
        if not isinstance(reply, dict) or reply.get("frame") != frame:
            raise self.fail(f"no answer to frame {frame}, but {str(reply)[:80]!r}")
        try:
            return tracker_interface.check_answer(
                Answer.of_tree({key: reply[key] for key in reply if key != "frame"})
            )
        except ValueError as error:
            raise ProgramError(str(error)) from None

    def frame_message(self, picture: Picture) -> list[bytes]:
        """A frame's header and, unless it is written to the folder, its pixels, row by row, little-endian.

        Raises ProgramError where the program has made its folder unusable.
        """
        header: dict[str, Any] = {
            "frame": picture.frame,
            "t_s": picture.t_s,
            "exposure_s": picture.exposure_s,
            "streak_px": picture.streak_px,
        }
        if self.image_format:
            assert self.running is not None
            assert self.running.folder is not None
            path = self.running.folder / f"frame_{picture.frame:04d}.{self.image_format}"
            try:
                for previous in self.running.folder.glob("frame_*"):
                    previous.unlink(missing_ok=True)
                WRITERS[self.image_format](path, picture)
            except OSError as error:
                raise self.fail(
                    f"the program's folder takes no frame: {error.strerror or error}", 0.0
                ) from None
            return [(json.dumps(header | {"file": str(path)}) + "\n").encode()]
        dtype = "<u2" if picture.image_dn.dtype == np.uint16 else "<f8"
        pixels = np.ascontiguousarray(picture.image_dn, dtype=dtype).tobytes()
        height, width = picture.image_dn.shape
        header |= {"width_px": width, "height_px": height, "dtype": dtype, "bytes": len(pixels)}
        return [(json.dumps(header) + "\n").encode(), pixels]


