"""The Python packages the studio is made of: what each is for, and what it needs from the system.

Only the standard library is imported here: the doctor reads this table where the packages themselves are missing.
"""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass

# Shared library -> the Debian and Ubuntu package that holds it.
APT_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libatomic.so.1": "libatomic1",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}


def platform_key() -> str:
    """The platform as ``sys_platform-platform_machine``, for example ``linux-x86_64``."""
    return f"{sys.platform}-{platform.machine()}"


@dataclass(frozen=True)
class Component:
    """A Python package: how it is imported, what it is for, and which system libraries it needs."""

    module: str
    distributions: tuple[str, ...]
    cost: str
    required: bool = False
    libraries: tuple[str, ...] = ()
    no_wheel_on: tuple[str, ...] = ()
    min_glibc: tuple[int, int] = (0, 0)


MAC_INTEL, LINUX_ARM = "darwin-x86_64", "linux-aarch64"
COMPONENTS = (
    Component("numpy", ("numpy",), "Nothing works without it.", required=True),
    Component("scipy", ("scipy",), "No tree can be found or measured.", required=True),
    Component("pydantic", ("pydantic",), "Settings and saved plots cannot be read.", required=True),
    Component("platformdirs", ("platformdirs",), "The folder for cached data cannot be found.", required=True),
    Component("PIL", ("pillow",), "The studio's server cannot start.", required=True),
    Component("viser", ("viser",), "The studio cannot be opened in the browser.", required=True),
    Component("laspy", ("laspy",), "LAS and LAZ files cannot be read.", required=True),
    Component("lazrs", ("lazrs",), "LAZ files cannot be read; LAS files can."),
    Component(
        "pye57", ("pye57",), "E57 files cannot be read; the other formats can.", no_wheel_on=(MAC_INTEL, LINUX_ARM)
    ),
    Component("trimesh", ("trimesh",), "Meshes (OBJ, STL, GLB) cannot be read; point clouds can."),
    Component("xlsxwriter", ("xlsxwriter",), "Excel workbooks cannot be written; the other exports can."),
    Component(
        "pyproj",
        ("pyproj",),
        "Coordinate systems cannot be named or converted; metres still work.",
        no_wheel_on=(MAC_INTEL,),
    ),
    Component(
        "open3d",
        ("open3d-cpu", "open3d") if platform_key() == "linux-x86_64" else ("open3d", "open3d-cpu"),
        "What is built on Open3D is not offered; reading, finding and measuring trees work without it.",
        libraries=("libEGL.so.1", "libGL.so.1", "libX11.so.6", "libidn2.so.0", "libudev.so.1", "libusb-1.0.so.0"),
        no_wheel_on=(MAC_INTEL,),
        min_glibc=(2, 35),
    ),
    Component(
        "pycolmap",
        ("pycolmap",),
        "Camera poses cannot be computed from photos; finished clouds can be measured.",
        no_wheel_on=(MAC_INTEL, LINUX_ARM),
    ),
    Component(
        "onnxruntime",
        ("onnxruntime",),
        "Trained models cannot run; the geometric detector finds the trees.",
        no_wheel_on=(MAC_INTEL,),
    ),
    Component(
        "cv2", ("opencv-python-headless", "opencv-python"), "Printed markers cannot be found; scale is given by hand."
    ),
)


def no_wheel_reason(component: Component) -> str:
    """Why the package cannot be installed here; empty when it can."""
    name = component.distributions[0]
    if platform_key() in component.no_wheel_on:
        return f"No ready-made {name} is published for {platform_key()}; use another computer for this part."
    kind, version = platform.libc_ver()
    if kind == "glibc" and tuple(int(part) for part in version.split(".")[:2]) < component.min_glibc:
        need = ".".join(map(str, component.min_glibc))
        return f"{name} needs glibc {need} or newer (Debian 12, Ubuntu 22.04); this system has {version}."
    return ""
