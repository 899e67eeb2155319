"""Labelled frames in bulk: `skysim dataset` writes them in shards that any number of workers make in any order."""
