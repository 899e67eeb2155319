"""The commands. Thin: they check, call, show progress and print; heavy imports wait for their command."""
