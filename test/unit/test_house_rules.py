"""The rules of docs/architecture.md and CONTRIBUTING.md, held by reading the sources."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.lint

SOURCES = Path(__file__).resolve().parents[2] / "src"
STAGES = {"vli_driver", "vli_frontend", "vli_backend", "vli_mapping"}
PACKAGES = sorted(path.parent.name for path in SOURCES.glob("*/package.xml"))
MAY_IMPORT = {
    "vli_common": set(),
    "vli_simulation": {"vli_common", "vli_driver", "vli_calibration"},
    "vli_calibration": {"vli_common", "vli_driver"},
    "vli_bringup": set(PACKAGES),
    **{stage: {"vli_common"} for stage in STAGES},
}
ROS = {"rclpy", "builtin_interfaces", "rcl_interfaces", "launch", "launch_ros", "ament_index_python", "tf2_ros", "std_srvs"}
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "yaml": "PyYAML"}
"""Import name → name on the package index, where they differ."""

DOTTED = re.compile(r"vli_\w+(\.\w+)+")


@dataclass(frozen=True)
class Module:
    """One source file."""

    path: Path

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.path.read_text(), self.path.name)

    @property
    def package(self) -> str:
        return self.path.relative_to(SOURCES).parts[0]

    @property
    def is_plumbing(self) -> bool:
        """True where ROS may be imported: thin nodes, launch files, what vli_common and vli_bringup make nodes of."""
        inside = self.path.relative_to(SOURCES / self.package).parts
        plumbing = {"nodes", "launch", "messages", "node"}
        return self.package == "vli_bringup" or not plumbing.isdisjoint((*inside, self.path.stem))

    def __str__(self) -> str:
        return str(self.path.relative_to(SOURCES))

    def imports(self) -> Iterator[tuple[int, str]]:
        """Yield line and top-level package of each absolute import, wherever it stands; names for importlib too."""
        for item in ast.walk(self.tree):
            if isinstance(item, ast.Import):
                yield from ((item.lineno, alias.name.split(".")[0]) for alias in item.names)
            elif isinstance(item, ast.ImportFrom) and item.module and not item.level:
                yield item.lineno, item.module.split(".")[0]
            elif isinstance(item, ast.Constant) and isinstance(item.value, str) and DOTTED.fullmatch(item.value):
                yield item.lineno, item.value.split(".")[0]


MODULES = [Module(path) for path in sorted(SOURCES.glob("*/vli_*/**/*.py"))]


def is_ros(name: str) -> bool:
    """Return True for rclpy, launch and message packages."""
    return name in ROS or name.endswith("_msgs")


def undocumented(scope: ast.Module | ast.ClassDef, prefix: str) -> Iterator[str]:
    """Yield public names without a docstring; an override may inherit the one of its base by ``typing.override`` only."""
    for item in scope.body:
        if isinstance(item, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef) and not item.name.startswith("_"):
            if not ast.get_docstring(item):
                yield f"{prefix}:{item.lineno} {item.name}"
            if isinstance(item, ast.ClassDef):
                yield from undocumented(item, prefix)


def install_requires(package: str) -> set[str]:
    """Return the names in ``install_requires`` of a package's setup.py, lower case."""
    for item in ast.walk(ast.parse((SOURCES / package / "setup.py").read_text())):
        if isinstance(item, ast.keyword) and item.arg == "install_requires":
            names = [element.value for element in item.value.elts]
            return {name.replace("<", " ").replace(">", " ").replace("=", " ").split()[0].lower() for name in names}
    raise AssertionError(f"no install_requires in the setup.py of '{package}'")


def test_there_are_sources_to_check():
    assert STAGES | {"vli_common", "vli_bringup", "vli_simulation", "vli_calibration"} <= set(PACKAGES)
    assert all(any(module.package == package for module in MODULES) for package in PACKAGES)


def test_packages_import_only_those_they_may():
    wrong = [
        f"{module}:{line} imports {name}"
        for module in MODULES
        for line, name in module.imports()
        if name in PACKAGES and name not in MAY_IMPORT[module.package] | {module.package}
    ]
    assert wrong == []


@pytest.mark.parametrize("package", sorted(set(PACKAGES) - {"vli_common"}))
def test_whoever_imports_a_package_first_has_blas_limited_before_numpy_comes(package: str) -> None:
    (module,) = (module for module in MODULES if module.path == SOURCES / package / package / "__init__.py")
    assert [name for _, name in module.imports()] == ["vli_common"]


def test_algorithm_modules_know_nothing_of_ros():
    wrong = [
        f"{module}:{line} imports {name}"
        for module in MODULES
        if not module.is_plumbing
        for line, name in module.imports()
        if is_ros(name)
    ]
    assert wrong == []


def test_every_public_name_has_a_docstring():
    wrong = [name for module in MODULES for name in undocumented(module.tree, str(module))]
    wrong += [f"{module} itself" for module in MODULES if module.path.read_text().strip() and not ast.get_docstring(module.tree)]
    assert wrong == []


def test_inputs_are_not_checked_by_assert_and_nothing_is_pickled():
    wrong = [
        f"{module}:{item.lineno} asserts" for module in MODULES for item in ast.walk(module.tree) if isinstance(item, ast.Assert)
    ]
    wrong += [
        f"{module}:{line} imports {name}"
        for module in MODULES
        for line, name in module.imports()
        if name in ("pickle", "marshal", "shelve", "dill")
    ]
    assert wrong == []


def test_libraries_do_not_print():
    wrong = [
        f"{module}:{item.lineno} prints"
        for module in MODULES
        if module.package != "vli_bringup" and module.path.stem != "cli"
        for item in ast.walk(module.tree)
        if isinstance(item, ast.Call) and isinstance(item.func, ast.Name) and item.func.id == "print"
    ]
    assert wrong == []


@pytest.mark.parametrize("package", PACKAGES)
def test_setup_py_requires_what_is_imported_and_nothing_else(package):
    imported = {name for module in MODULES if module.package == package for _, name in module.imports()}
    third_party = {name for name in imported if name not in sys.stdlib_module_names and not is_ros(name) and name != package}
    assert {DISTRIBUTIONS.get(name, name).lower() for name in third_party} == install_requires(package)


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_names_every_package_of_ros_and_ours_that_is_imported(package):
    imported = {name for module in MODULES if module.package == package for _, name in module.imports()}
    wanted = {name for name in imported if (is_ros(name) or name in PACKAGES) and name != package}
    depends = {item.text for item in ElementTree.parse(SOURCES / package / "package.xml").iter("exec_depend")}
    assert wanted - depends == set()
