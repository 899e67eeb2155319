"""The package `estimator` of this checkout, with the catalog that it reads; the rest is said in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build/estimator"
CATALOG = "data/catalogs/hipparcos_hp6.5.ecsv"


class BuildWithCatalog(build_py):
    """The catalog travels within the package; an editable one reads that of the checkout."""

    def run(self) -> None:
        super().run()
        package = Path(self.build_lib) / "estimator"
        for source, name in (
            () if self.editable_mode else ((CATALOG, CATALOG), ("LICENSE", "LICENSE"))
        ):
            (package / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / source, package / name)


shutil.rmtree(
    BUILD, ignore_errors=True
)  # a module that is gone from the checkout would stay in the wheel
BUILD.mkdir(parents=True, exist_ok=True)
setup(
    packages=[
        "estimator",
        *(f"estimator.{name}" for name in find_packages(str(ROOT / "estimator"))),
    ],
    package_dir={"estimator": "../../estimator"},
    cmdclass={"build_py": BuildWithCatalog},
    options={"build": {"build_base": str(BUILD)}, "egg_info": {"egg_base": str(BUILD)}},
)
