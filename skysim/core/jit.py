"""Numba options of all compiled functions.

A callee inherits missing options from the caller that compiles it first, and they are cached on disk. All options are
set here, so the results (division by zero, exceptions, order of additions) do not depend on the call order.
"""

from functools import partial

import numba
from numba.core import event

from skysim.core import errors

# No wrapper for C callbacks is compiled, since no compiled function is passed as a value.
# Division by zero gives inf or nan, as in NumPy; sums are not reordered unless a function sets fastmath itself.
# A function is compiled again into each that calls it, and of these copies the one that is loaded first serves all.
# Fastmath may round them differently, so that a frame would depend on what was compiled and what came from the cache.
jit = partial(
    numba.njit, cache=True, error_model="numpy", fastmath=False, no_cfunc_wrapper=True
)
# For functions that make no array and return none: references to their arrays are not counted. Each change of such a
# count is a locked instruction, which waits for all stores before it. The option is private to numba.
loop = partial(jit, _nrt=False)


class CompilationNotice(event.Listener):
    """Listener that prints a note at the first compilation; functions from numba's cache are not compiled."""

    printed = False

    def on_start(self, _: event.Event) -> None:
        """Called by numba before it compiles a function."""
        # It stays registered: if a listener leaves while numba calls them in turn, numba skips the next.
        if not self.printed:
            errors.note(
                "compiling numba functions (once after an installation or update): about a minute"
            )
        self.printed = True

    def on_end(self, _: event.Event) -> None:
        """Required by the interface; prints nothing."""


if errors.running_as_command:
    event.register("numba:compile", CompilationNotice())
