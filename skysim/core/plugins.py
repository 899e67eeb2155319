"""External star trackers and controllers: an entry point of a package, or a program behind a pipe.

`PluginKind` has the names of a kind. A `Program` is started once and answers each message on standard input with a line
of JSON:

1. `start` starts it, sends the set-up, and waits until it is ready.
2. `exchange` writes a message and reads the answer within a time limit.
3. `close` ends it. It leads its own process group, which is killed when it ends, when skysim ends, or after a timeout.

An entry point also runs in its own process, where `serve` answers; its output goes to standard error.
"""

import contextlib
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from multiprocessing.util import Finalize
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError, printable, unknown_name
from skysim.core.guarded import PYTHON
from skysim.core.types import Floats, Record

START_LIMIT_S = 120.0  # time limit for the program to report that it is ready
GRACE_S = 1.0  # time limit for the program to exit after its input is closed
MAX_ANSWER_BYTES = 16_000_000
MAX_STATUS_CHARS = 300
CHUNK_BYTES = 1 << 20
QUOTED_LINES = 3  # lines of standard error that an error message quotes
FOLDER = re.compile(r"\{folder(?::(\w+))?\}")

# External trackers and controllers by name: a command, or an object given in Python.
Programs = Mapping[str, Any]
NO_PROGRAMS: Programs = {}

# Function from the header of a message, and the stream of the bytes that follow it, to an answer.
Respond = Callable[[Record, IO[bytes]], Record]


class PluginKind(NamedTuple):
    """A kind of plug-in.

    Attributes
    ----------
    kind
        Name of the kind, for messages
    group
        Group of the entry points
    key
        Key of the scene that names a plug-in
    own
        Names of skysim's own implementations, which no plug-in may have
    """

    kind: str
    group: str
    key: str
    own: tuple[str, ...]

    def entry_points(self) -> dict[str, metadata.EntryPoint]:
        """The plug-ins of installed packages by name, without loading any."""
        return {
            point.name: point
            for point in metadata.entry_points(group=self.group)
            if point.name not in self.own
        }

    def release(self, name: str) -> str:
        """Name and version of the package with this plug-in; empty for skysim's own and for programs."""
        point = self.entry_points().get(name) if name not in self.own else None
        return f"{point.dist.name} {point.dist.version}" if point and point.dist else ""

    def check_name(self, name: str, commands: Mapping[str, str]) -> None:
        """Raise InputError for an unknown name; commands are those of programs, by name."""
        # Own names first: reading the entry points of all packages takes milliseconds.
        if name in self.own:
            return
        allowed = [*self.own, *self.entry_points(), *commands]
        if name not in allowed:
            problem, names = unknown_name(self.kind, name, allowed)
            raise InputError(
                self.key,
                problem,
                f"{names}, or a program: {name}=COMMAND by the option program (Python: programs)",
            )


def to_lists(value: Any) -> Any:
    """The value with arrays converted to lists, in mappings and sequences at any depth."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: to_lists(inner) for name, inner in value.items()}
    return [to_lists(inner) for inner in value] if isinstance(value, list | tuple) else value


def finite_array(value: Any, name: str, shape: tuple[int, ...]) -> Floats:
    """The value as an array. Raises ValueError unless it has this shape and finite numbers."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} is not an array of numbers") from None
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; allowed: {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a value that is not finite")
    return array


class ProgramError(Exception):
    """The program hung, exited or sent an invalid answer; the message is one line."""


@dataclass
class RunningProcess:
    """A running process with its folder and the last lines of its standard error; `stop` cleans up all of them."""

    process: subprocess.Popen[bytes]
    stdin: IO[bytes]
    stdout: IO[bytes]
    folder: Path | None
    last_lines: deque[str] = field(default_factory=lambda: deque(maxlen=QUOTED_LINES))
    stderr_reader: threading.Thread | None = None

    def collect_stderr(self, errors: IO[bytes]) -> None:
        """Read standard error and keep the last lines, so a full pipe never blocks the program."""
        with errors:
            for line in iter(lambda: errors.readline(4096), b""):
                text = printable(line.decode(errors="replace"))
                if text:
                    self.last_lines.append(text[: MAX_STATUS_CHARS // 2])

    def stop(self, grace_s: float = GRACE_S) -> int:
        """Wait for the process to exit, kill its group after grace_s, remove its folder; return the exit code."""
        if self.process.returncode is not None:
            return self.process.returncode
        with contextlib.suppress(OSError):
            self.stdin.close()
        until_s = time.monotonic() + grace_s
        # WNOWAIT leaves the process unreaped, so its id cannot be reused and killpg hits only this group.
        flags = os.WEXITED | os.WNOWAIT | os.WNOHANG
        while (
            time.monotonic() < until_s
            and os.waitid(os.P_PID, self.process.pid, flags) is None
        ):
            time.sleep(0.005)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        code = self.process.wait()
        self.stdout.close()
        if self.stderr_reader:
            self.stderr_reader.join(GRACE_S)
        if self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)
        return code


class Program:
    """A program that answers messages.

    Attributes
    ----------
    key, name
        Key of the scene that names it, and its name, for error messages
    arguments
        Command; `{folder}` in it becomes a temporary folder
    setup
        JSON object that is sent first
    limit_s
        Time limit for each answer
    environment
        Environment of the program; None for that of this process

    Raises
    ------
    InputError
        If it cannot be started, or refuses the set-up.
    """

    def __init__(
        self,
        key: str,
        name: str,
        arguments: Sequence[str],
        setup: Mapping[str, Any],
        limit_s: float,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        self.arguments = arguments
        self.limit_s = limit_s
        self.environment = environment
        self.setup_message = (json.dumps(setup) + "\n").encode()
        self.running: RunningProcess | None = None
        self.received = bytearray()
        self._finalizer: Finalize | None = None
        try:
            self.start()
        except ProgramError as error:
            raise InputError(key, f"{name}: {error}") from None

    def start(self) -> None:
        """Start the process and wait until it is ready. Raises ProgramError."""
        has_folder = any(FOLDER.search(part) for part in self.arguments)
        folder = Path(tempfile.mkdtemp(prefix="skysim-")) if has_folder else None
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
            raise ProgramError(
                f"{arguments[0]!r} cannot be started: {error.strerror}"
            ) from None
        assert process.stdin is not None
        assert process.stdout is not None
        running = RunningProcess(process, process.stdin, process.stdout, folder)
        self.running = running
        self.received = bytearray()
        # Ends the program with this process; `atexit` does not run in a multiprocessing worker, Finalize does.
        self._finalizer = Finalize(self, running.stop, (0.0,), exitpriority=10)
        running.stderr_reader = threading.Thread(
            target=running.collect_stderr, args=(process.stderr,), daemon=True
        )
        running.stderr_reader.start()
        for pipe_end in (running.stdin, running.stdout):
            os.set_blocking(pipe_end.fileno(), False)
        reply = self.exchange([self.setup_message], START_LIMIT_S)
        if not isinstance(reply, dict) or reply.get("ready") is not True:
            status = reply.get("status") if isinstance(reply, dict) else reply
            raise self.fail(printable(status if status else reply)[:MAX_STATUS_CHARS])

    def exchange(self, message: list[bytes], limit_s: float) -> Any:
        """Write a message and read one line of JSON within the time limit. Raises ProgramError."""
        line = self.transfer(b"".join(message), time.monotonic() + limit_s, limit_s)
        try:
            return json.loads(line)
        except (ValueError, RecursionError):
            raise self.fail(f"{line[:80].decode(errors='replace')!r} is not JSON") from None

    def transfer(self, message: bytes, until_s: float, limit_s: float) -> bytes:
        """Write a message and read a line, serving both pipes at once.

        The program may answer before it has read the whole message, which must not cause a deadlock.
        """
        assert self.running is not None
        stdin = self.running.stdin
        stdout = self.running.stdout
        unsent = memoryview(message)
        with selectors.DefaultSelector() as pipes:
            pipes.register(stdout, selectors.EVENT_READ)
            pipes.register(stdin, selectors.EVENT_WRITE)
            while unsent or b"\n" not in self.received:
                left_s = max(until_s - time.monotonic(), 0.0)
                ready = {key.fileobj for key, _ in pipes.select(left_s)}
                if time.monotonic() >= until_s:
                    raise self.fail(f"no answer within {limit_s:g} s", 0.0)
                if stdin in ready and unsent:
                    try:
                        unsent = unsent[os.write(stdin.fileno(), unsent[:CHUNK_BYTES]) :]
                    except BrokenPipeError:
                        unsent = unsent[:0]
                    if not unsent:
                        pipes.unregister(stdin)
                if stdout in ready:
                    self.receive(os.read(stdout.fileno(), CHUNK_BYTES))
        line, _, rest = bytes(self.received).partition(b"\n")
        self.received = bytearray(rest)
        return line

    def receive(self, chunk: bytes) -> None:
        """Buffer output of the program. Raises ProgramError if the program ended or an answer is too long."""
        if not chunk:
            assert self.running is not None
            code = self.running.stop()
            reason = f"code {code}" if code >= 0 else signal.Signals(-code).name
            last = " | ".join(self.running.last_lines) or "nothing on standard error"
            raise self.fail(f"the program ended ({reason}): {last}")
        self.received += chunk
        if len(self.received) > MAX_ANSWER_BYTES:
            raise self.fail(f"answer of more than {MAX_ANSWER_BYTES} bytes", 0.0)

    def fail(self, reason: str, grace_s: float = GRACE_S) -> ProgramError:
        """End the process, since its next output could answer an earlier message; return the error to raise."""
        self.close(grace_s)
        return ProgramError(reason)

    def close(self, grace_s: float = GRACE_S) -> None:
        """End the process and its group, and remove its folder."""
        if self._finalizer and self.running:
            self._finalizer.cancel()
            self.running.stop(grace_s)
        self.running = None


def host_command(module: str, name: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a Python process that hosts the plug-in `name` (see `serve`).

    The child gets the import path of this process, so it finds the same entry points.
    """
    path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
    return [*PYTHON, "-m", module, name], {**os.environ, "PYTHONPATH": path}


def describe_error(error: Exception) -> str:
    """An exception as one line."""
    return printable(f"{type(error).__name__}: {error}")


def serve(create: Callable[[Record], Respond]) -> None:
    """Set up the plug-in from the first line of the input, then answer each message until the input ends.

    Parameters
    ----------
    create
        Function from the set-up to the function that answers; an exception becomes
        {"ready": false, "status": reason}
    """
    # Answers go to the original standard output, all other output to standard error.
    messages = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(reply: Record) -> None:
        """Write an answer as one line."""
        answers.write(json.dumps(reply) + "\n")
        answers.flush()

    try:
        respond = create(json.loads(messages.readline()))
    except Exception as error:
        send({"ready": False, "status": describe_error(error)})
        return
    send({"ready": True})
    while line := messages.readline():
        send(respond(json.loads(line), messages))
