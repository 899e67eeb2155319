"""Attitude filter (MEKF): attitude and gyro bias from gyro and star tracker."""
