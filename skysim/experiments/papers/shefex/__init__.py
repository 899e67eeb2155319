"""Experiments of SHEFEX-2 (Samaan & Theil 2011)."""
