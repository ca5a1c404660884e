"""The files that set-up relies on say the same thing: pyproject, the locks, and the doctor's table."""

from __future__ import annotations

import importlib.metadata
import re
import runpy
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import dbh_studio
from dbh_studio.app.components import COMPONENTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCKS = ("run.lock", "dev.lock")
PLATFORMS = {
    "linux-x86_64": ("linux", "x86_64"),
    "linux-aarch64": ("linux", "aarch64"),
    "darwin-arm64": ("darwin", "arm64"),
    "darwin-x86_64": ("darwin", "x86_64"),
    "win32-AMD64": ("win32", "AMD64"),
}


def locked(name: str) -> dict[str, str]:
    """Each pin, without its marker, and the hashes that belong to it."""
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
    blocks = [block for block in re.split(r"(?m)^(?=[a-z])", text) if "==" in block]
    return {block.split()[0]: "\n".join(re.findall(r"--hash=sha256:[0-9a-f]{64}", block)) for block in blocks}


def asked(key: str, python: str) -> set[str]:
    system, machine = PLATFORMS[key]
    environment = {
        "sys_platform": system,
        "platform_machine": machine,
        "python_version": python,
        "python_full_version": f"{python}.0",
    }
    requirements = [Requirement(text) for text in PROJECT["dependencies"]]
    return {item.name for item in requirements if item.marker is None or item.marker.evaluate(environment)}


def test_the_version_is_said_once() -> None:
    assert dbh_studio.__version__ == PROJECT["version"] == importlib.metadata.version("dbh-studio")


@pytest.mark.parametrize("name", LOCKS)
def test_every_locked_package_has_hashes(name: str) -> None:
    pins = locked(name)
    assert len(pins) > 50
    assert [pin for pin, hashes in pins.items() if not hashes] == []


@pytest.mark.parametrize("name", LOCKS)
def test_the_locks_name_no_registry_and_no_folder(name: str) -> None:
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
    assert re.findall(r"(?i)https?://|file:|index-url|find-links|(?<![\w.])/\w+/", text) == []


def test_what_is_tested_is_what_is_shipped() -> None:
    run, dev = locked("run.lock"), locked("dev.lock")
    assert {pin: hashes for pin, hashes in run.items() if dev.get(pin) != hashes} == {}


def test_the_run_lock_holds_every_dependency_and_what_builds_the_editable_install() -> None:
    names = {pin.partition("==")[0] for pin in locked("run.lock")}
    wanted = {Requirement(text).name for text in PROJECT["dependencies"]} | {"hatchling", "editables"}
    assert wanted - names == set()


def test_the_doctor_looks_at_every_dependency() -> None:
    looked_at = {name for component in COMPONENTS for name in component.distributions}
    assert {Requirement(text).name for text in PROJECT["dependencies"]} - looked_at == set()


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
@pytest.mark.parametrize("key", PLATFORMS)
def test_a_package_is_left_out_exactly_where_the_doctor_says_there_is_no_wheel(key: str, python: str) -> None:
    names = asked(key, python)
    for component in COMPONENTS:
        is_asked = bool(names.intersection(component.distributions))
        if component.module == "pyproj" and key == "darwin-x86_64":
            assert is_asked is (python in ("3.10", "3.11"))
        else:
            assert is_asked is (key not in component.no_wheel_on), component.module
        assert is_asked or not component.required


@pytest.mark.parametrize("key", PLATFORMS)
def test_open3d_is_asked_for_at_most_once(key: str) -> None:
    names = asked(key, "3.12") & {"open3d", "open3d-cpu"}
    assert names == ({"open3d-cpu"} if key == "linux-x86_64" else set() if key == "darwin-x86_64" else {"open3d"})


def test_a_package_can_be_taken_out_of_a_lock_with_its_hashes() -> None:
    setup = runpy.run_path(str(ROOT / "tools" / "setup_venv.py"))
    text = (ROOT / "requirements" / "run.lock").read_text(encoding="utf-8")
    shorter = setup["without"](text, {"open3d", "open3d-cpu"})
    assert not re.search(r"(?m)^open3d", shorter) and re.search(r"(?m)^numpy==", shorter)
    n_gone = len(re.findall(r"(?m)^\S+==", text)) - len(re.findall(r"(?m)^\S+==", shorter))
    assert n_gone == len(re.findall(r"(?m)^open3d\S*==", text)) > 0
    assert not re.search(r"\\\n(?! )", shorter)


def test_the_readme_names_the_two_commands_and_ci_calls_the_second() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.search(r"(?m)^make demo$", readme) and re.search(r"(?m)^make test$", readme)
    steps = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert [line for line in steps if line and not line.startswith("#")][-1] == "make test"
