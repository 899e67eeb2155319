"""`python -m skysim`."""

from skysim.cli import main

main()
