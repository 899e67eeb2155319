"""A star tracker's laboratory in software: simulate, render, solve, score.

run = skysim.simulate(skysim.load_scene("shefex2", {"exposure.frames": 3}))
run[0].image, run[0].truth, run[0].attitude, run[0].error_arcsec
"""

import os

import lazy_loader

# Idle threads of compiled loops sleep: on a busy machine spinning threads take the core that the others wait for, and
# a frame takes three times as long (measured). Read when the first loop runs.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# So do OpenBLAS's, after 2^4 cycles in place of 2^26. NumPy and SciPy have a pool each, whose threads spin after the
# import already, for a sixth of the processor time of a short command. Read when NumPy is imported.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")

# Loaded on first use, so that `import skysim` is quick.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
