"""The command `skysim`, also as `python -m skysim`."""

from skysim.core import errors


def main() -> None:
    """Run the command. Until its modules are imported, Ctrl-C and SIGTERM end it at once."""
    errors.handle_signals(errors.stop)
    from skysim.apps.cli import main

    main.main()


if __name__ == "__main__":
    main()
