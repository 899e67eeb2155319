"""Survey of the dome: the positions that the tracker assumes, with the errors of the instrument."""
