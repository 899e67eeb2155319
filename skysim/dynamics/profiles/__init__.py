"""Attitude over time: laws of one angle, and profiles of samples from files and tables, interpolated by a C2 spline."""
