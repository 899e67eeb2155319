"""Run an external tracker program: started once, it gets frames on standard input and answers each with a JSON line.

The program leads its own process group, which is killed when the program ends, when skysim ends, or after a timeout.
Commands come only from the user's command line; no file can name one.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import selectors
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.util import Finalize
from pathlib import Path
from typing import IO, Any

import numpy as np

from skysim.core.errors import InputError, printable
from skysim.tracking.external import interface
from skysim.tracking.external.interface import Answer, Picture, Setup

START_LIMIT_S = 120.0  # for the program to report ready
GRACE_S = 1.0  # for the program to exit after its input is closed
TRIES = 3  # consecutive failures after which a program is not restarted
MOST_BYTES = 16_000_000  # largest answer
PIECE = 1 << 20
LAST_LINES = 3  # of standard error that an error message quotes
FOLDER = re.compile(r"\{folder(?::(\w+))?\}")
NAME = re.compile(r"[a-z][a-z0-9_-]*")


class Fault(Exception):
    """The program hung, exited or sent an invalid answer; the message is one line."""


def named(told: Sequence[str] | None) -> dict[str, str]:
    """Parse the options `--program NAME=COMMAND` to commands by name. Raises InputError."""
    programs: dict[str, str] = {}
    for item in told or ():
        name, equals, command = item.partition("=")
        if not equals or not NAME.fullmatch(name) or not command.strip():
            raise InputError(
                f"--program {item}: allowed: NAME=COMMAND, NAME of small letters, digits, _ and -"
            )
        if name == interface.OWN or name in programs or name in interface.entry_points():
            raise InputError(f"--program {name}: there is a tracker of this name; allowed: another one")
        words(name, command)
        programs[name] = command
    return programs


def words(name: str, command: str) -> tuple[list[str], str | None]:
    """Split a command into its arguments; also return the file format of `{folder}`, None without one."""
    try:
        parts = shlex.split(command)
    except ValueError as error:
        raise InputError(f"--program {name}: {error}") from None
    kinds = {kind or "png" for kind in FOLDER.findall(command)}
    if kinds - set(WRITERS) or len(kinds) > 1:
        raise InputError(
            f"--program {name}: allowed: {{folder}}, or one of {{folder:{'}, {folder:'.join(WRITERS)}}}"
        )
    return parts, kinds.pop() if kinds else None


def write_png(path: Path, picture: Picture) -> None:
    """Write the frame as a 16-bit PNG."""
    from skysim.core import files

    files.write_png16(path, picture.image_dn)


def write_fits(path: Path, picture: Picture) -> None:
    """Write the frame as FITS with times in the header, without the truth that a run's own frames carry."""
    from astropy.io import fits

    from skysim.core import files

    header = fits.Header({"EXPTIME": picture.exposure_s, "TMID": picture.t_s, "FRAME": picture.frame})
    with files.atomic_file(path) as temporary:
        fits.PrimaryHDU(picture.image_dn, header).writeto(temporary, overwrite=True)


WRITERS: dict[str, Callable[[Path, Picture], None]] = {"png": write_png, "fits": write_fits}


@dataclass
class Running:
    """A running process with the last lines of its standard error and its folder; `end` cleans up all of it."""

    process: subprocess.Popen[bytes]
    folder: Path | None
    last: deque[str] = field(default_factory=lambda: deque(maxlen=LAST_LINES))
    listener: threading.Thread | None = None

    def listen(self, errors: IO[bytes]) -> None:
        """Read standard error and keep the last lines, so that a full pipe never blocks the program."""
        with errors:
            for line in iter(lambda: errors.readline(4096), b""):
                text = printable(line.decode(errors="replace"))
                if text:
                    self.last.append(text[: interface.MOST_TEXT // 2])

    def end(self, grace_s: float = GRACE_S) -> int:
        """Wait for the process to exit, kill its group after grace_s, remove its folder; return the exit code."""
        if self.process.returncode is not None:
            return self.process.returncode
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        until_s = time.monotonic() + grace_s
        # WNOWAIT leaves the process unreaped, so its id cannot be reused and killpg hits only this group.
        flags = os.WEXITED | os.WNOWAIT | os.WNOHANG
        while time.monotonic() < until_s and os.waitid(os.P_PID, self.process.pid, flags) is None:
            time.sleep(0.005)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        code = self.process.wait()
        self.process.stdout.close()
        if self.listener:
            self.listener.join(GRACE_S)
        if self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)
        return code

    def death(self) -> str:
        """How the process ended, with its last lines of standard error."""
        code = self.end()
        how = f"code {code}" if code >= 0 else signal.Signals(-code).name
        return f"the program ended ({how}): {' | '.join(self.last) or 'nothing on standard error'}"


class Program:
    """An external tracker program. After a failure it is restarted for the next frame, up to TRIES times in a row.

    parts, kind : of `words`;  limit_s : time limit per frame;  environment : in place of this process's
    Raises InputError where it cannot be started or refuses the set-up.
    """

    def __init__(
        self,
        name: str,
        parts: Sequence[str],
        kind: str | None,
        setup: Setup,
        limit_s: float,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name, self.parts, self.kind, self.limit_s = name, parts, kind, limit_s
        self.environment = environment
        self.hello = (json.dumps(setup.as_tree()) + "\n").encode()
        self.running: Running | None = None
        self.failed, self.why = 0, ""
        self.heard = bytearray()
        self._finalizer: Finalize | None = None
        try:
            self.start()
        except Fault as fault:
            raise InputError(f"tracker.name: {name}: {fault}") from None

    def start(self) -> None:
        """Start the process and wait until it is ready. Raises Fault."""
        folder = Path(tempfile.mkdtemp(prefix="skysim-")) if self.kind else None
        parts = [FOLDER.sub(str(folder), part) for part in self.parts]
        pipe = subprocess.PIPE
        try:
            process = subprocess.Popen(
                parts,
                stdin=pipe,
                stdout=pipe,
                stderr=pipe,
                bufsize=0,
                start_new_session=True,
                env=self.environment,
            )
        except OSError as error:
            if folder:
                shutil.rmtree(folder, ignore_errors=True)
            raise Fault(f"{parts[0]!r} cannot be started: {error.strerror}") from None
        running = Running(process, folder)
        self.running, self.heard = running, bytearray()
        # Ends the program with this process; `atexit` does not run in a multiprocessing worker, Finalize does.
        self._finalizer = Finalize(self, running.end, (0.0,), exitpriority=10)
        assert process.stdin is not None
        assert process.stdout is not None
        running.listener = threading.Thread(target=running.listen, args=(process.stderr,), daemon=True)
        running.listener.start()
        for pipe_end in (process.stdin, process.stdout):
            os.set_blocking(pipe_end.fileno(), False)
        told = self.exchange([self.hello], START_LIMIT_S)
        if not isinstance(told, dict) or told.get("ready") is not True:
            said = told.get("status") if isinstance(told, dict) else told
            raise self.ended(printable(said if said else told)[: interface.MOST_TEXT])

    def solve(self, picture: Picture) -> Answer:
        """The program's answer to a frame, with the seconds it took. Raises Fault."""
        if self.failed >= TRIES:
            raise Fault(f"given up after {TRIES} failures in a row, the last: {self.why}")
        try:
            if self.running is None:
                self.start()
            begin_s = time.perf_counter()
            told = self.exchange(self.message(picture), self.limit_s)
            spent_s = time.perf_counter() - begin_s
            answer = self.read(told, picture.frame)
        except Fault as fault:
            if self.running is None:
                self.failed, self.why = self.failed + 1, str(fault)
            raise
        self.failed = 0
        own_s = spent_s if answer.seconds is None else min(answer.seconds, spent_s)
        return Answer(
            answer.status, answer.cam_from_ref_xyzw, answer.covariance_rad2, answer.centroids_px, own_s
        )

    def read(self, told: Any, frame: int) -> Answer:
        """Convert JSON to an Answer. Raises Fault. An answer to another frame ends the program: it is out of step."""
        if not isinstance(told, dict) or told.get("frame") != frame:
            raise self.ended(f"no answer to frame {frame}, but {str(told)[:80]!r}")
        try:
            return interface.checked(Answer.of_tree({key: told[key] for key in told if key != "frame"}))
        except ValueError as error:
            raise Fault(str(error)) from None

    def message(self, picture: Picture) -> list[bytes]:
        """A frame's header and, unless it is written to the folder, its pixels, row by row, little-endian."""
        header: dict[str, Any] = {
            "frame": picture.frame,
            "t_s": picture.t_s,
            "exposure_s": picture.exposure_s,
            "streak_px": picture.streak_px,
        }
        if self.kind:
            assert self.running is not None
            assert self.running.folder is not None
            for old in self.running.folder.glob("frame_*"):
                old.unlink(missing_ok=True)
            path = self.running.folder / f"frame_{picture.frame:04d}.{self.kind}"
            WRITERS[self.kind](path, picture)
            return [(json.dumps(header | {"file": str(path)}) + "\n").encode()]
        kind = "<u2" if picture.image_dn.dtype == np.uint16 else "<f8"
        pixels = np.ascontiguousarray(picture.image_dn, dtype=kind).tobytes()
        height, width = picture.image_dn.shape
        header |= {"width_px": width, "height_px": height, "dtype": kind, "bytes": len(pixels)}
        return [(json.dumps(header) + "\n").encode(), pixels]

    def exchange(self, message: list[bytes], limit_s: float) -> Any:
        """Write a message and read one line of JSON within the time limit. Raises Fault."""
        line = self.wait(b"".join(message), time.monotonic() + limit_s, limit_s)
        try:
            return json.loads(line)
        except (ValueError, RecursionError):
            raise self.ended(f"{line[:80].decode(errors='replace')!r} is no JSON") from None

    def wait(self, message: bytes, until_s: float, limit_s: float) -> bytes:
        """Serve both pipes at once: the program may answer before it has read everything, and must not deadlock."""
        assert self.running is not None
        process = self.running.process
        assert process.stdin is not None
        assert process.stdout is not None
        left = memoryview(message)
        with selectors.DefaultSelector() as pipes:
            pipes.register(process.stdout, selectors.EVENT_READ)
            pipes.register(process.stdin, selectors.EVENT_WRITE)
            while left or b"\n" not in self.heard:
                ready = {key.fileobj for key, _ in pipes.select(max(until_s - time.monotonic(), 0.0))}
                if time.monotonic() >= until_s:
                    raise self.ended(f"no answer within {limit_s:g} s", 0.0)
                if process.stdin in ready and left:
                    try:
                        left = left[os.write(process.stdin.fileno(), left[:PIECE]) :]
                    except BrokenPipeError:
                        left = left[:0]
                    if not left:
                        pipes.unregister(process.stdin)
                if process.stdout in ready:
                    self.hear(os.read(process.stdout.fileno(), PIECE))
        line, _, rest = bytes(self.heard).partition(b"\n")
        self.heard = bytearray(rest)
        return line

    def hear(self, piece: bytes) -> None:
        """Buffer what the program wrote. Raises Fault when it ends or when an answer is too long."""
        if not piece:
            assert self.running is not None
            raise self.ended(self.running.death())
        self.heard += piece
        if len(self.heard) > MOST_BYTES:
            raise self.ended(f"an answer of more than {MOST_BYTES} bytes", 0.0)

    def ended(self, why: str, grace_s: float = GRACE_S) -> Fault:
        """End the process, since its next output could answer an earlier frame; return the Fault to raise."""
        self.close(grace_s)
        return Fault(why)

    def close(self, grace_s: float = GRACE_S) -> None:
        """End the process and its group, and remove its folder."""
        if self._finalizer and self.running:
            self._finalizer.cancel()
            self.running.end(grace_s)
        self.running = None
