"""The papers' experiments done again: each published number beside ours, with its interval and a verdict.

    data/published/*.yaml ─ published ┐
    an experiment's module ─ answers ─┴─ compare ─ page, commands

A module an experiment or a few that belong together; `experiments.EXPERIMENTS` names them all.
"""
