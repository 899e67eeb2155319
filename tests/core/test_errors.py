"""Messages of errors: one line that a terminal can show, whatever they quote."""

from __future__ import annotations

import pytest

from estimator.core.errors import ImageError
from skysim.core.errors import InputError


@pytest.mark.parametrize("error", [InputError, ImageError])
@pytest.mark.parametrize("quoted", ["\x1e", "a\nb", "\x1b[2J", "\u2028", "\ud800"])
def test_message_is_one_printable_line(error, quoted):
    message = str(error(f"file.tle, line 2: the checksum is {quoted}; it should be 9"))
    assert message.isprintable()
    assert message.startswith("file.tle, line 2: ")
    assert message.endswith("; it should be 9")
