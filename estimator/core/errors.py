"""The error of the estimator's users."""


class ImageError(ValueError):
    """The image or the calibration cannot be used. The one printable line names the fault and what is allowed."""

    def __init__(self, message: object) -> None:
        line = " ".join(
            str(message).split()
        )  # it may quote a file, and a file may hold anything
        super().__init__(
            "".join(character if character.isprintable() else "?" for character in line)
        )
