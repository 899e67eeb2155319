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
from dataclasses import dataclass, field, replace
from multiprocessing.util import Finalize
from pathlib import Path
from typing import IO, Any

import numpy as np

from skysim.core.errors import InputError, printable
from skysim.tracking.external import interface
from skysim.tracking.external.interface import Answer, Picture, Setup

START_LIMIT_S = 120.0  # for the program to report ready
GRACE_S = 1.0  # for the program to exit after its input is closed
MAX_FAILURES = 3  # consecutive failures after which a program is not restarted
MAX_ANSWER_BYTES = 16_000_000  # largest answer
CHUNK_BYTES = 1 << 20
QUOTED_LINES = 3  # of standard error that an error message quotes
FOLDER = re.compile(r"\{folder(?::(\w+))?\}")
NAME = re.compile(r"[a-z][a-z0-9_-]*")


class ProgramError(Exception):
    """The program hung, exited or sent an invalid answer; the message is one line."""


def program_commands(options: Sequence[str] | None) -> dict[str, str]:
    """Parse the options `--program NAME=COMMAND` to commands by name. Raises InputError."""
    programs: dict[str, str] = {}
    for option in options or ():
        name, equals, command = option.partition("=")
        if not equals or not NAME.fullmatch(name) or not command.strip():
            raise InputError(f"--program {option}: allowed: NAME=COMMAND, NAME of lower-case letters, digits, _ and -")
        if name == interface.OWN or name in programs or name in interface.entry_points():
            raise InputError(f"--program {name}: name already in use; allowed: another one")
        split_command(name, command)
        programs[name] = command
    return programs


def split_command(name: str, command: str) -> tuple[list[str], str | None]:
    """Split a command into its arguments; also return the file format of `{folder}`, None without one."""
    try:
        arguments = shlex.split(command)
    except ValueError as error:
        raise InputError(f"--program {name}: {error}") from None
    formats = {image_format or "png" for image_format in FOLDER.findall(command)}
    if formats - set(WRITERS) or len(formats) > 1:
        raise InputError(f"--program {name}: allowed: {{folder}}, or one of {{folder:{'}, {folder:'.join(WRITERS)}}}")
    return arguments, formats.pop() if formats else None


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
class RunningProcess:
    """A running process with the last lines of its standard error and its folder; `stop` cleans up all of it."""

    process: subprocess.Popen[bytes]
    folder: Path | None
    last_lines: deque[str] = field(default_factory=lambda: deque(maxlen=QUOTED_LINES))
    stderr_reader: threading.Thread | None = None

    def collect_stderr(self, errors: IO[bytes]) -> None:
        """Read standard error and keep the last lines, so that a full pipe never blocks the program."""
        with errors:
            for line in iter(lambda: errors.readline(4096), b""):
                text = printable(line.decode(errors="replace"))
                if text:
                    self.last_lines.append(text[: interface.MAX_STATUS_CHARS // 2])

    def stop(self, grace_s: float = GRACE_S) -> int:
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
        if self.stderr_reader:
            self.stderr_reader.join(GRACE_S)
        if self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)
        return code

    def exit_message(self) -> str:
        """How the process ended, with its last lines of standard error."""
        code = self.stop()
        reason = f"code {code}" if code >= 0 else signal.Signals(-code).name
        return f"the program ended ({reason}): {' | '.join(self.last_lines) or 'nothing on standard error'}"


class Program:
    """An external tracker program. After a failure it is restarted for the next frame, up to TRIES times in a row.

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
        self.name, self.arguments, self.image_format, self.limit_s = name, arguments, image_format, limit_s
        self.environment = environment
        self.setup_message = (json.dumps(setup.as_tree()) + "\n").encode()
        self.running: RunningProcess | None = None
        self.failures, self.last_failure = 0, ""
        self.received = bytearray()
        self._finalizer: Finalize | None = None
        try:
            self.start()
        except ProgramError as error:
            raise InputError(f"tracker.name: {name}: {error}") from None

    def start(self) -> None:
        """Start the process and wait until it is ready. Raises ProgramError."""
        folder = Path(tempfile.mkdtemp(prefix="skysim-")) if self.image_format else None
        arguments = [FOLDER.sub(str(folder), part) for part in self.arguments]
        pipe = subprocess.PIPE
        try:
            process = subprocess.Popen(
                arguments,
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
            raise ProgramError(f"{arguments[0]!r} cannot be started: {error.strerror}") from None
        running = RunningProcess(process, folder)
        self.running, self.received = running, bytearray()
        # Ends the program with this process; `atexit` does not run in a multiprocessing worker, Finalize does.
        self._finalizer = Finalize(self, running.stop, (0.0,), exitpriority=10)
        assert process.stdin is not None
        assert process.stdout is not None
        running.stderr_reader = threading.Thread(target=running.collect_stderr, args=(process.stderr,), daemon=True)
        running.stderr_reader.start()
        for pipe_end in (process.stdin, process.stdout):
            os.set_blocking(pipe_end.fileno(), False)
        reply = self.exchange([self.setup_message], START_LIMIT_S)
        if not isinstance(reply, dict) or reply.get("ready") is not True:
            status = reply.get("status") if isinstance(reply, dict) else reply
            raise self.fail(printable(status if status else reply)[: interface.MAX_STATUS_CHARS])

    def solve(self, picture: Picture) -> Answer:
        """The program's answer to a frame, with the seconds it took. Raises ProgramError."""
        if self.failures >= MAX_FAILURES:
            raise ProgramError(f"given up after {MAX_FAILURES} failures in a row, the last: {self.last_failure}")
        try:
            if self.running is None:
                self.start()
            begin_s = time.perf_counter()
            reply = self.exchange(self.frame_message(picture), self.limit_s)
            spent_s = time.perf_counter() - begin_s
            answer = self.to_answer(reply, picture.frame)
        except ProgramError as error:
            if self.running is None:
                self.failures, self.last_failure = self.failures + 1, str(error)
            raise
        self.failures = 0
        own_s = spent_s if answer.seconds is None else min(answer.seconds, spent_s)
        return replace(answer, seconds=own_s)

    def to_answer(self, reply: Any, frame: int) -> Answer:
        """Convert JSON to an Answer. Raises ProgramError; an answer to another frame ends the program."""
        if not isinstance(reply, dict) or reply.get("frame") != frame:
            raise self.fail(f"no answer to frame {frame}, but {str(reply)[:80]!r}")
        try:
            return interface.check_answer(Answer.of_tree({key: reply[key] for key in reply if key != "frame"}))
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
                raise self.fail(f"the program's folder takes no frame: {error.strerror or error}", 0.0) from None
            return [(json.dumps(header | {"file": str(path)}) + "\n").encode()]
        dtype = "<u2" if picture.image_dn.dtype == np.uint16 else "<f8"
        pixels = np.ascontiguousarray(picture.image_dn, dtype=dtype).tobytes()
        height, width = picture.image_dn.shape
        header |= {"width_px": width, "height_px": height, "dtype": dtype, "bytes": len(pixels)}
        return [(json.dumps(header) + "\n").encode(), pixels]

    def exchange(self, message: list[bytes], limit_s: float) -> Any:
        """Write a message and read one line of JSON within the time limit. Raises ProgramError."""
        line = self.transfer(b"".join(message), time.monotonic() + limit_s, limit_s)
        try:
            return json.loads(line)
        except (ValueError, RecursionError):
            raise self.fail(f"{line[:80].decode(errors='replace')!r} is not JSON") from None

    def transfer(self, message: bytes, until_s: float, limit_s: float) -> bytes:
        """Serve both pipes at once: the program may answer before it has read everything, and must not deadlock."""
        assert self.running is not None
        process = self.running.process
        assert process.stdin is not None
        assert process.stdout is not None
        unsent = memoryview(message)
        with selectors.DefaultSelector() as pipes:
            pipes.register(process.stdout, selectors.EVENT_READ)
            pipes.register(process.stdin, selectors.EVENT_WRITE)
            while unsent or b"\n" not in self.received:
                ready = {key.fileobj for key, _ in pipes.select(max(until_s - time.monotonic(), 0.0))}
                if time.monotonic() >= until_s:
                    raise self.fail(f"no answer within {limit_s:g} s", 0.0)
                if process.stdin in ready and unsent:
                    try:
                        unsent = unsent[os.write(process.stdin.fileno(), unsent[:CHUNK_BYTES]) :]
                    except BrokenPipeError:
                        unsent = unsent[:0]
                    if not unsent:
                        pipes.unregister(process.stdin)
                if process.stdout in ready:
                    self.receive(os.read(process.stdout.fileno(), CHUNK_BYTES))
        line, _, rest = bytes(self.received).partition(b"\n")
        self.received = bytearray(rest)
        return line

    def receive(self, chunk: bytes) -> None:
        """Buffer what the program wrote. Raises ProgramError when it ends or when an answer is too long."""
        if not chunk:
            assert self.running is not None
            raise self.fail(self.running.exit_message())
        self.received += chunk
        if len(self.received) > MAX_ANSWER_BYTES:
            raise self.fail(f"answer of more than {MAX_ANSWER_BYTES} bytes", 0.0)

    def fail(self, reason: str, grace_s: float = GRACE_S) -> ProgramError:
        """End the process, since its next output could answer an earlier frame; return the error to raise."""
        self.close(grace_s)
        return ProgramError(reason)

    def close(self, grace_s: float = GRACE_S) -> None:
        """End the process and its group, and remove its folder."""
        if self._finalizer and self.running:
            self._finalizer.cancel()
            self.running.stop(grace_s)
        self.running = None
