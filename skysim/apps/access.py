"""Who may talk to a server of skysim: names of the host, and the token."""

import hmac
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from skysim.core.errors import InputError, reason

HOST = "127.0.0.1"  # reached by this machine alone
LOOPBACK = (HOST, "localhost", "::1", "[::1]")


def token_matches(candidate: str, token: str) -> bool:
    """Compare with the token in constant time, so that timing reveals nothing about it."""
    return hmac.compare_digest(candidate.encode(), token.encode())


def listen(option: str, host: str, port: int) -> socket.socket:
    """A socket that listens; port 0 is any free one. Raises InputError for an address that cannot be bound."""
    with names_address(option, host, port):
        return socket.create_server((host, port))


@contextmanager
def names_address(option: str, host: str, port: int) -> Iterator[None]:
    """Raise InputError, with the option and its address, instead of OSError."""
    try:
        yield
    except OSError as error:
        problem = f"cannot listen on {host}:{port}: {reason(error)}"
        raise InputError(f"{option} {port}", problem) from None


def host_of(header: str) -> str:
    """The host of a Host header, without the port."""
    return header.rpartition(":")[0] if header.rpartition(":")[2].isdigit() else header


def same_site(host: str, origin: str, served: str) -> str:
    """Why a request by its headers Host and Origin is refused; empty if it is allowed.

    Parameters
    ----------
    served
        Address that the server listens on; on loopback the host has to be of loopback too. This stops DNS rebinding:
        the name of another site that resolves to this server comes with its own Host header
    """
    if served in LOOPBACK and host_of(host) not in LOOPBACK:
        return "host name not allowed"
    if origin and origin.partition("://")[2] != host:
        return "request of another site refused"
    return ""
