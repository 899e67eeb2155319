"""Experiments of other laboratories' star simulators: APL, NPS and OLED."""
