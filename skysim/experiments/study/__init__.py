"""Studies: Monte Carlo trials of a scene with varied parameters; results have confidence intervals.

`study_file` reads a study file into a `plan`; `execution` runs the trials and stores one row per trial; `answer`,
`table`, `thresholds` and `search` analyze them, and `report` shows the result.
"""
