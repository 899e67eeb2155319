"""Plug-ins that installed packages offer by entry points, and the names that a scene may give."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from typing import NamedTuple

from skysim.core.errors import InputError, unknown_name


class PluginKind(NamedTuple):
    """A kind of plug-in.

    kind  : what it is, for messages
    group : group of the entry points
    key   : key of the scene that names one
    own   : names of skysim's own, which no plug-in may take
    """

    kind: str
    group: str
    key: str
    own: tuple[str, ...]

    def entry_points(self) -> dict[str, metadata.EntryPoint]:
        """The plug-ins of installed packages by name; none is loaded."""
        return {point.name: point for point in metadata.entry_points(group=self.group) if point.name not in self.own}

    def release(self, name: str) -> str:
        """Name and version of the package that offers a plug-in; empty for skysim's own and for programs."""
        point = self.entry_points().get(name) if name not in self.own else None
        return f"{point.dist.name} {point.dist.version}" if point and point.dist else ""

    def check_name(self, name: str, commands: Mapping[str, str]) -> None:
        """Raise InputError for an unknown name; commands are those of programs, by name."""
        allowed = [*self.own, *self.entry_points(), *commands]
        if name not in allowed:
            problem, names = unknown_name(self.kind, name, allowed)
            raise InputError(self.key, problem, f"{names}, or a program as {name}=COMMAND")
