#!/usr/bin/env python3
"""Make the virtual environment and install the locked packages into it.

Run by the Makefile. Only the standard library, and only what Python 3.6 understands: on a Python that is too old this
has to say so instead of failing on its own syntax.
"""

import argparse
import importlib.util
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path

FIRST, LAST = (3, 10), (3, 13)
OPEN3D_MIN_GLIBC = (2, 35)
ROOT = Path(__file__).resolve().parent.parent


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv", help="the environment's folder")
    parser.add_argument("--lock", type=Path, help="a file of pinned, hashed requirements to install")
    parser.add_argument("--editable", action="store_true", help="install the studio itself from this folder")
    options = parser.parse_args()
    python = venv_python(options.venv)
    if not python.exists():
        check_python()
        print("Making the virtual environment {} with Python {}".format(options.venv, platform.python_version()))
        run([sys.executable, "-m", "venv", str(options.venv)], "The virtual environment could not be made.")
    if options.lock:
        install_lock(python, options.lock)
    if options.editable:
        pip(python, ["install", "--no-index", "--no-build-isolation", "--no-deps", "--editable", str(ROOT)])


def venv_python(venv):
    return venv / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def check_python():
    if not FIRST <= sys.version_info[:2] <= LAST:
        stop(
            "DBH Studio needs Python 3.10 to 3.13; {} is {}.".format(sys.executable, platform.python_version()),
            "Install one of them and name it, for example:  make setup PYTHON=python3.12",
        )
    if importlib.util.find_spec("ensurepip") is None or importlib.util.find_spec("venv") is None:
        stop(
            "This Python has no venv module, so no virtual environment can be made.",
            "On Debian and Ubuntu:  sudo apt-get update && sudo apt-get install -y python3-venv",
        )


def install_lock(python, lock):
    print("Installing the packages of {} (some hundred megabytes the first time)".format(lock), flush=True)
    text = lock.read_text(encoding="utf-8")
    if is_glibc_older_than(OPEN3D_MIN_GLIBC):
        print("This system's C library is too old for Open3D: it is left out; the studio works without it.")
        text = without(text, {"open3d", "open3d-cpu"})
    with tempfile.TemporaryDirectory() as folder:
        chosen = Path(folder) / lock.name
        chosen.write_text(text, encoding="utf-8")
        pip(python, ["install", "--require-hashes", "--only-binary", ":all:", "--requirement", str(chosen)])


def is_glibc_older_than(version):
    kind, found = platform.libc_ver()
    return kind == "glibc" and tuple(int(part) for part in found.split(".")[:2]) < version


def without(lock_text, names):
    """The lock without some packages; a package is an unindented line and the indented lines after it."""
    blocks = re.split(r"(?m)^(?=\S)", lock_text)
    return "".join(block for block in blocks if re.split(r"[=\s]", block)[0] not in names)


def pip(python, arguments):
    problem = "pip could not install the packages; its message is above."
    run([str(python), "-m", "pip", "--disable-pip-version-check", "--quiet", *arguments], problem)


def run(command, problem):
    code = subprocess.call(command, stdin=subprocess.DEVNULL)
    if code != 0:
        stop(problem, "The command was:  {}".format(" ".join(command)))


def stop(problem, remedy):
    sys.stderr.write("{}\n{}\n".format(problem, remedy))
    sys.exit(1)


if __name__ == "__main__":
    main()
