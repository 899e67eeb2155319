"""The process in which an entry point's plug-in runs: answers messages on standard input, one line of JSON each.

The answers go to the original standard output; what the plug-in itself prints goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import IO, Any

from skysim.core.errors import printable

Respond = Callable[[dict[str, Any], IO[bytes]], dict[str, Any]]  # a message's header and what follows it, to an answer


def describe_error(error: Exception) -> str:
    """An exception as one line."""
    return printable(f"{type(error).__name__}: {error}")


def serve(create: Callable[[dict[str, Any]], Respond]) -> None:
    """Set up the plug-in from the first line of the input, then answer each message until the input ends.

    create(setup) : returns the function that answers; an exception becomes {"ready": false, "status": reason}
    """
    messages, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(reply: dict[str, Any]) -> None:
        answers.write(json.dumps(reply) + "\n")
        answers.flush()

    try:
        respond = create(json.loads(messages.readline()))
    except Exception as error:
        send({"ready": False, "status": describe_error(error)})
        return
    send({"ready": True})
    while line := messages.readline():
        send(respond(json.loads(line), messages))
