"""What is present, what is missing, what each missing part costs, and the line that mends it.

Only the standard library is imported here, so that this works where everything else is missing. Each package is
imported in another process, all in one to be quick: one whose system library is absent, or which crashes, is tried
again in a process of its own, reported, and does not end the doctor.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from dbh_studio.app.cache import cache_folder
from dbh_studio.app.components import APT_PACKAGES, COMPONENTS, Component, no_wheel_reason

Status = Literal["ok", "missing", "broken"]

STUDIO_PORT = 8080
PYTHON_FIRST, PYTHON_LAST = (3, 10), (3, 13)
MIN_CORES = 2
MIN_MEMORY_GB = 4.0
MIN_DISK_GB = 2.0
IMPORT_TIMEOUT_S = 120.0
# After this long, something hangs or the disk is slow: then each is given its own time.
TOGETHER_TIMEOUT_S = 40.0
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM_MAC = "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome"
FONT_FOLDERS = ("/usr/share/fonts", "/usr/local/share/fonts", "~/.local/share/fonts", "~/.fonts", "/Library/Fonts")

# Run by `python -c`: one JSON line says whether the module can be imported and which of the libraries cannot be loaded.
PROBE = """
import ctypes, importlib, json, sys
answer = {"error": "", "module": "", "libraries": []}
try:
    importlib.import_module(sys.argv[1])
except BaseException as error:
    answer["error"] = (str(error).strip() or type(error).__name__).splitlines()[0]
    answer["module"] = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    for name in sys.argv[2:]:
        try:
            ctypes.CDLL(name)
        except OSError:
            answer["libraries"].append(name)
print("\\n" + json.dumps(answer))
"""

# Run by `python -c`: names what can be imported. Ends at once, for taking down what was loaded takes as long again.
TOGETHER = """
import importlib, os, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except BaseException:
        continue
    print("\\nimported " + name, flush=True)
os._exit(0)
"""


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    Attributes:
        name: What it is.
        status: ``ok``, ``missing`` (not there, or too little of it) or ``broken`` (there, but it does not work).
        version: Its version or amount; empty where unknown.
        cost: What the person cannot do without it.
        remedy: The line that mends it; empty when nothing is to be mended.
        required: Whether the studio cannot do its core job without it.
        detail: What went wrong, in the words of the system.
        apt: Debian packages that would mend it.
        is_for_tests: Whether only the project's own tests use it.
    """

    name: str
    status: Status
    version: str
    cost: str
    remedy: str
    required: bool
    detail: str = ""
    apt: tuple[str, ...] = ()
    is_for_tests: bool = False


def check_all(*, port: int = STUDIO_PORT) -> tuple[Check, ...]:
    """Every check; takes a second or two, most of it importing Open3D and trimesh.

    Args:
        port: The port that the studio would listen on.
    """
    modules = [component.module for component in COMPONENTS if _is_found(component)]
    with ThreadPoolExecutor(max_workers=min(4, (os.cpu_count() or 1) + 1)) as pool:
        test_parts = pool.submit(check_test_parts)
        imported = import_together(modules)
        components = tuple(pool.map(lambda item: check_component(item, imported=imported), COMPONENTS))
    machine = (check_python(), check_cores(), check_memory(), check_disk(), check_port(port))
    return (*machine, *components, *test_parts.result())


def is_usable(checks: Iterable[Check]) -> bool:
    """Whether the core job works: read a cloud, find and measure the trees, open the studio."""
    return all(check.status == "ok" for check in checks if check.required)


def missing_apt_packages(checks: Iterable[Check]) -> tuple[str, ...]:
    """Debian packages that would mend the checks, sorted, each once."""
    return tuple(sorted({name for check in checks for name in check.apt if check.status != "ok"}))


def format_report(checks: Sequence[Check]) -> str:
    """The report as a person reads it; the last line is the verdict."""
    width = max((len(check.name) for check in checks), default=0)
    lines = []
    for check in checks:
        lines.append(f"  {check.status:<8}{check.name:<{width}}  {check.version}".rstrip())
        if check.status != "ok":
            extra = (("why", check.detail), ("cost", check.cost), ("mend", check.remedy))
            lines += [f"{'':10}{label + ':':<6}{text}" for label, text in extra if text]
    packages = missing_apt_packages(check for check in checks if not check.is_for_tests)
    if len(packages) > 1:
        lines += ["", "All missing system packages in one line:", f"  {apt_line(packages)}"]
    return "\n".join([*lines, "", _verdict(checks)])


def format_json(checks: Sequence[Check]) -> str:
    """The same for programs: ``{"usable": bool, "apt_packages": [...], "checks": [...]}``."""
    report = {
        "usable": is_usable(checks),
        "apt_packages": missing_apt_packages(checks),
        "checks": [asdict(check) for check in checks],
    }
    return json.dumps(report, indent=2)


def _verdict(checks: Iterable[Check]) -> str:
    bad = [check for check in checks if check.status != "ok"]
    required = [check.name for check in bad if check.required]
    if required:
        return f"The studio cannot work: {', '.join(required)}."
    optional = [check.name for check in bad if not check.is_for_tests]
    text = f"The studio works; without the full use of {', '.join(optional)}." if optional else "The studio works."
    tests = [check.name for check in bad if check.is_for_tests]
    return f"{text} Its own browser tests lack {', '.join(tests)}." if tests else text


def check_component(component: Component, *, imported: Collection[str] = ()) -> Check:
    """Import a package in a process of its own and say what is wrong with it, if anything.

    Args:
        component: The package.
        imported: Modules known to work, which are not tried again.
    """
    name, version = _installed(component)
    if not _is_found(component):
        remedy = no_wheel_reason(component) or pip_line(name)
        return Check(name, "missing", "", component.cost, remedy, component.required)
    if component.module in imported:
        return Check(name, "ok", version, component.cost, "", component.required)
    error, absent_module, libraries = probe(component.module, component.libraries)
    if not error:
        return Check(name, "ok", version, component.cost, "", component.required)
    libraries = _with_named(libraries, error)
    apt = tuple(sorted({APT_PACKAGES[library] for library in libraries if library in APT_PACKAGES}))
    if libraries:
        remedy = _library_line(libraries, apt)
    elif absent_module and absent_module != component.module:
        remedy = pip_line(absent_module.partition(".")[0])
    else:
        remedy = pip_line(name, reinstall=True)
    return Check(name, "broken", version, component.cost, remedy, component.required, error, apt)


def _is_found(component: Component) -> bool:
    return importlib.util.find_spec(component.module) is not None


def import_together(modules: Sequence[str]) -> set[str]:
    """Those of the modules that one new process can import; what is not among them may be blameless."""
    if not modules:
        return set()
    try:
        done = subprocess.run(
            [sys.executable, "-c", TOGETHER, *modules],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TOGETHER_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return set()
    return {line.removeprefix("imported ") for line in done.stdout.splitlines() if line.startswith("imported ")}


def probe(module: str, libraries: Sequence[str] = ()) -> tuple[str, str, tuple[str, ...]]:
    """Import ``module`` in a new process.

    Returns:
        The error in one line (empty when the import works), the module that was not found (empty for other errors) and
        those of ``libraries`` that cannot be loaded (looked for only when the import fails).
    """
    command = [sys.executable, "-c", PROBE, module, *libraries]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=IMPORT_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"The import took longer than {IMPORT_TIMEOUT_S:.0f} s.", "", ()
    except OSError as error:
        return f"Python could not be started: {error}.", "", ()
    lines = done.stdout.strip().splitlines()
    if not lines or not lines[-1].startswith('{"error"'):
        return f"The import ended the process with {_exit_name(done.returncode)}.", "", ()
    answer = json.loads(lines[-1])
    return answer["error"], answer["module"], tuple(answer["libraries"])


def _with_named(libraries: tuple[str, ...], error: str) -> tuple[str, ...]:
    """The libraries, with the one that the dynamic linker names in its error."""
    named = re.search(r"\b(lib[^\s:]+\.so[.\d]*): cannot open shared object", error)
    return libraries if named is None or named[1] in libraries else (*libraries, named[1])


def _exit_name(code: int) -> str:
    if code >= 0:
        return f"code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _installed(component: Component) -> tuple[str, str]:
    """The name and version of the distribution that is installed; else the first name and no version."""
    for name in component.distributions:
        try:
            return name, importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return component.distributions[0], ""


def pip_line(name: str, *, reinstall: bool = False) -> str:
    """The command that installs a package into the Python that runs now, in a version the studio accepts."""
    try:
        requirements = importlib.metadata.requires("dbh-studio") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = []
    specs = [text.partition(";")[0].strip() for text in requirements]
    spec = next((text for text in specs if re.split(r"[<>=!~\[ ]", text)[0] == name), name)
    options = ["--force-reinstall", "--no-deps"] if reinstall else []
    return shlex.join([sys.executable, "-m", "pip", "install", *options, spec])


def apt_line(packages: Sequence[str]) -> str:
    """The command that installs Debian packages, for the person who runs this."""
    sudo = "" if is_root() else "sudo "
    return f"{sudo}apt-get update && {sudo}apt-get install -y --no-install-recommends {' '.join(packages)}"


def is_root() -> bool:
    """Whether apt may be run without sudo; false where there is no such notion."""
    return sys.platform != "win32" and os.geteuid() == 0


def _library_line(libraries: Sequence[str], apt: Sequence[str]) -> str:
    unknown = [library for library in libraries if library not in APT_PACKAGES]
    parts = []
    if apt and shutil.which("apt-get"):
        parts.append(apt_line(apt))
    elif apt:
        parts.append(f"Install {', '.join(libraries)} with the system's package manager (Debian: {' '.join(apt)}).")
    if unknown:
        parts.append(f"Find the package that holds {', '.join(unknown)}: apt-file search {unknown[0]}")
    return "  ".join(parts)


def check_python() -> Check:
    """The Python version against what the packages are published for."""
    found = sys.version_info[:2]
    is_good = PYTHON_FIRST <= found <= PYTHON_LAST
    first, last = (".".join(map(str, version)) for version in (PYTHON_FIRST, PYTHON_LAST))
    remedy = "" if is_good else f"Install Python {first} to {last}, then: make clean && make setup PYTHON=python{last}"
    status: Status = "ok" if is_good else "broken"
    return Check("Python", status, platform.python_version(), "The packages cannot be installed.", remedy, True)


def check_cores() -> Check:
    """The processor cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    status: Status = "ok" if cores >= MIN_CORES else "missing"
    remedy = "" if status == "ok" else f"Give the program {MIN_CORES} cores or more."
    return Check("processor cores", status, str(cores), "Finding trees is slow and the page waits.", remedy, False)


def check_memory() -> Check:
    """The memory of the machine."""
    cost = "Large clouds do not fit; thin them or cut them in parts."
    total_gb = _memory_gb()
    if total_gb is None:
        return Check("memory", "ok", "unknown", cost, "", False)
    status: Status = "ok" if total_gb >= MIN_MEMORY_GB else "missing"
    remedy = "" if status == "ok" else f"Use a computer with {MIN_MEMORY_GB:.0f} GB or more."
    return Check("memory", status, f"{total_gb:.1f} GB", cost, remedy, False)


def _memory_gb() -> float | None:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf; some systems do not know these names.
        return None


def check_disk(folder: Path | None = None) -> Check:
    """Free space, and the right to write, where the cache is or would be."""
    wanted = cache_folder(folder)
    # os.path, for pathlib raises where a folder above may not be looked into.
    existing = next(path for path in (wanted, *wanted.parents) if os.path.exists(path))  # noqa: PTH110
    cost = "The demo plot and prepared clouds cannot be kept."
    free_gb = shutil.disk_usage(existing).free / 1e9
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        detail = f"{existing} cannot be written."
        return Check("disk", "broken", f"{free_gb:.1f} GB free", cost, f"Allow writing in {existing}.", False, detail)
    status: Status = "ok" if free_gb >= MIN_DISK_GB else "missing"
    remedy = "" if status == "ok" else f"Free {MIN_DISK_GB:.0f} GB on the disk of {existing}."
    return Check("disk", status, f"{free_gb:.1f} GB free", cost, remedy, False)


def check_port(port: int = STUDIO_PORT) -> Check:
    """Whether the studio could listen on its usual port."""
    cost = "The studio cannot use its usual address; another port does as well."
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as server:
            if sys.platform != "win32":  # There the option would let two servers share the port.
                server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            server.bind(("127.0.0.1", port))
    except OSError as error:
        remedy = f"Close the program that uses port {port}, or start the studio with --port {port + 1}"
        return Check("port", "broken", str(port), cost, remedy, False, str(error))
    return Check("port", "ok", str(port), cost, "", False)


def find_chromium() -> str | None:
    """The path of a Chromium or Chrome, if there is one."""
    found = next((path for name in CHROMIUM_NAMES if (path := shutil.which(name))), None)
    return found or (CHROMIUM_MAC if Path(CHROMIUM_MAC).exists() else None)


def check_test_parts() -> tuple[Check, Check, Check]:
    """What only the browser tests use; the studio itself is opened in any browser, on any computer."""
    return check_chromium(), check_playwright(), check_font()


def _test_part(name: str, problem: str, apt: tuple[str, ...], *, version: str = "", is_there: bool = True) -> Check:
    """A check of something the browser tests use; all is well when ``problem`` is empty and it is there."""
    cost = "The browser tests of `make test` cannot run; the studio works."
    if is_there and not problem:
        return Check(name, "ok", version, cost, "", False, is_for_tests=True)
    remedy = apt_line(apt) if apt and shutil.which("apt-get") else f"Install {name}." if apt else "make setup-dev"
    return Check(name, "broken" if is_there else "missing", "", cost, remedy, False, problem, apt, True)


def _version_of(command: Sequence[str]) -> tuple[str, str]:
    """The version that a program prints, and its complaint when it does not."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return "", str(error)
    version = re.search(r"\d+(\.\d+)+", done.stdout)
    if done.returncode == 0 and version is not None:
        return version[0], ""
    return "", (done.stderr.strip() or done.stdout.strip() or "It does not start.").splitlines()[0]


def check_chromium() -> Check:
    """The browser that the tests drive."""
    path = find_chromium()
    if path is None:
        return _test_part("chromium", "", ("chromium",), is_there=False)
    version, problem = _version_of([path, "--version"])
    return _test_part("chromium", problem, ("chromium",), version=version)


def check_playwright() -> Check:
    """What drives the browser: a Python package with a program inside that has a need of its own."""
    if importlib.util.find_spec("playwright") is None:
        return _test_part("playwright", "", (), is_there=False)
    version, problem = _version_of([sys.executable, "-m", "playwright", "--version"])
    libraries = _with_named((), problem)
    return _test_part("playwright", problem, tuple(APT_PACKAGES.get(name, name) for name in libraries), version=version)


def check_font() -> Check:
    """A font for the text in the test browser's pictures."""
    folders = [Path(folder).expanduser() for folder in FONT_FOLDERS]
    has_font = sys.platform == "win32" or any(
        next(folder.rglob(pattern), None)
        for folder in folders
        if folder.is_dir()
        for pattern in ("*.ttf", "*.otf", "*.ttc")
    )
    return _test_part("font", "", ("fonts-dejavu-core",), is_there=has_font)


def main(arguments: Sequence[str] | None = None) -> int:
    """``python -m dbh_studio.app.doctor``: the report, or what set-up asks for.

    Returns:
        0 when the core job works, else 1.
    """
    parser = argparse.ArgumentParser(prog="dbh-studio doctor", description="Say what is missing and how to mend it.")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--apt-packages", choices=("run", "test"), help="print only the missing Debian packages")
    options = parser.parse_args(arguments)
    if options.apt_packages:
        checks = [check_component(component) for component in COMPONENTS if component.libraries]
        checks += check_test_parts() if options.apt_packages == "test" else ()
        sys.stdout.write("".join(f"{name}\n" for name in missing_apt_packages(checks)))
        return 0
    report = check_all()
    sys.stdout.write((format_json(report) if options.json else format_report(report)) + "\n")
    return 0 if is_usable(report) else 1


if __name__ == "__main__":
    sys.exit(main())
