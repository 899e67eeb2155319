"""Ctrl-C and SIGTERM as KeyboardInterrupt, raised only where every caller passes it on.

Python runs a signal's handler in the function of the main thread that runs next. After a compiled kernel this is often
one that the kernel's wrapper calls to build a named tuple. Numba does not expect it to fail: the process crashes, or
the interrupt becomes a SystemError, which looks like a failure of the computation. Finalizers ignore exceptions.
"""

from __future__ import annotations

import signal
import sys
import weakref
from types import CodeType, FrameType

# Functions that numba and its compiler call, and finalizers.
CALLBACKS = (
    "_numba_unpickle",
    "_raw_object_cache_getbuffer",
    "_raw_object_cache_notify",
    "__del__",
)


def handle_signals() -> None:
    """Let SIGTERM, and Ctrl-C unless it is ignored or handled, raise KeyboardInterrupt in the main thread."""
    signal.signal(signal.SIGTERM, interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


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
