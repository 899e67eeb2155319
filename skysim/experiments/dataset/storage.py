"""The folder of a dataset: any URL that fsspec knows. A local file appears whole or not at all, as an object does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from skysim.core.errors import InputError
from skysim.core.io.files import atomic_file, make_folder

EXTRA = "needs optional packages: pip install 'skysim[dataset]'"
URLS = "a folder, or a URL such as s3://bucket/folder"


class Storage:
    """Files of a dataset by name. Raises InputError for a URL that cannot be opened."""

    def __init__(self, url: str) -> None:
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise InputError(url, f"a dataset {EXTRA}") from None
        try:
            self.files, self.root = url_to_fs(url)
        except ImportError as error:
            raise InputError(url, f"{error}; {EXTRA}") from None
        except (OSError, ValueError) as error:
            raise InputError(url, error, URLS) from None
        self.url = url
        self.is_local = "file" in (self.files.protocol, *self.files.protocol)

    def path(self, name: str) -> str:
        """The path of a file in the file system."""
        return f"{self.root.rstrip('/')}/{name}"

    def names(self, folder: str = "") -> set[str]:
        """Names of the files of a folder; empty if there is none. Raises InputError if it cannot be read."""
        with self.errors():
            self.files.invalidate_cache()
            try:
                found = self.files.ls(self.path(folder), detail=False)
            except FileNotFoundError:
                return set()
        names = {str(path).rstrip("/").rsplit("/", 1)[-1] for path in found}
        return {name for name in names if name and not name.startswith(".")}

    def read_text(self, name: str) -> str:
        """A text file. Raises InputError if it cannot be read."""
        with self.errors():
            return str(self.files.cat_file(self.path(name)).decode("utf-8", "replace"))

    def prepare(self, folders: tuple[str, ...]) -> None:
        """Create the folders, without temporary files of writers that were killed."""
        if self.is_local:
            for folder in ("", *folders):
                make_folder(Path(self.path(folder)))

    @contextmanager
    def writer(self, name: str) -> Iterator[IO[bytes]]:
        """A file that is written from its begin to its end."""
        if self.is_local:
            with atomic_file(Path(self.path(name))) as temporary, temporary.open("wb") as file:
                yield file
            return
        with self.errors(), self.files.open(self.path(name), "wb") as file:
            yield file

    def write(self, name: str, data: bytes) -> None:
        """Write a whole file."""
        with self.writer(name) as file:
            file.write(data)

    def zarr_store(self, name: str) -> Any:
        """The store of a Zarr group."""
        from zarr.storage import FsspecStore, LocalStore

        return (
            LocalStore(self.path(name))
            if self.is_local
            else FsspecStore.from_url(f"{self.url.rstrip('/')}/{name}")
        )

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Raise InputError for what a server refuses or a network loses; errors of local files name their file."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            if self.is_local:
                raise
            raise InputError(self.url, error, f"{URLS} that can be written") from None
