"""A camera file from the numbers of a data sheet, for `skysim camera new`."""
