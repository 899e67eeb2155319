"""How every loop is compiled, said in one place.

What a function leaves unsaid numba takes from the function for which it happens to be compiled first, and keeps on
disk: then whether it divides by zero or raises, and in which order it may add, would hang on what ran first.
"""

from __future__ import annotations

from functools import partial

import numba
from numba.core import event

from skysim.core import errors

# Division by zero gives inf or nan, as arrays do; sums are added as written unless a function allows otherwise.
jit = partial(numba.njit, cache=True, error_model="numpy", fastmath=False)


class Listener(event.Listener):
    """Says at the first compilation that one is under way; what is read from numba's cache makes none."""

    def on_start(self, _: event.Event) -> None:
        event.unregister("numba:compile", self)
        errors.note("compiling its loops, once after an installation or a change: a minute or so")

    def on_end(self, _: event.Event) -> None:
        """Nothing is said of it."""


if errors.attended:
    event.register("numba:compile", Listener())
