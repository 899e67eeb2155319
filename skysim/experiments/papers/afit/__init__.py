"""Experiments of the AFIT thesis (Padro 2012)."""
