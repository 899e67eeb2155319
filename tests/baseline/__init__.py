"""What a refactoring must not change, as digests kept in git: `python -m tests.baseline` compares, `--record` records.

Only public faces are used: the command line, `skysim.load_scene`, `simulate`, `render`, `run_study`, and written files.
"""
