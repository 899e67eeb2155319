"""How every loop is compiled, said in one place.

What a function leaves unsaid numba takes from the function for which it happens to be compiled first, and keeps on
disk: then whether it divides by zero or raises, and in which order it may add, would hang on what ran first.
"""

from __future__ import annotations

from functools import partial

import numba

# Division by zero gives inf or nan, as arrays do; sums are added as written unless a function allows otherwise.
jit = partial(numba.njit, cache=True, error_model="numpy", fastmath=False)
