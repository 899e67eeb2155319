"""Numba options of all compiled functions.

Options missing on a callee are inherited from the caller that compiles it first, and are cached on disk. All of them
are set here, so the results (division by zero, exceptions, order of additions) do not depend on the call order.
"""

from __future__ import annotations

from functools import partial

import numba
from numba.core import event

from skysim.core import errors

# No wrapper for C callbacks is compiled, since no compiled function is passed as a value.
# Division by zero gives inf or nan, as in NumPy; sums are not reordered unless a function sets fastmath itself.
jit = partial(numba.njit, cache=True, error_model="numpy", fastmath=False, no_cfunc_wrapper=True)


class CompilationNotice(event.Listener):
    """Prints a note at the first compilation; functions loaded from numba's cache do not compile."""

    def on_start(self, _: event.Event) -> None:
        event.unregister("numba:compile", self)
        errors.note(
            "compiling numba functions (once after an installation or update): about a minute"
        )

    def on_end(self, _: event.Event) -> None:
        """Required by the interface; prints nothing."""


if errors.running_as_command:
    event.register("numba:compile", CompilationNotice())
