"""Compiler options of all numba functions, and the time that compilation takes.

Options that a callee leaves out are inherited from the caller that compiles it first, and are cached on disk. We set
them all, so that the results (division by zero, order of summation) do not depend on the order of calls.
"""

from functools import partial

import numba
from numba.core import event

# The GIL is released, so that threads of one process can search at once.
# No wrapper for C callbacks is compiled, since no compiled function is passed as a value.
# Division by zero gives inf or nan, as in NumPy; sums keep the order of the source unless a function sets fastmath.
jit = partial(
    numba.njit,
    cache=True,
    error_model="numpy",
    fastmath=False,
    no_cfunc_wrapper=True,
    nogil=True,
)
# For functions with one caller in most runs: LLVM optimizes a called function by itself, and once more in its caller.
inlined = partial(jit, inline="always")

COMPILATION = event.TimingListener()
# numba holds the lock while it compiles a function, and while it loads compiled code.
event.register("numba:compiler_lock", COMPILATION)


def compiled_s() -> float:
    """Return the seconds that this process has spent on compiling functions and on loading compiled code."""
    return float(COMPILATION.duration) if COMPILATION.done else 0.0
