"""`python -m skysim`."""

from skysim.apps.cli.main import main

main()
