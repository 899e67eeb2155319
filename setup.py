"""A built package carries scenes and data within `skysim`; everything else is said in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

CARRIED = ("scenes", "data")
BUILT = "hipparcos_hp[7-9]*", "gaia_v[!8]*"  # catalogs that a user has built
# Scripts that made some of the data.
SCRIPTS = "build.py", "find_missing.py"
LEFT = shutil.ignore_patterns("__pycache__", *SCRIPTS, *BUILT)


class BuildWithData(build_py):
    """Of a checkout that is only linked to, nothing is copied."""

    def run(self) -> None:
        super().run()
        for name in CARRIED if not self.editable_mode else ():
            shutil.copytree(
                name, Path(self.build_lib) / "skysim" / name, ignore=LEFT, dirs_exist_ok=True
            )


setup(cmdclass={"build_py": BuildWithData})
