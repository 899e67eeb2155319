"""Kills at random moments: `python -m tests.kills`."""
