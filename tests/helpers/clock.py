"""A clock for tests of what is paced: none of them waits, or depends on the machine's load."""


class FakeClock:
    """Substitute for the module `time`: a wall clock that only `sleep` advances."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def time(self) -> float:
        return 1e9 + self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
