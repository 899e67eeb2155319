"""Reproduction of published experiments: each published number is compared with ours, with an interval and a verdict.

    data/published/*.yaml ─ published ┐
    an experiment's module ─ results ─┴─ compare ─ page, cli.commands.reproduce

Each module holds one experiment or a few related ones; `registry.EXPERIMENTS` lists them all.
"""
