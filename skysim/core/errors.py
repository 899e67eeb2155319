"""Errors for the user, text that is safe to print on a terminal, and interrupts that are not lost."""

import os
import signal
import sys
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import NamedTuple

# Numbers of characters of a message, and of a file or key in it.
MAX_MESSAGE = 950
MAX_NAME = 200
running_as_command = False  # whether skysim runs as a command, with a user at the terminal


def note(message: str) -> None:
    """Print an informational line to stderr if it is a terminal."""
    if sys.stderr.isatty():
        print(f"skysim: {message}", file=sys.stderr, flush=True)


def printable(text: object) -> str:
    """Text from outside on one line, with ? for control and other characters that a terminal cannot show."""
    one_line = " ".join(str(text).split())
    return "".join(character if character.isprintable() else "?" for character in one_line)


def shortened(text: object, most: int = MAX_MESSAGE) -> str:
    """`printable` text of at most so many characters."""
    line = printable(text)
    return line if len(line) <= most else f"{line[:most]}…"


def reason(error: Exception) -> str:
    """Why something cannot be read, written or computed, without the words of Python for it."""
    if isinstance(error, UnicodeDecodeError):
        return f"not text in UTF-8, by byte {error.start + 1}"
    return getattr(error, "strerror", None) or str(error.args[-1] if error.args else error)


def unknown_name(kind: str, name: object, allowed: Iterable[object]) -> tuple[str, str]:
    """The problem with a name that is not allowed, and the allowed names: `unknown solver 'magic'`, `quest, svd`."""
    return f"unknown {kind} {name!r}", ", ".join(map(str, allowed))


class Where(NamedTuple):
    """A place in a file; `str` gives `scenes/x.yaml, line 31`.

    Attributes
    ----------
    file
        The file
    line
        Line or row, from 1; None for the file as a whole
    unit
        Unit of `line`: line, or row of a table
    """

    file: str | Path
    line: int | None = None
    unit: str = "line"

    def __str__(self) -> str:
        place = "" if self.line is None else f", {self.unit} {self.line}"
        return shortened(self.file, MAX_NAME) + place

    def error(self, problem: object, allowed: object = "") -> "InputError":
        """An error in the file, at this place."""
        return InputError(self.file, problem, allowed, self)


OVERRIDES = Where("overrides")  # place of a value that the caller gave instead of the file


class InputError(ValueError):
    """An error in the user's input; `str` gives key, problem, allowed values and place in one printable line.

    No code reads the text of an error: the command line and the page compose it from these parts. A caller that knows
    more raises a changed copy (`under`, `within`, `at`).

    Attributes
    ----------
    key
        Input at fault: a dotted key, a parameter or a file; empty if it has no name
    problem
        The problem; empty if `allowed` is sufficient
    allowed
        Allowed values; empty if `problem` is sufficient
    where
        Place of the key in a file; if the key is the file itself, the place in it
    """

    key: str
    problem: str
    allowed: str
    where: Where | None

    def __init__(
        self, key: object, problem: object, allowed: object = "", where: Where | None = None
    ) -> None:
        # The parts may quote a file, and a file may contain any character.
        self.key = shortened(key, MAX_NAME)
        self.problem = shortened(problem, 2 * MAX_NAME)
        self.where = where and where._replace(file=str(where.file))
        # What is allowed may be a long list; it gets what the other parts leave.
        used = len(self.key) + len(self.problem) + len(str(self.where or ""))
        self.allowed = shortened(allowed, MAX_MESSAGE - 20 - used)
        # Unpickling calls the constructor with the arguments of the base class.
        super().__init__(self.key, self.problem, self.allowed, self.where)

    @property
    def fault(self) -> str:
        """The problem and the allowed values, without the key and the place."""
        parts = (self.problem, self.allowed and f"allowed: {self.allowed}")
        return "; ".join(part for part in parts if part)

    @property
    def is_of_file(self) -> bool:
        """Whether the key is the file of `where`."""
        return self.where is not None and shortened(self.where.file, MAX_NAME) == self.key

    @property
    def subject(self) -> str:
        """The key; if it is a file, with the place in the file."""
        return str(self.where) if self.is_of_file else self.key

    def __str__(self) -> str:
        text = f"{self.subject}: {self.fault}" if self.key else self.fault
        return text if self.where is None or self.is_of_file else f"{text} ({self.where})"

    def under(self, prefix: object) -> "InputError":
        """The error with the key of the enclosing section before its own key."""
        key = f"{prefix}.{self.key}" if self.key else prefix
        return InputError(key, self.problem, self.allowed, self.where)

    def within(self, key: object) -> "InputError":
        """The error with a key whose value names the input at fault; the problem then begins with that name."""
        problem = f"{self.subject}: {self.problem}" if self.key else self.problem
        return InputError(key, problem, self.allowed, None if self.is_of_file else self.where)

    def at(self, where: Where | None) -> "InputError":
        """The error with its place in a file."""
        return InputError(self.key, self.problem, self.allowed, where)


@contextmanager
def refusing(
    kinds: type[Exception] | tuple[type[Exception], ...],
    key: object,
    problem: object = None,
    allowed: object = "",
) -> Iterator[None]:
    """Turn errors of some kinds into InputError, with their own text as the problem unless there is another."""
    try:
        yield
    except kinds as error:
        raise InputError(key, problem or error, allowed) from None


@contextmanager
def errors_under(prefix: object) -> Iterator[None]:
    """Put the key of the enclosing section before the key of an InputError."""
    try:
        yield
    except InputError as error:
        raise error.under(prefix) from None


@contextmanager
def errors_within(key: object) -> Iterator[None]:
    """Give an InputError a key whose value names the input at fault."""
    try:
        yield
    except InputError as error:
        raise error.within(key) from None


def check_name(key: object, kind: str, name: object, allowed: Collection[object]) -> None:
    """Raise InputError for a name that is not one of the allowed ones."""
    if name not in allowed:
        raise InputError(key, *unknown_name(kind, name, allowed))


# Ctrl-C and SIGTERM as KeyboardInterrupt, raised only where every caller passes it on.
#
# Python runs a signal's handler in the function of the main thread that runs next. After a compiled kernel this is
# often one that the kernel's wrapper calls to build a named tuple. Numba does not expect it to fail: the process
# crashes, or the interrupt becomes a SystemError, which looks like a failure of the computation. Finalizers ignore
# exceptions.

# Functions that numba and its compiler call, and finalizers.
CALLBACKS = (
    "_numba_unpickle",
    "_raw_object_cache_getbuffer",
    "_raw_object_cache_notify",
    "__del__",
)


def stop(*_: object) -> None:
    """Handler: end the process with a line on stderr. Some modules lose an exception that is raised in their import."""
    os.write(2, b"skysim: stopped\n")
    os._exit(130)


def interrupt(_: int, frame: FrameType | None) -> None:
    """Handler: raise KeyboardInterrupt here, or if a function on the stack would lose it, in that function's caller."""
    caller = None
    while frame is not None:
        if loses_exceptions(frame.f_code):
            caller = frame.f_back
        frame = frame.f_back
    if caller is None:
        raise KeyboardInterrupt
    # A trace function may raise; Python calls the caller's at its next line, or when it returns.
    caller.f_trace = raise_interrupt
    sys.settrace(lambda *_: None)


def handle_signals(handler: Callable = interrupt) -> None:
    """Let a handler take SIGTERM, and Ctrl-C unless it is ignored or handled: `interrupt`, or during imports `stop`."""
    signal.signal(signal.SIGTERM, handler)
    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, stop):
        signal.signal(signal.SIGINT, handler)


def loses_exceptions(code: CodeType) -> bool:
    """Whether a function is called by compiled code that does not pass its exceptions on."""
    # A named tuple's constructor is the only lambda that the standard library compiles from a string.
    return (
        code.co_name in CALLBACKS
        or (code.co_name, code.co_filename) == ("<lambda>", "<string>")
        or code.co_filename == weakref.__file__
    )


def raise_interrupt(*_: object) -> None:
    """Trace function that raises KeyboardInterrupt."""
    raise KeyboardInterrupt


def raise_wrapped(error: BaseException | None) -> None:
    """Raise the KeyboardInterrupt of which an exception is the consequence, if there is one.

    In a program without this handler, such as a notebook, Ctrl-C may arrive as a SystemError.
    """
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            raise error
        error = error.__cause__ or error.__context__
