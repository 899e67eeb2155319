"""Experiments with other laboratories' star simulators: JHU/APL's dome, NPS's panel and AFIT's OLED dome."""
