"""Digests in git of results that a refactoring must not change: `python -m tests.baseline` compares them.

`--record` records them. Only public interfaces are used: the command line, `skysim.load_scene`, `simulate`,
`render`, `run_study`, and written files.
"""
