"""Studies: Monte Carlo trials of a scene with varied parameters; results have confidence intervals.

`loader` reads a study file into a `plan`; `execution` runs the trials and stores one row per trial; `analysis` computes
statistics and `report` shows them.
"""
